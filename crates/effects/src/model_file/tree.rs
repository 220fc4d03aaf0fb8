//! Model file of a robot of any tree: a robot file, its gains, and effects at its joints.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

use toml::{Table, Value};
use twinstep_model::{JOINT_NAMES, JointModel, MjcfOptions, NUM_JOINTS, TreeModel, go2, mjcf};
use twinstep_robot_files::{FileControl, read_robot};

use super::effect_table::{EffectTable, key_error, read_table, write_table};
use super::error::{EffectEntryError, ModelFileError};
use super::tree_shapes::{ShapeText, with_shapes};
use super::tree_text::{Control, Joints, NominalGain, Pose, TreeGroups, TreeText};
use crate::nominal::{BUILT_IN, JointsTable, NominalRobotError, is_robot_file};
use crate::shipped_robots::{read_to_string, resolved};
use crate::{Apply, CATALOGUE, Effect, LEAST_SUM, parse_toml};

/// A robot of any tree, and the effects at its joints.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeModelFile {
    /// Value of `robot`: `go2`, or the absolute path of a robot file.
    pub robot: String,
    /// The robot without effects, with the names of [`TreeModelFile::rename`].
    pub nominal: TreeModel,
    /// Gains and pose of the controllers inside the robot file, with the names of [`TreeModelFile::rename`]. They hold where the model file
    /// states none, for control alone: a measured robot has its own.
    pub of_robot_file: FileControl,
    /// Names for joints of the robot file, such as those of a log. By the name in the robot file.
    pub rename: BTreeMap<String, String>,
    /// Position gain of each joint [N·m/rad]; `None` if it is unknown.
    pub kp: Option<NominalGain>,
    /// Velocity gain of each joint [N·m·s/rad].
    pub kd: Option<NominalGain>,
    /// Rate of the actuators [Hz]; `None` if the file states none.
    pub actuator_hz: Option<f64>,
    /// Rate of the policy [Hz], of which that of the actuators is a multiple.
    pub policy_hz: Option<f64>,
    /// Joint offset of an action of 1 [rad].
    pub action_scale: Option<f64>,
    /// Joint positions to which actions are relative [rad]. Joints that are left out: their
    /// position in the keyframe of the robot file, else 0, or the nearest position in their range.
    pub default_pose: BTreeMap<String, f64>,
    /// Links and joints that tasks need, by name.
    pub groups: TreeGroups,
    /// Collision shapes that replace those of the robot file, by link.
    pub shapes: BTreeMap<String, Vec<ShapeText>>,
    /// Effects, in the order of the file.
    pub effects: Vec<JointEffect>,
}

/// Effect at joints, with its values.
#[derive(Clone, Debug, PartialEq)]
pub struct JointEffect {
    /// The effect.
    pub effect: &'static Effect,
    /// The joints.
    pub scope: JointScope,
    /// Values of all parameters, in the order of the effect's parameters.
    pub values: Vec<f64>,
    /// 95 % interval of each value, low and high; `None` if it was not measured.
    pub intervals: Vec<Option<[f64; 2]>>,
}

/// Joints of a robot of any tree.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum JointScope {
    /// All joints.
    All,
    /// The joint with this name.
    Joint(String),
}

impl fmt::Display for JointScope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::All => f.write_str("all"),
            Self::Joint(name) => f.write_str(name),
        }
    }
}

impl TreeModelFile {
    /// Returns the ideal Go2, whose gains are unknown.
    pub fn go2() -> Self {
        let text = mjcf(&go2(), &MjcfOptions::default());
        let file = read_robot(&text, None).expect("its own model is supported");
        let nominal = TreeModel::new(file.tree).expect("its forces are the same in both directions");
        Self::ideal(BUILT_IN, nominal)
    }

    pub(super) fn ideal(robot: &str, nominal: TreeModel) -> Self {
        Self {
            robot: robot.to_owned(),
            nominal,
            of_robot_file: FileControl::default(),
            rename: BTreeMap::new(),
            kp: None,
            kd: None,
            actuator_hz: None,
            policy_hz: None,
            action_scale: None,
            default_pose: BTreeMap::new(),
            groups: TreeGroups::default(),
            shapes: BTreeMap::new(),
            effects: Vec::new(),
        }
    }

    /// Returns true if a text has keys that only the model file of a tree has: names of joints, or gains by joint.
    pub fn is_meant(text: &str) -> bool {
        let Ok(table) = parse_toml::<Table>(text) else { return false };
        let is_table =
            |name: &str, key: &str| table.get(name).and_then(|table| table.get(key)).is_some_and(Value::is_table);
        ["groups", "shapes"].iter().any(|key| table.contains_key(*key))
            || is_table("joints", "rename")
            || ["kp", "kd", "default_pose"].iter().any(|key| is_table("control", key))
    }

    /// Reads a model file, or a robot file (URDF, MJCF) as a model without effects. Paths in it become absolute.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ModelFileError> {
        let path = &*resolved(path.as_ref());
        if is_robot_file(path) {
            return Self::parse(&format!("robot = {}", Value::from(path.display().to_string())), "`--model`");
        }
        let text =
            read_to_string(path).map_err(|source| ModelFileError::Unreadable { path: path.to_owned(), source })?;
        Self::parse_in(path.parent().unwrap_or(Path::new("")), &text, &path.display().to_string())
    }

    /// Parses the text of a model file. Errors use `name` for the file. Paths are relative to the working directory.
    pub fn parse(text: &str, name: &str) -> Result<Self, ModelFileError> {
        Self::parse_in(Path::new(""), text, name)
    }

    fn parse_in(folder: &Path, text: &str, name: &str) -> Result<Self, ModelFileError> {
        let malformed = |message: String| ModelFileError::Malformed { name: name.to_owned(), message };
        let TreeText { robot, control, joints, groups, shapes, effect } =
            parse_toml(text).map_err(|error| malformed(error.to_string()))?;
        let mut file = if robot == BUILT_IN { Self::go2() } else { Self::read_robot_file(&robot, folder, name)? };
        file.rename_joints(joints.rename).map_err(malformed)?;
        let Control { kp, kd, actuator_hz, policy_hz, action_scale, default_pose } = control;
        for (key, gain) in [("kp", &kp), ("kd", &kd)] {
            file.check_gain(key, gain.as_ref()).map_err(malformed)?;
        }
        let ranges = [
            ("actuator_hz", actuator_hz, 20.0..=2000.0, "20 to 2000 Hz"),
            ("policy_hz", policy_hz, 1.0..=2000.0, "1 to 2000 Hz"),
            ("action_scale", action_scale, 1e-3..=10.0, "0.001 to 10 rad"),
        ];
        for (key, value, range, expected) in ranges {
            if let Some(value) = value.filter(|value| !range.contains(value)) {
                return Err(malformed(format!("`control.{key}` is {value}; {expected} expected")));
            }
        }
        let default_pose = match default_pose {
            Pose::PerJoint(pose) => pose,
            Pose::Quadruped(pose) => file.quadruped_pose(pose, joints.of_quadruped.names).map_err(malformed)?,
        };
        file.check_pose(&default_pose).map_err(malformed)?;
        file.check_groups(&groups).map_err(malformed)?;
        file.groups = groups;
        file.nominal = with_shapes(file.nominal, &shapes).map_err(malformed)?;
        file.shapes = shapes;
        (file.kp, file.kd, file.actuator_hz) = (kp, kd, actuator_hz);
        (file.policy_hz, file.action_scale, file.default_pose) = (policy_hz, action_scale, default_pose);
        for (index, table) in effect.iter().enumerate() {
            let refused = |problem| ModelFileError::Effect { name: name.to_owned(), number: index + 1, problem };
            let entry = file.read_effect(table).map_err(refused)?;
            file.effects.push(entry);
        }
        file.tree_model().map_err(malformed)?;
        Ok(file)
    }

    fn read_robot_file(robot: &str, folder: &Path, name: &str) -> Result<Self, ModelFileError> {
        let refused = |cause| ModelFileError::Robot { name: name.to_owned(), cause: Box::new(cause) };
        if !is_robot_file(Path::new(robot)) {
            return Err(refused(NominalRobotError::Unknown { robot: robot.to_owned() }));
        }
        let path = folder.join(robot);
        let path = std::path::absolute(&path).unwrap_or(path);
        let text = read_to_string(&path)
            .map_err(|source| refused(NominalRobotError::Unreadable { path: path.clone(), source }))?;
        let file = read_robot(&text, path.parent())
            .map_err(|cause| refused(NominalRobotError::Import { path: path.clone(), cause }))?;
        for note in &file.notes {
            tracing::warn!("{}: {note}", path.display());
        }
        let nominal = TreeModel::new(file.tree).map_err(|cause| ModelFileError::Malformed {
            name: path.display().to_string(),
            message: cause.to_string(),
        })?;
        Ok(Self { of_robot_file: file.control, ..Self::ideal(&path.display().to_string(), nominal) })
    }

    fn rename_joints(&mut self, rename: BTreeMap<String, String>) -> Result<(), String> {
        let joints = &mut self.nominal.tree.joints;
        for (old, new) in &rename {
            let names = joints.iter().map(|joint| joint.name.as_str()).collect::<Vec<_>>().join(", ");
            let found = joints.iter_mut().find(|joint| joint.name == *old);
            found
                .ok_or_else(|| format!("`joints.rename`: the robot has no joint `{old}`; its joints are {names}"))?
                .name = new.clone();
        }
        let mut seen = BTreeSet::new();
        if let Some(twice) = joints.iter().find(|joint| !seen.insert(&joint.name)) {
            return Err(format!("`joints.rename`: two joints are named `{}`", twice.name));
        }
        let FileControl { gains, home } = std::mem::take(&mut self.of_robot_file);
        self.of_robot_file = FileControl { gains: renamed(gains, &rename), home: renamed(home, &rename) };
        self.rename = rename;
        Ok(())
    }

    fn check_gain(&self, key: &str, gain: Option<&NominalGain>) -> Result<(), String> {
        let values = match gain {
            None => return Ok(()),
            Some(NominalGain::All(value)) => vec![*value],
            Some(NominalGain::PerJoint(gains)) => {
                if let Some(joint) = gains.keys().find(|joint| self.nominal.tree.joint(joint).is_none()) {
                    return Err(format!("`control.{key}`: the robot has no joint `{joint}`; {}", self.joints_are()));
                }
                gains.values().copied().collect()
            }
        };
        match values.into_iter().find(|value| !(value.is_finite() && *value >= 0.0)) {
            Some(value) => Err(format!("`control.{key}` is {value}; finite and not negative expected")),
            None => Ok(()),
        }
    }

    /// Returns the pose of a quadruped by the names of its joints: `names`, or those of the Go2 with or without `_joint`.
    fn quadruped_pose(
        &self,
        pose: [f64; NUM_JOINTS],
        names: Option<[String; NUM_JOINTS]>,
    ) -> Result<BTreeMap<String, f64>, String> {
        let names = names.unwrap_or_else(|| JOINT_NAMES.map(str::to_owned));
        let own = |name: String| {
            let long = format!("{name}_joint");
            let found = [&name, &long].into_iter().find(|name| self.nominal.tree.joint(name).is_some()).cloned();
            found.ok_or_else(|| {
                format!("`control.default_pose` is a list, and the robot has no joint `{name}`; {}", self.joints_are())
            })
        };
        names.into_iter().map(own).zip(pose).map(|(name, position)| Ok((name?, position))).collect()
    }

    fn check_pose(&self, pose: &BTreeMap<String, f64>) -> Result<(), String> {
        for (joint, position) in pose {
            let Some(index) = self.nominal.tree.joint(joint) else {
                return Err(format!("`control.default_pose`: the robot has no joint `{joint}`; {}", self.joints_are()));
            };
            let [low, high] = self.nominal.joints[index].range;
            if !(low..=high).contains(position) || !position.is_finite() {
                return Err(format!("`control.default_pose.{joint}` is {position}; {low} to {high} expected"));
            }
        }
        Ok(())
    }

    fn check_groups(&self, groups: &TreeGroups) -> Result<(), String> {
        let tree = &self.nominal.tree;
        for (key, names) in [("foot", &groups.foot), ("hip", &groups.hip)] {
            let mut seen = BTreeSet::new();
            if let Some(twice) = names.iter().flatten().find(|name| !seen.insert(*name)) {
                return Err(format!("`groups.{key}`: `{twice}` is there twice"));
            }
        }
        let mut feet = groups.foot.iter().flatten();
        if let Some(foot) = feet.find(|foot| tree.link(foot).is_none()) {
            let links: Vec<_> = tree.bodies.iter().map(|body| body.name.as_str()).collect();
            return Err(format!("`groups.foot`: the robot has no link `{foot}`; its links are {}", links.join(", ")));
        }
        match groups.hip.iter().flatten().find(|hip| tree.joint(hip).is_none()) {
            Some(hip) => Err(format!("`groups.hip`: the robot has no joint `{hip}`; {}", self.joints_are())),
            None => Ok(()),
        }
    }

    /// Returns the default pose of all joints [rad].
    pub fn pose(&self) -> Vec<f64> {
        let joints = self.nominal.tree.joints.iter().zip(&self.nominal.joints);
        let position = |name: &str, [low, high]: [f64; 2]| {
            let stated = self.default_pose.get(name).copied();
            stated.unwrap_or_else(|| self.of_robot_file.home.get(name).copied().unwrap_or(0.0).clamp(low, high))
        };
        joints.map(|(tree, joint)| position(&tree.name, joint.range)).collect()
    }

    fn joints_are(&self) -> String {
        let names: Vec<_> = self.nominal.tree.joints.iter().map(|joint| joint.name.as_str()).collect();
        format!("its joints are {}", names.join(", "))
    }

    fn read_effect(&self, table: &Table) -> Result<JointEffect, EffectEntryError> {
        let EffectTable { effect, scope, values, intervals } = read_table(table)?;
        if let Apply::Robot(_) = effect.apply {
            let of_joints = CATALOGUE.iter().filter(|effect| matches!(effect.apply, Apply::Joint(_)));
            let names: Vec<_> = of_joints.map(|effect| effect.name).collect();
            let expected = format!("an effect of joints, because the robot is not like the Go2: {}", names.join(", "));
            return Err(key_error("name", table.get("name"), &expected));
        }
        let parameters = effect.parameters.iter().flat_map(|parameter| std::iter::repeat_n(parameter, parameter.count));
        for (parameter, value) in parameters.zip(&values) {
            if !value.is_finite() && *value != parameter.no_effect_value {
                return Err(key_error(parameter.name, table.get(parameter.name), "a finite number"));
            }
        }
        let scope = self.scope(&scope).map_err(|expected| key_error("scope", table.get("scope"), &expected))?;
        Ok(JointEffect { effect, scope, values, intervals })
    }

    /// Returns the scope of this name, or what is expected.
    pub fn scope(&self, name: &str) -> Result<JointScope, String> {
        match name {
            "all" => Ok(JointScope::All),
            joint if self.nominal.tree.joint(joint).is_some() => Ok(JointScope::Joint(joint.to_owned())),
            _ => Err(format!("all, or a joint; {}", self.joints_are())),
        }
    }

    /// Returns the robot with all effects applied, those of all joints before those of one. Fails with the reason if a joint is impossible.
    pub fn tree_model(&self) -> Result<TreeModel, String> {
        let mut robot = self.nominal.clone();
        let (wide, narrow): (Vec<_>, Vec<_>) = self.effects.iter().partition(|entry| entry.scope == JointScope::All);
        for entry in wide.into_iter().chain(narrow) {
            let Apply::Joint(change) = entry.effect.apply else { continue };
            for (joint, tree) in robot.joints.iter_mut().zip(&robot.tree.joints) {
                if entry.scope != JointScope::All && entry.scope != JointScope::Joint(tree.name.clone()) {
                    continue;
                }
                let problem = change(joint, &entry.values).err().or_else(|| impossible(joint));
                if let Some(problem) = problem {
                    return Err(format!(
                        "`{}` on {}: {problem} of joint `{}`",
                        entry.effect.name, entry.scope, tree.name
                    ));
                }
            }
        }
        Ok(robot)
    }

    /// Returns the text of the file. [`TreeModelFile::parse`] reads exactly the same model from it.
    pub fn to_toml(&self) -> String {
        let TreeModelFile {
            robot,
            rename,
            kp,
            kd,
            actuator_hz,
            policy_hz,
            action_scale,
            default_pose,
            groups,
            shapes,
            ..
        } = self.clone();
        let head = TreeText {
            robot,
            control: Control {
                kp,
                kd,
                actuator_hz,
                policy_hz,
                action_scale,
                default_pose: Pose::PerJoint(default_pose),
            },
            joints: Joints { rename, of_quadruped: JointsTable::default() },
            groups,
            shapes,
            effect: Vec::new(),
        };
        let mut text = toml::to_string(&head).expect("numbers by names");
        for JointEffect { effect, scope, values, intervals } in &self.effects {
            let (scope, values, intervals) = (scope.to_string(), values.clone(), intervals.clone());
            write_table(&mut text, &EffectTable { effect, scope, values, intervals });
        }
        text
    }
}

/// Returns values by the new names of joints.
fn renamed<T>(values: BTreeMap<String, T>, rename: &BTreeMap<String, String>) -> BTreeMap<String, T> {
    values.into_iter().map(|(joint, value)| (rename.get(&joint).cloned().unwrap_or(joint), value)).collect()
}

/// Returns which number of a joint is impossible, or `None` if none is.
fn impossible(joint: &JointModel) -> Option<&'static str> {
    let actuator = &joint.actuator;
    let numbers = [
        ("a negative rotor inertia", joint.armature),
        ("a negative viscous friction", joint.viscous_friction),
        ("a negative Coulomb friction", joint.coulomb_friction),
        ("a negative Stribeck friction", joint.stribeck_friction.breakaway_torque),
        ("a negative load friction", joint.load_friction),
        ("a negative delay of the command", actuator.command_delay),
        ("a negative delay of the torque", actuator.torque_delay),
        ("a negative delay of the torque sensor", actuator.sensor_delay),
        ("a negative factor of the position gain", actuator.kp_scale),
        ("a negative factor of the velocity gain", actuator.kd_scale),
        ("a negative time constant", actuator.torque_time_constant),
        ("a negative backlash", actuator.backlash),
        ("a negative dead zone", actuator.dead_zone),
    ];
    let wrong = numbers.into_iter().find(|(_, value)| value.is_nan() || *value < LEAST_SUM).map(|(what, _)| what);
    let moved = actuator.backlash > 0.0 || actuator.gear_stiffness.is_finite();
    wrong.or_else(|| (moved && joint.armature <= 0.0).then_some("backlash or gear elasticity without rotor inertia"))
}
