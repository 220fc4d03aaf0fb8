//! Config file of U2E, and the settings of its stages.

use std::path::{Path, PathBuf};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use twinstep_effects::{ActuatorNetworkConfig, MemberSampling, ModelFile, parse_toml};
use twinstep_ensemble::{JointEncoding, check_effects};
use twinstep_envs::{ExploreConfig, Randomisation, TaskConfig, over_defaults};
use twinstep_excite::Limits;
use twinstep_learning::PpoConfig;
use twinstep_logs::TorqueSensor;
use twinstep_policy::Policy;

use crate::checks::{whole_segments, within};
use crate::design::DEFAULT_LIMITS;
use crate::failure::{Failure, input};
use crate::fit::FitOptions;
use crate::observer::Observer;
use crate::open_log::open_log;
use crate::random_commands::RandomCommands;
use crate::record::{RecordOptions, Velocity};
use crate::robot_file::analytic_model;
use crate::train_config::TrainConfig;

/// How the logs after the first one are collected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// By a policy that is trained for the uncertainty of the ensemble (U2E).
    Explore,
    /// By the base policy with random noise on its actions.
    Random,
    /// By the base policy, as the first one.
    Base,
}

/// When the iterations end before `iterations`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stop {
    /// When the uncertainty of new data no longer decreases by `threshold` (U2E, §III-C).
    Uncertainty,
    /// Never.
    Never,
}

/// Settings of `twinstep u2e`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct U2eConfig {
    /// Base policy, of the task `walk`.
    #[serde(skip_serializing)]
    pub policy: PathBuf,
    /// Zenoh endpoint of the robot.
    #[serde(default = "default_endpoint", skip_serializing)]
    endpoint: String,
    /// Name of the robot, if several are visible.
    #[serde(skip_serializing)]
    robot: Option<String>,
    /// Zenoh configuration file for TLS, user and password.
    #[serde(skip_serializing)]
    zenoh: Option<PathBuf>,
    /// Model file of the robot with effects behind the torque sensor. Default: the ideal Go2.
    #[serde(skip_serializing)]
    pub model: Option<PathBuf>,
    /// Log that no ensemble learns from; the ensembles are compared on it. Default: none.
    #[serde(skip_serializing)]
    pub held_out: Option<PathBuf>,
    /// How the logs after the first one are collected.
    #[serde(default = "default_method")]
    pub method: Method,
    /// Largest number of logs after the first one.
    #[serde(default = "default_iterations")]
    pub iterations: usize,
    /// When the iterations end earlier.
    #[serde(default = "default_stop")]
    pub stop: Stop,
    /// Relative decrease of the uncertainty below which the iterations end.
    #[serde(default = "default_threshold")]
    pub threshold: f64,
    /// Duration of each log [s].
    #[serde(default = "default_seconds")]
    pub seconds: f64,
    /// Duration of a velocity command [s].
    #[serde(default = "default_segment")]
    segment_s: f64,
    /// Largest distance from the start [m].
    #[serde(default = "default_room")]
    room_m: f64,
    /// Standard deviation of the noise of method `random`.
    #[serde(default = "default_action_noise")]
    action_noise: f64,
    /// When a simulated robot draws another member of the ensemble.
    #[serde(default)]
    draw: MemberSampling,
    /// True to step a simulated robot as fast as it answers.
    #[serde(default, skip_serializing)]
    fast: bool,
    /// Seed of commands, networks, trainings and the robot's random numbers.
    #[serde(default = "default_seed")]
    pub seed: u64,
    /// Ensemble.
    #[serde(default)]
    fit: FitTable,
    /// Task of the exploration policies.
    #[serde(default)]
    explore: ExploreConfig,
    /// Robots that the exploration policies are trained on.
    #[serde(default)]
    randomise: Randomisation,
    /// Training of the exploration policies.
    #[serde(default = "default_train", deserialize_with = "train_table")]
    train: PpoConfig,
}

/// Table `[fit]`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct FitTable {
    /// Number of members.
    members: usize,
    /// Number of hidden units.
    hidden: usize,
    /// Encoding of the joint in the input.
    joint_input: JointEncoding,
    /// Maximum number of epochs.
    epochs: usize,
    /// Frequency of the smoothing of the training split [Hz].
    smooth_hz: Option<f64>,
}

impl Default for FitTable {
    fn default() -> Self {
        let FitOptions { members, hidden, joint_input, epochs, .. } = FitOptions::new(Vec::new(), PathBuf::new());
        Self { members, hidden, joint_input, epochs, smooth_hz: None }
    }
}

fn default_endpoint() -> String {
    "tcp/127.0.0.1:7447".to_owned()
}

const fn default_method() -> Method {
    Method::Explore
}

const fn default_iterations() -> usize {
    3
}

const fn default_stop() -> Stop {
    Stop::Uncertainty
}

const fn default_threshold() -> f64 {
    0.1
}

const fn default_seconds() -> f64 {
    60.0
}

const fn default_segment() -> f64 {
    5.0
}

const fn default_room() -> f64 {
    3.0
}

const fn default_action_noise() -> f64 {
    0.2
}

const fn default_seed() -> u64 {
    1
}

/// The residual is a correction, so that fewer steps than for walking are enough.
fn default_train() -> PpoConfig {
    PpoConfig { total_steps: 2_000_000, ..PpoConfig::default() }
}

/// Returns the settings of `[train]`, of which every key is optional.
fn train_table<'de, D: Deserializer<'de>>(deserializer: D) -> Result<PpoConfig, D::Error> {
    over_defaults(&default_train(), toml::Table::deserialize(deserializer)?).map_err(D::Error::custom)
}

impl U2eConfig {
    /// Reads and checks a config file, and the files that it names.
    pub fn load(path: &Path, observer: &Observer) -> Result<Self, Failure> {
        let wrong = |cause: String| Failure::Input(miette::miette!("{}: {cause}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        let mut config: Self = parse_toml(&text).map_err(|error| wrong(error.to_string()))?;
        if !config.explore.base.as_os_str().is_empty() {
            return Err(wrong("`explore.base` is not a setting here: the base policy is `policy`".to_owned()));
        }
        config.explore.base.clone_from(&config.policy);
        config.check().map_err(wrong)?;
        Policy::read(&config.policy).map_err(input)?;
        let model = analytic_model(config.model.as_deref())?;
        // Before the robot moves: what `[actuator]` will reject after the first log.
        let robot = model.robot_model().map_err(input)?;
        check_effects(&model, TorqueSensor::MotorCurrent).map_err(|error| wrong(format!("`model`: {error}")))?;
        config.randomise.check_base(robot.trunk.mass).map_err(|error| wrong(error.to_string()))?;
        if let Some(log) = &config.held_out {
            open_log(log, observer)?;
        }
        Ok(config)
    }

    fn check(&self) -> Result<(), String> {
        within("iterations", self.iterations as f64, 0.0, 100.0)?;
        within("threshold", self.threshold, 0.0, 1.0)?;
        within("seconds", self.seconds, 1.0, 600.0)?;
        within("segment_s", self.segment_s, 0.1, self.seconds)?;
        within("room_m", self.room_m, 0.1, 1000.0)?;
        within("action_noise", self.action_noise, 0.0, 1.0)?;
        whole_segments(self.seconds, self.segment_s)?;
        let FitTable { members, hidden, epochs, smooth_hz, .. } = &self.fit;
        let fewest = if self.method == Method::Explore { 2.0 } else { 1.0 };
        within("fit.members", *members as f64, fewest, 100.0)?;
        within("fit.hidden", *hidden as f64, 1.0, 512.0)?;
        within("fit.epochs", *epochs as f64, 1.0, 100_000.0)?;
        if let Some(hz) = smooth_hz {
            within("fit.smooth_hz", *hz, 0.1, 99.0)?;
        }
        // `[explore]` is the `[task]` table of `explore`.
        self.explore.check().map_err(|error| error.to_string().replacen("`task.", "`explore.", 1))?;
        self.randomise.check().map_err(|error| error.to_string())?;
        if self.randomise.kp_scale != [1.0; 2] || self.randomise.kd_scale != [1.0; 2] {
            return Err(
                "`randomise.kp_scale` and `kd_scale` are not [1, 1]: an ensemble is valid for one pair of gains"
                    .to_owned(),
            );
        }
        if self.randomise.command_delay_ms != [0.0; 2] {
            return Err("`randomise.command_delay_ms` is not [0, 0]: the ensemble includes the delay".to_owned());
        }
        self.train.check().map_err(|error| error.to_string())
    }

    /// Returns names and contents of what the results depend on: files and settings other than those of the connection.
    pub fn inputs(&self) -> Result<Vec<(&'static str, Vec<u8>)>, Failure> {
        let read = |path: &Path| {
            std::fs::read(path)
                .map_err(|cause| Failure::Input(miette::miette!("cannot read {}: {cause}", path.display())))
        };
        let mut settings = self.clone();
        // The content of the base policy counts, not its path.
        settings.explore.base = PathBuf::new();
        let settings = toml::to_string(&settings).expect("settings are plain data").into_bytes();
        let mut inputs = vec![("settings.toml", settings), ("policy.safetensors", read(&self.policy)?)];
        // Without a model file the copy is empty, so that a later one differs.
        inputs.push(("model.toml", self.model.as_deref().map_or(Ok(Vec::new()), read)?));
        Ok(inputs)
    }

    /// Returns the velocity commands of log number `iteration`.
    pub fn commands(&self, iteration: usize) -> RandomCommands<'_> {
        RandomCommands {
            policy: &self.policy,
            model: self.model.as_deref(),
            seconds: self.seconds,
            segment_s: self.segment_s,
            limits: Limits { room_m: self.room_m, ..DEFAULT_LIMITS },
            seed: self.seed + iteration as u64,
        }
    }

    /// Returns the settings of a run in which `policy` follows the commands in a file and records `log`.
    pub fn recording(
        &self,
        policy: &Path,
        commands: &Path,
        log: &Path,
        iteration: usize,
    ) -> Result<RecordOptions, Failure> {
        let is_noisy = self.method == Method::Random && iteration > 0;
        Ok(RecordOptions {
            robot: self.robot.clone(),
            zenoh: self.zenoh.clone(),
            log: Some(log.to_owned()),
            torque: true,
            velocity: Velocity::from_file(commands)?,
            seconds: Some(self.seconds),
            action_noise: if is_noisy { self.action_noise } else { 0.0 },
            fast: self.fast,
            seed: self.seed + iteration as u64,
            ..RecordOptions::new(policy, &self.endpoint)
        })
    }

    /// Returns the settings of a fit, which writes the file `out`, starting from an earlier ensemble if there is one.
    pub fn fitting(&self, logs: Vec<PathBuf>, earlier: Option<PathBuf>, out: &Path) -> FitOptions {
        let FitTable { members, hidden, joint_input, epochs, smooth_hz } = self.fit;
        let options = FitOptions::new(logs, out.to_owned()).resumed_if_interrupted();
        FitOptions { members, hidden, joint_input, epochs, seed: self.seed, smooth_hz, from: earlier, ..options }
    }

    /// Returns the model file of a robot with this ensemble.
    pub fn simulated_robot(&self, ensemble: PathBuf) -> Result<String, Failure> {
        let actuator = Some(ActuatorNetworkConfig { ensemble, draw: self.draw, ..ActuatorNetworkConfig::default() });
        Ok(ModelFile { actuator, ..analytic_model(self.model.as_deref())? }.to_toml())
    }

    /// Returns the settings of the training of an exploration policy on the robot of a model file.
    pub fn training(&self, model: PathBuf) -> TrainConfig {
        let base = self.policy.canonicalize().unwrap_or_else(|_| self.policy.clone());
        let task = TaskConfig::Explore(ExploreConfig { base, ..self.explore.clone() });
        let (randomise, train) = (self.randomise, self.train.clone());
        TrainConfig { model: Some(model), task, randomise, train, ..TrainConfig::default() }
    }
}

/// Returns true if the iterations end: the uncertainty of new data has decreased by less than `threshold`, relatively.
///
/// `uncertainties` are those of the logs after the first one, each by the ensemble before it [nat]. U2E, §III-C.
pub fn has_converged(uncertainties: &[f64], threshold: f64) -> bool {
    relative_decrease(uncertainties).is_some_and(|decrease| decrease < threshold)
}

/// Returns the relative decrease from the last but one uncertainty to the last. `None` if there is none to compare with.
pub fn relative_decrease(uncertainties: &[f64]) -> Option<f64> {
    match uncertainties {
        [.., before, last] if *before > 0.0 => Some((before - last) / before),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_key_of_the_training_leaves_its_other_defaults() {
        let table = |text: &str| train_table(toml::Deserializer::parse(text).expect("a table"));
        assert_eq!(table("epochs = 4").expect("valid"), PpoConfig { epochs: 4, ..default_train() });
        let error = table("epoch = 4").expect_err("invalid").to_string();
        assert!(error.starts_with("unknown field `epoch`, expected one of `num_envs`"), "{error}");
    }

    #[test]
    fn iterations_end_when_the_uncertainty_of_new_data_no_longer_decreases_enough() {
        assert!(!has_converged(&[], 0.1) && !has_converged(&[0.5], 0.1), "there is nothing to compare with");
        assert!(!has_converged(&[0.5, 0.4], 0.1), "a decrease of 20 %");
        assert!(has_converged(&[0.5, 0.4, 0.37], 0.1), "a decrease of 7.5 %");
        assert!(has_converged(&[0.5, 0.6], 0.1), "an increase");
        assert!(!has_converged(&[0.0, 0.0], 0.1), "one member has no uncertainty");
    }
}
