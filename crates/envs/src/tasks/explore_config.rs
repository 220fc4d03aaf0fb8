//! Settings of the task `explore`: a residual on a frozen policy that walks, rewarded for uncertainty (U2E, §III-C).

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::walk_config::WalkConfig;
use crate::config::{ConfigError, check_value};

/// The `[task]` table of `explore`.
///
/// The reward is `uncertainty_weight · u + task_weight · reward of walk` (U2E, eq. 13), with u the epistemic uncertainty of
/// the actuator networks, mean over the joints [nat]. The reward of `walk` has the penalties on joint limits, torque and
/// falls.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ExploreConfig {
    /// Policy file of `walk`, whose actions are corrected.
    pub base: PathBuf,
    /// Largest correction of an action, in units of the action scale.
    pub max_residual: f32,
    /// Weight α of the epistemic uncertainty, per second.
    pub uncertainty_weight: f32,
    /// Weight β of the reward of `walk`.
    pub task_weight: f32,
    /// Commands, rewards and ends of `walk`.
    pub walk: WalkConfig,
}

impl Default for ExploreConfig {
    fn default() -> Self {
        Self {
            base: PathBuf::new(),
            max_residual: 0.5,
            uncertainty_weight: 10.0,
            task_weight: 0.5,
            walk: WalkConfig::default(),
        }
    }
}

impl ExploreConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        if self.base.as_os_str().is_empty() {
            return Err(ConfigError {
                field: "task.base".to_owned(),
                value: "\"\"".to_owned(),
                allowed: "a policy file of `walk`, such as \"walk/policy.safetensors\"".to_owned(),
            });
        }
        check_value("task.max_residual", self.max_residual, 0.01, 2.0)?;
        check_value("task.uncertainty_weight", self.uncertainty_weight, 0.0, 1e6)?;
        check_value("task.task_weight", self.task_weight, 0.0, 1e6)?;
        self.walk.check().map_err(|error| error.within("walk"))
    }

    /// Returns the settings of `walk` with the weights of this task.
    pub fn weighted_walk(&self) -> WalkConfig {
        let mut walk = self.walk.clone();
        walk.reward = walk.reward.scaled(self.task_weight);
        walk.reward.epistemic_uncertainty = self.uncertainty_weight;
        walk
    }
}
