//! Metadata of a log: `meta.json`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::{Deserialize, Serialize};
use twinstep_model::BaseMount;

use crate::LogError;
use crate::columns::{Column, quantity};

/// Keys of `meta.json`.
pub(crate) const KEYS: [&str; 12] = [
    "rate_hz",
    "policy_hz",
    "joints",
    "tau_sensor",
    "segments",
    "pd",
    "kp",
    "kd",
    "base_quat",
    "noise",
    "source",
    "licence",
];

/// Metadata of a log, the content of `meta.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Meta {
    /// Nominal rate of the rows [Hz].
    pub rate_hz: f64,
    /// Rate of new commands [Hz].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub policy_hz: Option<f64>,
    /// Names of the joints to read; empty for all with columns.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub joints: Vec<String>,
    /// Location of the torque sensor of `tau_measured`.
    pub tau_sensor: TorqueSensor,
    /// Segments; the column `segment` is an index into this list.
    pub segments: Vec<Segment>,
    /// Description of the interpolation and clipping of commands, as text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pd: Option<String>,
    /// Position gain if there is no column for it [N·m/rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kp: Option<Gain>,
    /// Velocity gain if there is no column for it [N·m·s/rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kd: Option<Gain>,
    /// Rotation world-from-base of a fixed base, `[w, x, y, z]`, if it is not level and the log has no `quat`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub base_quat: Option<[f64; 4]>,
    /// Standard deviation of the noise of a channel (`q_FL_hip`) or a quantity (`q`), in the channel's unit.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub noise: BTreeMap<String, f64>,
    /// Source of the log.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// Licence of the log.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub licence: Option<String>,
}

/// Location of the torque sensor of a log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TorqueSensor {
    /// Motor current, multiplied by the torque constant.
    #[serde(rename = "current")]
    MotorCurrent,
    /// Output of the joint.
    #[serde(rename = "output")]
    JointOutput,
    /// Torque was not measured.
    None,
}

/// Named range of rows with one mount of the base.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Segment {
    /// Name, such as `air_chirp`.
    pub name: String,
    /// Mount of the base.
    pub base: BaseMount,
}

/// Gain that is constant over the log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a gain must be a number, or a list with one number for each joint")]
pub enum Gain {
    /// One gain for all joints.
    Uniform(f64),
    /// One gain per joint, in the order of [`Meta::joints`].
    PerJoint(Vec<f64>),
}

impl Gain {
    /// Returns the gains of joints in the order of [`Meta::joints`].
    pub fn by_joint(gains: impl IntoIterator<Item = f64>) -> Self {
        let gains = Vec::from_iter(gains);
        match gains.first() {
            Some(first) if gains.iter().all(|gain| gain == first) => Self::Uniform(*first),
            _ => Self::PerJoint(gains),
        }
    }
}

impl Meta {
    /// Creates metadata with the required values only.
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
            base_quat: None,
            noise: BTreeMap::new(),
            source: None,
            licence: None,
        }
    }

    /// Reads metadata and checks all ranges. Returns them with the names of unknown keys, which are ignored.
    pub(crate) fn read(file: &Path) -> Result<(Meta, Vec<String>), LogError> {
        let text = std::fs::read_to_string(file).map_err(|cause| LogError::Read { file: file.into(), cause })?;
        let wrong = |cause| LogError::MetaSyntax { file: file.into(), cause };
        let meta: Meta = serde_json::from_str(&text).map_err(wrong)?;
        let given: BTreeMap<String, serde_json::Value> = serde_json::from_str(&text).map_err(wrong)?;
        meta.check(file)?;
        Ok((meta, given.into_keys().filter(|key| !KEYS.contains(&key.as_str())).collect()))
    }

    /// Checks all ranges. Errors contain `file`.
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
            // `q_cmd_a` is the command of `a`, so a joint `cmd_a` could not have a position column.
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
        let norm = |quat: [f64; 4]| quat.iter().map(|part| part * part).sum::<f64>().sqrt();
        if let Some(quat) = self.base_quat.filter(|quat| !(0.99..1.01).contains(&norm(*quat))) {
            return refuse("base_quat", format!("{quat:?}"), "four numbers w, x, y, z of norm 1");
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
    /// Returns the gain of the joint at `index`, if there is one.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_those_of_complete_metadata() {
        let all = Meta {
            policy_hz: Some(50.0),
            joints: vec!["FL_hip".to_owned()],
            pd: Some(String::new()),
            kp: Some(Gain::Uniform(30.0)),
            kd: Some(Gain::Uniform(1.0)),
            base_quat: Some([1.0, 0.0, 0.0, 0.0]),
            noise: [("q".to_owned(), 0.001)].into(),
            source: Some(String::new()),
            licence: Some(String::new()),
            ..Meta::new(200.0, TorqueSensor::None, Vec::new())
        };
        let written: serde_json::Map<_, _> =
            serde_json::from_str(&serde_json::to_string(&all).expect("text")).expect("an object");
        let keys: BTreeSet<&str> = written.keys().map(String::as_str).collect();
        assert_eq!(keys, KEYS.into());
    }
}
