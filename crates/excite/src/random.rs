//! Random velocity commands that keep the limits of a run.

use twinstep_envs::{Task, TaskEnv};
use twinstep_model::{Simulator, VecEnv, stream};
use twinstep_policy::Policy;

use crate::sequence::{CommandRanges, CommandSequence};
use crate::trial::{Limits, TrialError, simulate};

/// How often every robot of the environment tries a sequence.
const ATTEMPTS: usize = 16;

/// Returns the first random sequence of `segments` commands with which the robots of `env` keep the limits, or `None`
/// after 16 attempts with every robot, or if `proceed` returns false before one.
pub fn random_within_limits<B: Simulator, T: Task>(
    env: &mut TaskEnv<B, T>,
    policy: &Policy,
    (segment_s, segments): (f64, usize),
    ranges: &CommandRanges,
    limits: &Limits,
    seed: u64,
    proceed: &mut dyn FnMut() -> bool,
) -> Result<Option<CommandSequence>, TrialError> {
    let mut random = stream(seed, "random commands", 0);
    for _ in 0..ATTEMPTS {
        if !proceed() {
            return Ok(None);
        }
        let draw = |_| CommandSequence::random(segment_s, segments, ranges, &mut random);
        let sequences: Vec<_> = (0..env.num_envs()).map(draw).collect();
        let trials = simulate(env, policy, &sequences, seed)?;
        let keeps = |motion| limits.violation(motion, segment_s * segments as f64).is_none();
        if let Some(index) = trials.iter().position(|trial| keeps(&trial.motion)) {
            return Ok(sequences.into_iter().nth(index));
        }
    }
    Ok(None)
}
