//! Shared code of the tests that cross crates, and of the programs behind `results/`.
//!
//! Fault injection checks with real processes that no step is executed twice, skipped or invented. A
//! [`test_bed::TestBed`] has a server, a client and, in every second test bed, a router between them. Each is a process
//! of its own ([`roles`]). A [`proxy`] in front of the client can delay its messages. Faults ([`fault::Fault`]) are
//! injected one after another while the client steps counters (task `counter`) as fast as it can. The client compares
//! every observation with its own counters ([`step_oracle::StepOracle`]), and this state survives the client's process.
//! [`fault_injection`] runs many test beds in parallel and adds up their results.
//!
//! The other modules:
//! - [`ground_truth_robot`]: robots with known parameters, for system identification
//! - [`ground_truth_actuator`]: actuators with known effects, for actuator networks
//! - [`confounded_pairs`]: pairs of confounded effects, for experiment design
//! - [`foreign_policy`]: policies with the conventions of other programs
//! - [`fuzz`]: random changes to messages and files
//! - [`mujoco_ground_truth`]: robots in MuJoCo with hidden effects, on which methods are compared
//! - [`fine_tuning`]: policies that are fine-tuned on models of these robots
//! - [`resumable`]: commands whose results are kept
//! - [`robot_rig`]: a fake Go2 under the safety state machine, on an accelerated clock
//! - [`robot_campaign`]: faults of this robot in each state, and random sequences of events
//! - [`soak`]: many clients that end in different ways
//! - [`mod@safety`]: attacks on the robot's process and on servers
//! - [`chrome_page`]: a page in a real browser that a test clicks
//! - [`browser`]: layout of an HTML report in a real browser
//! - [`security`]: files and certificates for TLS, users and access control
//! - [`python`]: environment for the tests of the Python client

pub mod browser;
pub mod chrome_page;
pub mod confounded_pairs;
pub mod fault;
pub mod fault_injection;
pub mod fine_tuning;
pub mod foreign_policy;
pub mod fuzz;
pub mod ground_truth_actuator;
pub mod ground_truth_robot;
pub mod mujoco_ground_truth;
pub mod process;
pub mod proxy;
pub mod python;
pub mod repeats;
pub mod resumable;
pub mod robot_campaign;
pub mod robot_pair;
pub mod robot_rig;
pub mod roles;
pub mod safety;
pub mod security;
pub mod soak;
pub mod step_oracle;
pub mod stranger;
pub mod test_bed;
