//! Faults injected into real processes, and the proof that no step is executed twice, skipped or invented.
//!
//! A [`lane::Lane`] is a server, a client and, on every second lane, a router between them, each a process of its own
//! ([`roles`]), with a [`proxy`] before the client that can delay its messages. Faults ([`fault::Fault`]) hit it one after another while the client steps counters (task `counter`) at full
//! speed. The client compares every observation with a counter of its own ([`ledger::Ledger`]), which also survives the
//! client's death. [`campaign`] runs many lanes at once and adds up.
//!
//! [`hidden_robot`] has the robots that identification is tried on, [`hidden_drive`] the drives that ensembles learn, [`browser`] looks at pages, [`rivals`] has those that are taken for each other, [`security`] what the tests of TLS, users and access control need, [`python`] what those of the Python client do.

pub mod browser;
pub mod campaign;
pub mod fault;
pub mod hidden_drive;
pub mod hidden_robot;
pub mod lane;
pub mod ledger;
pub mod process;
pub mod proxy;
pub mod python;
pub mod repeats;
pub mod rivals;
pub mod roles;
pub mod security;
