//! Random commands for `twinstep spi-active` and `twinstep u2e`.

use std::path::Path;

use twinstep_excite::Limits;
use twinstep_policy::Policy;
use twinstep_sim::SimConfig;

use crate::command_env::CommandEnv;
use crate::failure::{Failure, input, other};
use crate::observer::Observer;
use crate::robot_file::analytic_model;

/// Sequences that are simulated at once.
const BATCH: usize = 64;

/// Commands that are sought.
pub struct RandomCommands<'a> {
    /// Policy that follows them.
    pub policy: &'a Path,
    /// Model of the robot. Default: the ideal Go2.
    pub model: Option<&'a Path>,
    /// Duration of all [s].
    pub seconds: f64,
    /// Duration of each [s].
    pub segment_s: f64,
    /// Limits that the simulated robot keeps.
    pub limits: Limits,
    /// Seed.
    pub seed: u64,
}

impl RandomCommands<'_> {
    /// Writes commands with which the simulated robot keeps the limits.
    pub fn write(&self, path: &Path, observer: &Observer) -> Result<(), Failure> {
        let robot = analytic_model(self.model)?.robot_model().map_err(input)?;
        let (policy, _) = Policy::read(self.policy).map_err(input)?;
        let mut env = CommandEnv::new(&policy, &robot, SimConfig::default(), BATCH, self.seed)?;
        let segments = (self.segment_s, (self.seconds / self.segment_s).round() as usize);
        let mut proceed = || matches!(observer.check(), Ok(false));
        let limits = &self.limits;
        let found = env.random_within_limits(&policy, segments, limits, self.seed, &mut proceed);
        let found = found.map_err(input)?;
        if !proceed() {
            return Err(Failure::Interrupted);
        }
        let Some(sequence) = found else {
            return Err(Failure::Input(miette::miette!(
                "no random command sequence keeps the limits in simulation\n  allow more than `room_m` = {}, or less than \
                 `seconds` = {}",
                limits.room_m,
                self.seconds
            )));
        };
        twinstep_files::write(path, sequence.to_csv()).map_err(other)
    }
}
