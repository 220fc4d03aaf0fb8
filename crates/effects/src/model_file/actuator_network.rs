//! Table `[actuator]` of a model file: an ensemble of networks instead of analytic actuators.

use std::fmt::Write as _;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use toml::Value;

/// Table `[actuator]`: an ensemble of networks that replaces the first stages of the chain from command to torque.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActuatorNetworkConfig {
    /// File of the ensemble. [`crate::ModelFile::load`] makes paths absolute that are relative to the model file.
    pub ensemble: PathBuf,
    /// When a robot samples another member.
    #[serde(default)]
    pub draw: MemberSampling,
    /// True if torque is sampled from the member's Gaussian in every actuator period; false for its mean.
    #[serde(default)]
    pub sample: bool,
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
    let ActuatorNetworkConfig { ensemble, draw, sample } = network;
    let draw = match draw {
        MemberSampling::PerEpisode => "episode",
        MemberSampling::PerStep => "step",
    };
    let ensemble = Value::from(ensemble.display().to_string());
    writeln!(text, "\n[actuator]\nensemble = {ensemble}\ndraw = \"{draw}\"\nsample = {sample}")
        .expect("a String takes every text");
}
