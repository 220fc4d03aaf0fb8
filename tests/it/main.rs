//! Tests that cross crates, in one binary.

#![allow(clippy::unwrap_used)]

/// Counts the allocated bytes, for the tests that bound memory.
#[global_allocator]
static ALLOCATOR: cap::Cap<std::alloc::System> = cap::Cap::new(std::alloc::System, usize::MAX);

mod any_robot;
mod any_robot_env;
mod any_robot_log;
mod any_robot_programs;
mod base_estimate;
mod batch;
mod bombs;
mod cyclone;
mod dds_packets;
mod diagnose;
mod discovery;
mod disturbances;
mod effect_bodies;
mod effect_laws;
mod effect_readings;
mod effects;
mod exactly_once;
mod excite;
mod fake_robot;
mod faults;
mod fit;
mod foreign;
mod fuzz;
mod golden_ensemble;
mod hunt;
mod identify;
mod import;
mod layering;
mod learned;
mod learned_residual;
mod leases;
mod load;
mod log;
mod mirror;
mod mujoco;
mod next_experiment;
mod other_robots;
mod play;
mod plots;
mod policy;
mod policy_contract;
mod preflight;
mod prose;
mod python;
mod randomise;
mod rapier;
mod raw_client;
mod remote;
mod remote_rollout;
mod render;
mod robot;
mod robot_campaign;
mod robot_stops;
mod robot_to_model;
mod robots;
mod rollout;
mod run;
mod samples;
mod security;
mod sharded;
mod slow_sensors;
mod soak;
mod spi_active;
mod terrain;
mod tidy;
mod train;
mod u2e;
mod velocity_command;
mod view;
mod watchdog;
mod wire;
