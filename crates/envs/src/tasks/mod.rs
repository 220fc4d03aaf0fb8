//! The tasks, one file each, and the `[task]` table of a config file.

use serde::{Deserialize, Serialize};
use twinstep_model::EnvSpec;

use crate::config::{ConfigError, over_defaults};

pub mod attitude;
pub mod attitude_config;
pub mod explore_config;
pub mod gait;
pub mod gait_clock;
pub mod gait_config;
pub mod gait_reward;
pub mod getup;
pub mod getup_config;
pub mod jump;
pub mod jump_config;
pub mod jump_flight;
pub mod jump_reward;
pub mod pose;
pub mod pose_config;
pub mod track;
pub mod track_config;
pub mod walk;
pub mod walk_config;

pub use attitude::{Attitude, roll_and_pitch};
pub use attitude_config::AttitudeConfig;
pub use explore_config::ExploreConfig;
pub use gait::GaitTask;
pub use gait_clock::Gait;
pub use gait_config::GaitConfig;
pub use getup::Getup;
pub use getup_config::GetupConfig;
pub use jump::Jump;
pub use jump_config::JumpConfig;
pub use pose::{PoseState, PoseTask};
pub use pose_config::PoseConfig;
pub use track::Track;
pub use track_config::TrackConfig;
pub use walk::Walk;
pub use walk_config::WalkConfig;

/// A task and its settings: the `[task]` table of a config file. `name` selects the task; default: `walk`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "name", rename_all = "snake_case", try_from = "toml::Table")]
pub enum TaskConfig {
    /// Locomotion with velocity commands.
    Walk(WalkConfig),
    /// Following a path on the ground.
    Track(TrackConfig),
    /// A jump to a target, once, from standing.
    Jump(JumpConfig),
    /// Locomotion with velocity commands and a commanded gait.
    Gait(GaitConfig),
    /// Standing with a commanded roll, pitch and height of the base.
    Attitude(AttitudeConfig),
    /// A residual on a frozen policy of `walk`, rewarded for the uncertainty of the actuator networks.
    Explore(ExploreConfig),
    /// Getting up from any orientation and pose.
    Getup(GetupConfig),
    /// The joints of any robot follow targets.
    Pose(PoseConfig),
    /// Counts steps without physics, to verify and measure the transport. It has no settings.
    Counter,
}

impl Default for TaskConfig {
    fn default() -> Self {
        Self::Walk(WalkConfig::default())
    }
}

impl TaskConfig {
    /// Names of all tasks.
    pub const NAMES: [&str; 9] = ["walk", "track", "jump", "gait", "attitude", "explore", "getup", "pose", "counter"];

    /// Returns the task of this name with default settings. Returns `None` if there is no such task.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "walk" => Some(Self::default()),
            "track" => Some(Self::Track(TrackConfig::default())),
            "jump" => Some(Self::Jump(JumpConfig::default())),
            "gait" => Some(Self::Gait(GaitConfig::default())),
            "attitude" => Some(Self::Attitude(AttitudeConfig::default())),
            "explore" => Some(Self::Explore(ExploreConfig::default())),
            "getup" => Some(Self::Getup(GetupConfig::default())),
            "pose" => Some(Self::Pose(PoseConfig::default())),
            "counter" => Some(Self::Counter),
            _ => None,
        }
    }

    /// Returns the name of the task.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Walk(_) => "walk",
            Self::Track(_) => "track",
            Self::Jump(_) => "jump",
            Self::Gait(_) => "gait",
            Self::Attitude(_) => "attitude",
            Self::Explore(_) => "explore",
            Self::Getup(_) => "getup",
            Self::Pose(_) => "pose",
            Self::Counter => "counter",
        }
    }

    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        match self {
            Self::Walk(config) => config.check(),
            Self::Track(config) => config.check(),
            Self::Jump(config) => config.check(),
            Self::Gait(config) => config.check(),
            Self::Attitude(config) => config.check(),
            Self::Explore(config) => config.check(),
            Self::Getup(config) => config.check(),
            Self::Pose(config) => config.check(),
            Self::Counter => Ok(()),
        }
    }

    /// Returns the task of a policy with default settings, and with as many frames as it observes. Returns `None` if there is no
    /// such task.
    pub fn of_policy(spec: &EnvSpec) -> Option<Self> {
        let frames = spec.observation.iter().filter(|field| field.name.starts_with("base_angular_velocity")).count();
        match Self::named(&spec.task)? {
            Self::Walk(config) => Some(Self::Walk(WalkConfig { frames: frames.max(1), ..config })),
            task => Some(task),
        }
    }

    /// Returns the task with default settings, except for the base policy of `explore` and its largest correction.
    pub fn with_default_settings(&self) -> Self {
        match self {
            Self::Explore(config) => {
                let (base, max_residual) = (config.base.clone(), config.max_residual);
                Self::Explore(ExploreConfig { base, max_residual, ..ExploreConfig::default() })
            }
            // The frames are part of what a policy observes.
            Self::Walk(config) => Self::Walk(WalkConfig { frames: config.frames, ..WalkConfig::default() }),
            _ => Self::named(self.name()).expect("a task has its name"),
        }
    }

    /// Returns key and weight of the reward term `epistemic_uncertainty`, which needs actuator networks.
    pub fn epistemic_uncertainty_weight(&self) -> (&'static str, f32) {
        match self {
            Self::Walk(config) => ("task.reward.epistemic_uncertainty", config.reward.epistemic_uncertainty),
            Self::Track(config) => ("task.walk.reward.epistemic_uncertainty", config.walk.reward.epistemic_uncertainty),
            Self::Jump(config) => ("task.walk.reward.epistemic_uncertainty", config.walk.reward.epistemic_uncertainty),
            Self::Gait(config) => ("task.walk.reward.epistemic_uncertainty", config.walk.reward.epistemic_uncertainty),
            Self::Attitude(config) => {
                ("task.walk.reward.epistemic_uncertainty", config.walk.reward.epistemic_uncertainty)
            }
            Self::Explore(config) => ("task.uncertainty_weight", config.uncertainty_weight),
            Self::Getup(_) | Self::Pose(_) | Self::Counter => ("task", 0.0),
        }
    }

    /// Returns the joint offset of an action of 1, if the task needs another one than the robot has [rad].
    pub fn action_scale(&self) -> Option<f64> {
        matches!(self, Self::Getup(_)).then_some(getup::ACTION_SCALE)
    }
}

impl TryFrom<toml::Table> for TaskConfig {
    type Error = String;

    fn try_from(mut table: toml::Table) -> Result<Self, String> {
        let name = table.remove("name").unwrap_or_else(|| "walk".into());
        match name.as_str() {
            Some("walk") => over_defaults(&WalkConfig::default(), table).map(Self::Walk),
            Some("track") => over_defaults(&TrackConfig::default(), table).map(Self::Track),
            Some("jump") => over_defaults(&JumpConfig::default(), table).map(Self::Jump),
            Some("gait") => over_defaults(&GaitConfig::default(), table).map(Self::Gait),
            Some("attitude") => over_defaults(&AttitudeConfig::default(), table).map(Self::Attitude),
            Some("explore") => over_defaults(&ExploreConfig::default(), table).map(Self::Explore),
            Some("getup") => over_defaults(&GetupConfig::default(), table).map(Self::Getup),
            Some("pose") => over_defaults(&PoseConfig::default(), table).map(Self::Pose),
            Some("counter") if table.is_empty() => Ok(Self::Counter),
            Some("counter") => Err("the task `counter` has no settings besides `name`".to_owned()),
            _ => Err(format!("`name` = {name} is not a task; possible: {}", Self::NAMES.join(", "))),
        }
    }
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;

    #[test]
    fn name_selects_the_task_and_its_settings() {
        let parse = |text: &str| toml::from_str::<TaskConfig>(text);
        let walk = parse("tracking_sigma = 0.5").expect("valid");
        assert_eq!(walk, TaskConfig::Walk(WalkConfig { tracking_sigma: 0.5, ..WalkConfig::default() }));
        let track = parse("name = \"track\"\npath = \"figure_eight\"\nwalk.tracking_sigma = 0.5").expect("valid");
        let config = TrackConfig { path: crate::PathShape::FigureEight, ..TrackConfig::default() };
        let common = WalkConfig { tracking_sigma: 0.5, ..WalkConfig::default() };
        assert_eq!(track, TaskConfig::Track(TrackConfig { walk: common, ..config }));
        assert_eq!(parse("name = \"counter\"").expect("valid"), TaskConfig::Counter);
        let others = ["jump", "gait", "getup", "pose"].map(|name| TaskConfig::named(name).expect("a task"));
        for task in [walk, track, TaskConfig::Counter].into_iter().chain(others) {
            assert_eq!(parse(&toml::to_string(&task).expect("serialised")).expect("valid"), task);
        }
        for name in TaskConfig::NAMES {
            assert_eq!(TaskConfig::named(name).expect("a task").name(), name);
        }
    }

    #[test]
    fn one_key_of_a_table_leaves_the_other_settings_of_the_task() {
        let parse = |text: &str| toml::from_str::<TaskConfig>(text).expect("valid");
        let jump = parse("name = \"jump\"\nwalk.reward.hip_deviation = 0.0");
        let mut expected = JumpConfig::default();
        expected.walk.reward.hip_deviation = 0.0;
        assert_eq!(jump, TaskConfig::Jump(expected), "the other weights and the end of an episode are those of `jump`");
        let gait = parse("name = \"gait\"\n[walk.command]\nlinear_velocity_x = [0.0, 0.5]");
        let mut expected = GaitConfig::default();
        expected.walk.command.linear_velocity_x = [0.0, 0.5];
        assert_eq!(gait, TaskConfig::Gait(expected), "sideways commands stay zero");
    }

    #[test]
    fn errors_name_the_key_and_what_is_possible() {
        let error = |text: &str| toml::from_str::<TaskConfig>(text).expect_err("invalid").to_string();
        expect![[r#"
            unknown field `torques`, expected one of `track_linear_velocity`, `track_angular_velocity`, `linear_velocity_z`, `angular_velocity_xy`, `flat_orientation`, `base_height`, `joint_torque`, `joint_acceleration`, `action_rate`, `joint_position_limits`, `hip_deviation`, `feet_air_time`, `feet_clearance`, `feet_slip`, `undesired_contact`, `stand_still`, `termination`, `epistemic_uncertainty`
            in `reward`
        "#]].assert_eq(&error("[reward]\ntorques = -1.0"));
        expect![[r#"
            `name` = "fly" is not a task; possible: walk, track, jump, gait, attitude, explore, getup, pose, counter
        "#]]
        .assert_eq(&error("name = \"fly\""));
        expect![[r#"
            the task `counter` has no settings besides `name`
        "#]]
        .assert_eq(&error("name = \"counter\"\ntracking_sigma = 0.5"));
    }

    #[test]
    fn defaults_are_valid() {
        for name in ["walk", "track", "jump", "gait", "attitude", "pose", "counter"] {
            assert_eq!(TaskConfig::named(name).expect("a task").check(), Ok(()), "{name}");
        }
        let explore = ExploreConfig::default();
        assert_eq!(explore.check().expect_err("no base policy").field, "task.base");
        let explore = ExploreConfig { base: "walk.safetensors".into(), ..explore };
        let none = ExploreConfig { max_residual: 0.0, ..explore.clone() };
        assert_eq!(none.check().expect_err("no residual").field, "task.max_residual");
        assert_eq!(explore.check(), Ok(()));
        let weights = explore.weighted_walk().reward;
        assert_eq!((weights.epistemic_uncertainty, weights.termination), (10.0, -2.5));
    }
}
