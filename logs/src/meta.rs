//! What a log says of itself: `meta.json`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::LogError;
use crate::columns::{Column, quantity};

/// The content of `meta.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Meta {
    /// Rows per second, as intended [Hz].
    pub rate_hz: f64,
    /// New commands per second [Hz].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub policy_hz: Option<f64>,
    /// The joints to read, by name; empty means all that have columns.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub joints: Vec<String>,
    /// Where `tau_measured` was measured.
    pub tau_sensor: TorqueSensor,
    /// What the column `segment` is an index into.
    pub segments: Vec<Segment>,
    /// How commands were held and clipped, in words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pd: Option<String>,
    /// Position gain where no column has it [N·m/rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kp: Option<Gain>,
    /// Velocity gain where no column has it [N·m·s/rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kd: Option<Gain>,
    /// Standard deviation of a channel (`q_FL_hip`) or of all of a quantity (`q`), in the channel's unit.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub noise: BTreeMap<String, f64>,
    /// Where the log comes from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// Under which licence it may be used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub licence: Option<String>,
}

/// Where the torque of a log was measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TorqueSensor {
    /// Motor current × torque constant.
    MotorCurrent,
    /// At the joint's output.
    JointOutput,
    /// Nowhere.
    None,
}

/// What the trunk could do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BaseMount {
    /// Held by a stand.
    Fixed,
    /// Free to move.
    Floating,
}

/// One part of a log, recorded in one manner.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Segment {
    /// What was done, such as `air_chirp`.
    pub name: String,
    /// What the trunk could do.
    pub base: BaseMount,
}

/// A gain that is constant over the log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a gain must be a number, or a list with one number for each joint")]
pub enum Gain {
    /// The same for all joints.
    Uniform(f64),
    /// One for each joint, in the order of [`Meta::joints`].
    PerJoint(Vec<f64>),
}

impl Meta {
    /// A description that says only what it must.
    pub fn new(rate_hz: f64, tau_sensor: TorqueSensor, segments: Vec<Segment>) -> Meta {
        Meta {
            rate_hz,
            policy_hz: None,
            joints: Vec::new(),
            tau_sensor,
            segments,
            pd: None,
            kp: None,
            kd: None,
            noise: BTreeMap::new(),
            source: None,
            licence: None,
        }
    }

    /// Reads a description and checks every range.
    pub(crate) fn read(file: &Path) -> Result<Meta, LogError> {
        let text = std::fs::read_to_string(file).map_err(|cause| LogError::Read { file: file.into(), cause })?;
        let meta: Meta =
            serde_json::from_str(&text).map_err(|cause| LogError::MetaSyntax { file: file.into(), cause })?;
        meta.check(file)?;
        Ok(meta)
    }

    /// Checks every range; `file` is named in the error.
    pub(crate) fn check(&self, file: &Path) -> Result<(), LogError> {
        let refuse = |key: &str, value: String, expected| {
            Err(LogError::MetaValue { file: file.into(), key: key.to_owned(), value, expected })
        };
        let rates = [("rate_hz", Some(self.rate_hz)), ("policy_hz", self.policy_hz)];
        for (key, rate) in rates.into_iter().filter_map(|(key, rate)| Some((key, rate?))) {
            if !(rate.is_finite() && rate > 0.0) {
                return refuse(key, rate.to_string(), "a finite number greater than 0 [Hz]");
            }
        }
        if self.segments.is_empty() {
            return refuse("segments", "[]".to_owned(), "a list with at least one segment");
        }
        let mut seen = BTreeSet::new();
        for joint in &self.joints {
            // `q_cmd_a` is the command of `a`, so a joint `cmd_a` could have no position.
            if joint.is_empty() || joint.trim() != joint || joint.starts_with("cmd_") {
                return refuse("joints", format!("`{joint}`"), "a name without spaces around it or `cmd_` before it");
            }
            if !seen.insert(joint) {
                return refuse("joints", format!("`{joint}`"), "a list of different names");
            }
        }
        for (key, gain) in [("kp", &self.kp), ("kd", &self.kd)] {
            for value in gain.iter().flat_map(Gain::values) {
                if !(value.is_finite() && *value >= 0.0) {
                    return refuse(key, value.to_string(), "finite and not negative");
                }
            }
        }
        for (key, sigma) in &self.noise {
            if quantity(key).is_none() && Column::parse(key).is_none() {
                let expected = "named after a channel such as `q_FL_hip`, or a quantity such as `q`";
                return refuse(&format!("noise.{key}"), sigma.to_string(), expected);
            }
            if !(sigma.is_finite() && *sigma >= 0.0) {
                return refuse(&format!("noise.{key}"), sigma.to_string(), "finite and not negative");
            }
        }
        Ok(())
    }
}

impl Gain {
    /// The gain of the joint at `index`.
    pub fn of(&self, index: usize) -> Option<f64> {
        match self {
            Gain::Uniform(gain) => Some(*gain),
            Gain::PerJoint(gains) => gains.get(index).copied(),
        }
    }

    fn values(&self) -> &[f64] {
        match self {
            Gain::Uniform(gain) => std::slice::from_ref(gain),
            Gain::PerJoint(gains) => gains,
        }
    }
}
