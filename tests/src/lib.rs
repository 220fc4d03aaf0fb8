//! Faults injected into real processes, and the proof that no step is executed twice, skipped or invented.
//!
//! A [`lane::TestBed`] is a server, a client and, on every second lane, a router between them, each a process of its own
//! ([`roles`]), with a [`proxy`] before the client that can delay its messages. Faults ([`fault::Fault`]) hit it one after another while the client steps counters (task `counter`) at full
//! speed. The client compares every observation with a counter of its own ([`ledger::StepOracle`]), which also survives the
//! client's death. [`fault_injection`] runs many lanes at once and adds up.
//!
//! [`ground_truth_robot`] has the robots that identification is tried on, [`ground_truth_actuator`] the actuators that ensembles learn, [`browser`] looks at pages, [`confounded_pairs`] has those that are taken for each other, [`security`] what the tests of TLS, users and access control need, [`python`] what those of the Python client do.

pub mod browser;
pub mod confounded_pairs;
pub mod fault;
pub mod fault_injection;
pub mod ground_truth_actuator;
pub mod ground_truth_robot;
pub mod process;
pub mod proxy;
pub mod python;
pub mod repeats;
pub mod roles;
pub mod security;
pub mod step_oracle;
pub mod test_bed;
