//! Table `[actuator]` of a model file: an ensemble of networks instead of analytic actuators, or beside them.

use std::fmt::Write as _;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use toml::Value;

/// Table `[actuator]`: an ensemble of networks in the chain from command to torque.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActuatorNetworkConfig {
    /// File of the ensemble. [`crate::ModelFile::load`] makes paths absolute that are relative to the model file.
    pub ensemble: PathBuf,
    /// Whether the networks replace the first stages of the chain or add to it.
    #[serde(default)]
    pub mode: NetworkMode,
    /// When a robot samples another member.
    #[serde(default)]
    pub draw: MemberSampling,
    /// True if torque is sampled from the member's Gaussian in every actuator period; false for its mean.
    #[serde(default)]
    pub sample: bool,
}

/// How the torque of an ensemble enters the chain from command to torque.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkMode {
    /// It replaces the stages up to the place of the torque sensor of the training data.
    #[default]
    Replace,
    /// It is added at the place of the torque sensor of the training data. Every law stays.
    Residual,
}

/// When a robot samples the member of the ensemble that computes its torques.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MemberSampling {
    /// At every reset.
    #[default]
    #[serde(rename = "episode")]
    PerEpisode,
    /// In every actuator period (U2E §III-C).
    #[serde(rename = "step")]
    PerStep,
}

/// Appends the text of the table.
pub fn write_actuator_network(text: &mut String, network: &ActuatorNetworkConfig) {
    let ActuatorNetworkConfig { ensemble, mode, draw, sample } = network;
    let mode = match mode {
        NetworkMode::Replace => "replace",
        NetworkMode::Residual => "residual",
    };
    let draw = match draw {
        MemberSampling::PerEpisode => "episode",
        MemberSampling::PerStep => "step",
    };
    let ensemble = Value::from(ensemble.display().to_string());
    writeln!(text, "\n[actuator]\nmode = \"{mode}\"\nensemble = {ensemble}\ndraw = \"{draw}\"\nsample = {sample}")
        .expect("a String takes every text");
}
