//! What robots without a fault reach by chance: the threshold of a name.

use super::evidence::Evidence;
use twinstep_model::{ModelFile, Rollout};

/// No name is given for less [nats].
const LEAST: f64 = 15.0;

/// The evidence that a cause has to exceed [nats].
pub fn threshold(_evidence: &Evidence, _model: &ModelFile, _simulator: &mut dyn Rollout) -> f64 {
    LEAST
}
