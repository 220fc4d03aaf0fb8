//! Config file of SPI-Active, and the settings of its stages.

use std::path::{Path, PathBuf};
use twinstep_effects::parse_toml;

use serde::{Deserialize, Serialize};
use twinstep_excite::{Criterion, Limits};
use twinstep_identify::{EffectAtScope, free_parameters};
use twinstep_policy::Policy;

use crate::checks::{whole_segments, within};
use crate::design::{DEFAULT_LIMITS, DesignOptions};
use crate::failure::{Failure, input};
use crate::identify_options::IdentifyOptions;
use crate::random_commands::RandomCommands;
use crate::record::{RecordOptions, Velocity};
use crate::robot_file::analytic_model;

/// How the commands after the first stage are chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Largest trace of the Fisher information (SPI-Active).
    Trace,
    /// Largest gain in information.
    DOptimal,
    /// Largest gain in information about the effects `of_interest`.
    Qoed,
    /// Random, as in the first stage (SPI-Random).
    Random,
}

impl Method {
    /// Returns what a design maximises; `None` for random commands.
    pub fn criterion(self) -> Option<Criterion> {
        match self {
            Self::Trace => Some(Criterion::Trace),
            Self::DOptimal => Some(Criterion::DOptimal),
            Self::Qoed => Some(Criterion::Qoed(Vec::new())),
            Self::Random => None,
        }
    }
}

/// Settings of `twinstep spi-active`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpiActiveConfig {
    /// Policy of `walk` or `gait`.
    #[serde(skip_serializing)]
    pub policy: PathBuf,
    /// Effects with scopes whose parameters are sought.
    unknowns: Vec<String>,
    /// Zenoh endpoint of the robot.
    #[serde(default = "default_endpoint", skip_serializing)]
    endpoint: String,
    /// Name of the robot, if several are visible.
    #[serde(skip_serializing)]
    robot: Option<String>,
    /// Zenoh configuration file for TLS, user and password.
    #[serde(skip_serializing)]
    zenoh: Option<PathBuf>,
    /// How the commands after the first stage are chosen.
    #[serde(default = "default_method")]
    pub method: Method,
    /// Effects that matter for `method = "qoed"`; the others are nuisance. Default: what random commands identify.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    of_interest: Vec<String>,
    /// Number of stages after the first.
    #[serde(default = "default_rounds")]
    pub rounds: usize,
    /// Duration of each log [s].
    #[serde(default = "default_seconds")]
    pub seconds: f64,
    /// Duration of a command [s].
    #[serde(default = "default_segment")]
    pub segment_s: f64,
    /// Command sequences that a design simulates.
    #[serde(default = "default_candidates")]
    candidates: u32,
    /// Largest distance from the start [m].
    #[serde(default = "default_room")]
    room_m: f64,
    /// True to step a simulated robot as fast as it answers.
    #[serde(default, skip_serializing)]
    fast: bool,
    /// Seed of commands, searches and the robot's random numbers.
    #[serde(default = "default_seed")]
    pub seed: u64,
    /// Model to start from. Default: the ideal Go2.
    #[serde(skip_serializing)]
    pub model: Option<PathBuf>,
}

/// Returns effects whose names were checked.
fn parsed(effects: &[String]) -> Vec<EffectAtScope> {
    effects.iter().map(|text| text.parse().expect("the config was checked")).collect()
}

fn default_endpoint() -> String {
    "tcp/127.0.0.1:7447".to_owned()
}

const fn default_method() -> Method {
    Method::DOptimal
}

const fn default_rounds() -> usize {
    1
}

const fn default_seconds() -> f64 {
    25.0
}

const fn default_segment() -> f64 {
    5.0
}

const fn default_candidates() -> u32 {
    1000
}

const fn default_room() -> f64 {
    3.0
}

const fn default_seed() -> u64 {
    1
}

impl SpiActiveConfig {
    /// Reads and checks a config file, its policy and its model.
    pub fn load(path: &Path) -> Result<Self, Failure> {
        let wrong = |cause: String| Failure::Input(miette::miette!("{}: {cause}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        let config: Self = parse_toml(&text).map_err(|error| wrong(error.to_string()))?;
        config.check().map_err(wrong)?;
        Policy::read(&config.policy).map_err(input)?;
        let model = analytic_model(config.model.as_deref())?;
        let effects: Vec<_> = config.unknowns().iter().map(|EffectAtScope(effect, scope)| (*effect, *scope)).collect();
        free_parameters(&model, &effects).map_err(|error| wrong(format!("`unknowns`: {error}")))?;
        Ok(config)
    }

    fn check(&self) -> Result<(), String> {
        if self.unknowns.is_empty() {
            return Err("`unknowns` is empty; name at least one effect, such as \"payload@base\"".to_owned());
        }
        for unknown in &self.unknowns {
            unknown.parse::<EffectAtScope>().map_err(|error| format!("`unknowns`: {error}"))?;
        }
        if let Some(other) = self.of_interest.iter().find(|effect| !self.unknowns.contains(effect)) {
            return Err(format!("`of_interest`: `{other}` is not one of the unknowns: {}", self.unknowns.join(", ")));
        }
        let effects = self.unknowns();
        if let Some(index) = (1..effects.len()).find(|index| effects[..*index].contains(&effects[*index])) {
            return Err(format!("`unknowns`: `{}` is named twice", self.unknowns[index]));
        }
        within("rounds", self.rounds as f64, 0.0, 100.0)?;
        within("seconds", self.seconds, 1.0, 600.0)?;
        within("segment_s", self.segment_s, 0.1, self.seconds)?;
        within("candidates", f64::from(self.candidates), 1.0, 1e6)?;
        within("room_m", self.room_m, 0.1, 1000.0)?;
        whole_segments(self.seconds, self.segment_s)?;
        Ok(())
    }

    /// Returns names and contents of what the results depend on: policy, model and settings other than the endpoint.
    pub fn inputs(&self) -> Result<Vec<(&'static str, Vec<u8>)>, Failure> {
        let read = |path: &Path| {
            std::fs::read(path)
                .map_err(|cause| Failure::Input(miette::miette!("cannot read {}: {cause}", path.display())))
        };
        let settings = toml::to_string(self).expect("settings are plain data").into_bytes();
        let mut inputs = vec![("settings.toml", settings), ("policy.safetensors", read(&self.policy)?)];
        // Without a model file the copy is empty, so that a later one differs.
        inputs.push(("model.toml", self.model.as_deref().map_or(Ok(Vec::new()), read)?));
        Ok(inputs)
    }

    /// Returns the effects that are sought.
    pub fn unknowns(&self) -> Vec<EffectAtScope> {
        parsed(&self.unknowns)
    }

    /// Returns the limits of a run.
    pub fn limits(&self) -> Limits {
        Limits { room_m: self.room_m, ..DEFAULT_LIMITS }
    }

    /// Returns the settings of the design of commands in the folder `out`.
    pub fn excitation(&self, criterion: Criterion, model: Option<&Path>, seed: u64, out: &Path) -> DesignOptions {
        DesignOptions {
            model: model.map(Path::to_owned),
            criterion,
            of_interest: parsed(&self.of_interest),
            seconds: self.seconds,
            segment_s: self.segment_s,
            candidates: self.candidates,
            limits: self.limits(),
            seed,
            ..DesignOptions::new(&self.policy, self.unknowns(), out)
        }
    }

    /// Returns random commands for a log.
    pub fn random_commands<'a>(&'a self, model: Option<&'a Path>, seed: u64) -> RandomCommands<'a> {
        let (policy, seconds, segment_s) = (&self.policy, self.seconds, self.segment_s);
        RandomCommands { policy, model, seconds, segment_s, limits: self.limits(), seed }
    }

    /// Returns the settings of a run that follows the commands in a file and records the folder `log`.
    pub fn recording(&self, commands: &Path, log: &Path) -> Result<RecordOptions, Failure> {
        Ok(RecordOptions {
            robot: self.robot.clone(),
            zenoh: self.zenoh.clone(),
            log: Some(log.to_owned()),
            velocity: Velocity::from_file(commands)?,
            seconds: Some(self.seconds),
            fast: self.fast,
            seed: self.seed,
            ..RecordOptions::new(&self.policy, &self.endpoint)
        })
    }

    /// Returns the settings of an identification, which writes the model file `out`.
    ///
    /// The search starts from `earlier`, the model of the stage before.
    pub fn identification(
        &self,
        logs: &[PathBuf],
        earlier: Option<&Path>,
        out: &Path,
        resume: bool,
    ) -> IdentifyOptions {
        IdentifyOptions {
            logs: logs.to_vec(),
            model: self.model.clone(),
            start: earlier.map(Path::to_owned),
            effects: Some(self.unknowns.clone()),
            seed: self.seed,
            resume,
            ..IdentifyOptions::new(out)
        }
    }
}
