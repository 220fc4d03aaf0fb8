//! The nominal robot of a model file: the built-in Go2, or a URDF or MJCF file with its tables `[control]` and
//! `[joints]`.

use crate::shipped_robots::read_to_string;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use twinstep_model::{ControlConfig, Joint, JointKind, NUM_JOINTS, RobotModel, go2};
use twinstep_robot_files::{QuadrupedNames, RobotFileError, quadruped, read_robot};

/// Name of the built-in robot.
pub const BUILT_IN: &str = "go2";

/// The nominal robot, and the keys of the model file that describe it.
#[derive(Clone, Debug, PartialEq)]
pub struct NominalRobot {
    /// Value of `robot`: `go2`, or the absolute path of a robot file.
    pub robot: String,
    /// The table `[control]`.
    pub control: Option<ControlTable>,
    /// The table `[joints]`.
    pub joints: Option<JointsTable>,
    /// The robot without effects.
    pub model: RobotModel,
}

/// Table `[control]`: gains, rates and default pose. Every key is optional for a robot with the joint names of the Go2.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlTable {
    /// Position gain [N·m/rad].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kp: Option<JointGains>,
    /// Velocity gain [N·m·s/rad].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kd: Option<JointGains>,
    /// Joint offset of an action of 1 [rad].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub action_scale: Option<f64>,
    /// Joint positions to which actions are relative [rad], in the order FL, FR, RL, RR; hip, thigh, calf.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub default_pose: Option<[f64; NUM_JOINTS]>,
    /// Rate of the actuators [Hz].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub actuator_hz: Option<f64>,
    /// Rate of the policy [Hz], of which `actuator_hz` is a multiple.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub policy_hz: Option<f64>,
}

/// A gain of all joints, of each kind of joint, or of each joint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "expected a number, twelve numbers in the order FL, FR, RL, RR; hip, thigh, calf, or a table with `hip`, `thigh` \
                 and `calf`"
)]
pub enum JointGains {
    /// The same for all joints.
    All(f64),
    /// One for each joint, in the order FL, FR, RL, RR; hip, thigh, calf.
    Each([f64; NUM_JOINTS]),
    /// One for each kind of joint.
    Kinds(KindGains),
}

/// Gains by kind of joint.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KindGains {
    /// Hips.
    pub hip: f64,
    /// Thighs.
    pub thigh: f64,
    /// Calves.
    pub calf: f64,
}

impl JointGains {
    /// Returns the gain of each joint.
    pub fn by_joint(&self) -> [f64; NUM_JOINTS] {
        match self {
            Self::All(gain) => [*gain; NUM_JOINTS],
            Self::Each(gains) => *gains,
            Self::Kinds(KindGains { hip, thigh, calf }) => Joint::ALL.map(|joint| match joint.kind {
                JointKind::Hip => *hip,
                JointKind::Thigh => *thigh,
                JointKind::Calf => *calf,
            }),
        }
    }
}

/// Table `[joints]`: names in a robot file that are not the Go2's.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointsTable {
    /// Joint names in the order FL, FR, RL, RR; hip, thigh, calf.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub names: Option<[String; NUM_JOINTS]>,
    /// Feet in the order FL, FR, RL, RR: links of a URDF, geoms of an MJCF.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub feet: Option<[String; 4]>,
}

/// Reason why a nominal robot was rejected.
#[derive(Debug, thiserror::Error)]
pub enum NominalRobotError {
    /// The value of `robot` is neither a built-in robot nor a file.
    #[error("`robot` = \"{robot}\" is unknown; possible: \"go2\", or a file that ends with .urdf or .xml (MJCF)")]
    Unknown {
        /// Value of `robot`.
        robot: String,
    },
    /// The robot file could not be read.
    #[error("`robot`: cannot read {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The robot file is not a robot with the tree of the Go2.
    #[error("`robot`: {}: {cause}", path.display())]
    Import {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        cause: RobotFileError,
    },
    /// A key of `[control]` is missing or not allowed.
    #[error("`control.{key}` is {found}; {expected} expected")]
    Control {
        /// The key.
        key: &'static str,
        /// Its value, or `missing`.
        found: String,
        /// What is expected.
        expected: &'static str,
    },
    /// The built-in robot has no `[joints]`.
    #[error("`[joints]` is for robot files; the names of the built-in `go2` are fixed")]
    Joints,
}

impl NominalRobot {
    /// Returns the built-in Go2.
    pub fn go2() -> Self {
        Self { robot: BUILT_IN.to_owned(), control: None, joints: None, model: go2() }
    }

    /// Reads the nominal robot. `folder` is that of the model file, to which paths are relative.
    pub fn read(
        robot: &str,
        control: Option<ControlTable>,
        joints: Option<JointsTable>,
        folder: &Path,
    ) -> Result<Self, NominalRobotError> {
        let table = control.clone().unwrap_or_default();
        if robot == BUILT_IN {
            if joints.is_some() {
                return Err(NominalRobotError::Joints);
            }
            let model = RobotModel { control: table.config(true)?, ..go2() };
            return Ok(Self { robot: robot.to_owned(), control, joints, model });
        }
        if !is_robot_file(Path::new(robot)) {
            return Err(NominalRobotError::Unknown { robot: robot.to_owned() });
        }
        let path = folder.join(robot);
        // Absolute, so that the model is still valid after a tool writes it to another folder.
        let path = std::path::absolute(&path).unwrap_or(path);
        let text =
            read_to_string(&path).map_err(|source| NominalRobotError::Unreadable { path: path.clone(), source })?;
        let JointsTable { names, feet } = joints.clone().unwrap_or_default();
        let config = table.config(names.is_none())?;
        let (model, notes) = read_robot(&text, path.parent())
            .and_then(|file| quadruped(&file, &QuadrupedNames { joints: names, feet }, config))
            .map_err(|cause| NominalRobotError::Import { path: path.clone(), cause })?;
        for note in notes {
            tracing::warn!("{}: {note}", path.display());
        }
        Ok(Self { robot: path.display().to_string(), control, joints, model })
    }
}

impl NominalRobot {
    /// Returns the robot with other gains, rates, scale and pose. Keys that `control` lacks keep their values.
    pub fn with_control(&self, control: &ControlTable) -> Result<Self, NominalRobotError> {
        let own = self.control.clone().unwrap_or_default();
        let control = ControlTable {
            kp: control.kp.clone().or(own.kp),
            kd: control.kd.clone().or(own.kd),
            action_scale: control.action_scale.or(own.action_scale),
            default_pose: control.default_pose.or(own.default_pose),
            actuator_hz: control.actuator_hz.or(own.actuator_hz),
            policy_hz: control.policy_hz.or(own.policy_hz),
        };
        let has_go2_names = self.joints.as_ref().is_none_or(|joints| joints.names.is_none());
        let model = RobotModel { control: control.config(has_go2_names)?, ..self.model.clone() };
        Ok(Self { control: Some(control), model, ..self.clone() })
    }
}

/// Returns true if the name of a file is that of a robot file.
pub fn is_robot_file(path: &Path) -> bool {
    path.extension().is_some_and(|end| end.eq_ignore_ascii_case("urdf") || end.eq_ignore_ascii_case("xml"))
}

impl ControlTable {
    /// Returns the control settings. Missing keys are those of the Go2 if the robot has its joint names, else an error.
    fn config(&self, is_go2: bool) -> Result<ControlConfig, NominalRobotError> {
        let default = go2().control;
        let number = |key, given: Option<f64>, default: f64, allowed: std::ops::RangeInclusive<f64>, expected| {
            let value = given.or(is_go2.then_some(default));
            let error = |found: String| NominalRobotError::Control { key, found, expected };
            let value = value.ok_or_else(|| error("missing".to_owned()))?;
            if allowed.contains(&value) { Ok(value) } else { Err(error(value.to_string())) }
        };
        let gains = |key,
                     given: &Option<JointGains>,
                     default: [f64; NUM_JOINTS],
                     allowed: std::ops::RangeInclusive<f64>,
                     expected| {
            let gains = given.as_ref().map(JointGains::by_joint).or(is_go2.then_some(default));
            let error = |found: String| NominalRobotError::Control { key, found, expected };
            let gains = gains.ok_or_else(|| error("missing".to_owned()))?;
            match gains.iter().find(|gain| !allowed.contains(gain)) {
                Some(gain) => Err(error(gain.to_string())),
                None => Ok(gains),
            }
        };
        let policy_hz = default.actuator_hz / default.decimation as f64;
        let actuator_hz = number("actuator_hz", self.actuator_hz, default.actuator_hz, 20.0..=2000.0, "20 to 2000 Hz")?;
        let policy_hz = number("policy_hz", self.policy_hz, policy_hz, 1.0..=actuator_hz, "1 Hz to `actuator_hz`")?;
        let decimation = (actuator_hz / policy_hz).round();
        if (decimation * policy_hz - actuator_hz).abs() > 1e-6 * actuator_hz {
            let (key, found) = ("policy_hz", policy_hz.to_string());
            return Err(NominalRobotError::Control {
                key,
                found,
                expected: "a rate of which `actuator_hz` is a multiple",
            });
        }
        let default_pose = self.default_pose.or(is_go2.then_some(default.default_pose));
        let pose_error = |found: String| NominalRobotError::Control {
            key: "default_pose",
            found,
            expected: "twelve positions within ±2π rad",
        };
        let default_pose = default_pose.ok_or_else(|| pose_error("missing".to_owned()))?;
        let allowed = -std::f64::consts::TAU..=std::f64::consts::TAU;
        if let Some(value) = default_pose.iter().find(|value| !allowed.contains(value)) {
            return Err(pose_error(value.to_string()));
        }
        Ok(ControlConfig {
            kp: gains("kp", &self.kp, default.kp, 0.0..=1e5, "0 to 100000 N·m/rad")?,
            kd: gains("kd", &self.kd, default.kd, 0.0..=1e4, "0 to 10000 N·m·s/rad")?,
            action_scale: number(
                "action_scale",
                self.action_scale,
                default.action_scale,
                1e-3..=10.0,
                "0.001 to 10 rad",
            )?,
            default_pose,
            actuator_hz,
            decimation: decimation as usize,
        })
    }
}
