//! Random velocity commands for `twinstep spi-active`.

use std::path::Path;

use twinstep_excite::{random_within_limits, walking_env};
use twinstep_model::VecEnv;
use twinstep_policy::Policy;
use twinstep_sim::{BatchBackend, SimConfig};

use crate::evaluate_policy::check_spec;
use crate::excite::velocity_ranges;
use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::robot_file::analytic_model;
use crate::spi_active_config::SpiActiveConfig;

/// Sequences that are simulated at once.
const BATCH: usize = 64;

/// Writes random commands with which the robot of `model` keeps the limits in simulation.
pub fn write(
    config: &SpiActiveConfig,
    model: Option<&Path>,
    seed: u64,
    path: &Path,
    signals: &Signals,
) -> CommandResult {
    let robot = analytic_model(model)?.robot_model().map_err(input)?;
    let (policy, _) = Policy::read(&config.policy).map_err(input)?;
    let backend = BatchBackend::new(robot, SimConfig::default(), BATCH).map_err(input)?;
    let mut env = walking_env(backend, seed).map_err(input)?;
    check_spec(&policy, env.spec())?;
    let segments = (config.segment_s, (config.seconds / config.segment_s).round() as usize);
    let limits = config.limits();
    let mut proceed = || matches!(signals.check(), Ok(false));
    let found = random_within_limits(&mut env, &policy, segments, &velocity_ranges(), &limits, seed, &mut proceed);
    let found = found.map_err(input)?;
    if !proceed() {
        return Err(Failure::Interrupted);
    }
    let Some(sequence) = found else {
        return Err(Failure::Input(miette::miette!(
            "no random command sequence keeps the limits in simulation\n  allow more than `room_m` = {}, or less than \
             `seconds` = {}",
            limits.room_m,
            config.seconds
        )));
    };
    std::fs::write(path, sequence.to_csv()).map_err(other)
}
