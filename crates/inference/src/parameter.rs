//! Free parameters, and the candidates that they make.

use std::collections::BTreeMap;

use twinstep_effects::{Effect, JointEffect, JointScope, NominalGain, TreeModelFile};
use twinstep_model::{TreeJointKind, TreeModel};

use crate::{InferenceError, JointLog, JointScale, Quantity};

/// Request of the user: an effect with a scope, as in `coulomb_friction@each`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterRequest(pub String);

impl ParameterRequest {
    /// The requests if the user makes none. Unknown gains are estimated in any case.
    pub const DEFAULT: [&'static str; 4] =
        ["armature@each", "viscous_friction@each", "coulomb_friction@each", "command_delay@all"];

    /// Returns the parameters that are meant.
    fn parameters(
        &self,
        file: &TreeModelFile,
        joints: &[usize],
    ) -> Result<Vec<(Quantity, Vec<usize>)>, InferenceError> {
        let given = self.0.clone();
        let unknown_quantity = || {
            let mut names: Vec<_> = Quantity::ALL.iter().map(|quantity| quantity.effect()).collect();
            names.dedup();
            InferenceError::UnknownQuantity { given: self.0.clone(), possible: names.join(", ") }
        };
        let (effect, scope) = self.0.split_once('@').ok_or_else(unknown_quantity)?;
        let quantities: Vec<_> = Quantity::ALL.into_iter().filter(|quantity| quantity.effect() == effect).collect();
        if quantities.is_empty() {
            return Err(unknown_quantity());
        }
        let tree = &file.nominal.tree;
        let scopes = match scope {
            "all" => vec![joints.to_vec()],
            "each" => joints.iter().map(|joint| vec![*joint]).collect(),
            name => {
                let joint = joints.iter().find(|joint| tree.joints[**joint].name == name);
                let names: Vec<_> = joints.iter().map(|joint| tree.joints[*joint].name.as_str()).collect();
                let unknown =
                    || InferenceError::UnknownScope { given, scope: name.to_owned(), joints: names.join(", ") };
                vec![vec![*joint.ok_or_else(unknown)?]]
            }
        };
        Ok(quantities
            .into_iter()
            .flat_map(|quantity| scopes.iter().map(move |scope| (quantity, scope.clone())))
            .collect())
    }
}

/// A quantity at joints, which share its value. Its coordinate is the distance of the value from the prior's median [prior std].
#[derive(Clone, Debug, PartialEq)]
pub struct FreeParameter {
    /// What is estimated.
    pub quantity: Quantity,
    /// Indices of the joints.
    pub joints: Vec<usize>,
    /// Name of the joint, or `all`.
    pub scope: JointScope,
    /// Median, and standard deviation of the logarithm, of the prior.
    pub prior: [f64; 2],
    /// Unit of the value.
    pub unit: &'static str,
    /// True for a gain that the log states: the value is the factor on it.
    pub is_factor: bool,
}

impl FreeParameter {
    /// Returns the parameters that are requested at the joints of a log, and the gains that it does not state.
    pub fn of(
        requests: &[ParameterRequest],
        file: &TreeModelFile,
        log: &JointLog,
    ) -> Result<Vec<Self>, InferenceError> {
        let joints: Vec<usize> = log.joints.iter().map(|joint| joint.joint).collect();
        let mut meant = Vec::new();
        for request in requests {
            meant.extend(request.parameters(file, &joints)?);
        }
        for quantity in [Quantity::PositionGain, Quantity::VelocityGain] {
            for joint in joints.iter().filter(|joint| !log.states_gain(quantity, **joint)) {
                let is_requested = meant.iter().any(|(other, joints)| *other == quantity && joints.contains(joint));
                if !is_requested {
                    meant.push((quantity, vec![*joint]));
                }
            }
        }
        let scales = JointScale::of(&file.nominal);
        let parameter = |(quantity, joints): (Quantity, Vec<usize>)| {
            let stated = |joint: &usize| log.states_gain(quantity, *joint);
            let priors: Vec<_> = joints.iter().map(|joint| quantity.prior(&scales[*joint], stated(joint))).collect();
            let log_median = priors.iter().map(|[median, _]| median.ln()).sum::<f64>() / priors.len() as f64;
            let widest = priors.iter().map(|[_, std]| *std).fold(0.0, f64::max);
            let is_gain = matches!(quantity, Quantity::PositionGain | Quantity::VelocityGain);
            let is_factor = is_gain && (joints.len() > 1 || joints.iter().all(stated));
            let scope = match joints.as_slice() {
                [joint] => JointScope::Joint(file.nominal.tree.joints[*joint].name.clone()),
                _ => JointScope::All,
            };
            let is_slide = joints.iter().all(|joint| file.nominal.tree.joints[*joint].kind == TreeJointKind::Prismatic);
            let unit = if is_factor { "" } else { unit(quantity, is_slide) };
            Self { quantity, unit, joints, scope, prior: [log_median.exp(), widest], is_factor }
        };
        let mut all: Vec<Self> = meant.into_iter().map(parameter).collect();
        all.sort_by_key(|parameter| (parameter.quantity, parameter.joints.clone()));
        let twice = |pair: &&[Self]| {
            pair[0].quantity == pair[1].quantity && pair[1].joints.iter().any(|joint| pair[0].joints.contains(joint))
        };
        match all.windows(2).find(twice) {
            Some(pair) => Err(InferenceError::Twice { name: pair[1].name() }),
            None => Ok(all),
        }
    }

    /// Returns the name, such as `coulomb_friction@elbow`.
    pub fn name(&self) -> String {
        let suffix = match self.quantity {
            Quantity::PositionGain => ".kp",
            Quantity::VelocityGain => ".kd",
            _ => "",
        };
        format!("{}@{}{suffix}", self.quantity.effect(), self.scope)
    }

    /// Returns the value at a coordinate.
    pub fn value(&self, coordinate: f64) -> f64 {
        let [low, high] = self.quantity.bounds();
        (self.prior[0] * (self.prior[1] * coordinate).exp()).clamp(low, high)
    }

    /// Returns the coordinate of a value, at least −3: values near zero are alike.
    pub fn coordinate(&self, value: f64) -> f64 {
        ((value.max(1e-12) / self.prior[0]).ln() / self.prior[1]).clamp(-3.0, 3.0)
    }
}

fn unit(quantity: Quantity, is_slide: bool) -> &'static str {
    match (quantity, is_slide) {
        (Quantity::Armature, false) => "kg·m²",
        (Quantity::Armature, true) => "kg",
        (Quantity::ViscousFriction | Quantity::VelocityGain, false) => "N·m·s/rad",
        (Quantity::ViscousFriction | Quantity::VelocityGain, true) => "N·s/m",
        (Quantity::CoulombFriction, false) => "N·m",
        (Quantity::CoulombFriction, true) => "N",
        (Quantity::CommandDelay, _) => "s",
        (Quantity::PositionGain, false) => "N·m/rad",
        (Quantity::PositionGain, true) => "N/m",
    }
}

/// A robot with the gains that stand for unknown ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The robot.
    pub robot: TreeModel,
    /// Position gain of each joint that the log does not state [N·m/rad].
    pub kp: Vec<f64>,
    /// Velocity gain of each joint that the log does not state [N·m·s/rad].
    pub kd: Vec<f64>,
}

impl Candidate {
    /// Returns the robot of a model file. Gains that neither log nor file state are those of [`JointScale`].
    pub fn of(file: &TreeModelFile) -> Result<Self, InferenceError> {
        let robot = file.tree_model().map_err(InferenceError::Model)?;
        let gains = |given: &Option<NominalGain>, default: fn(&JointScale) -> f64| -> Vec<f64> {
            let joints = robot.tree.joints.iter().zip(JointScale::of(&file.nominal));
            let of = |joint: &str| given.as_ref().and_then(|gains| gains.of(joint));
            joints.map(|(joint, scale)| of(&joint.name).unwrap_or_else(|| default(&scale))).collect()
        };
        let (kp, kd) = (gains(&file.kp, JointScale::kp), gains(&file.kd, JointScale::kd));
        Ok(Self { robot, kp, kd })
    }

    /// Returns the candidate at a point: one coordinate for each parameter.
    pub fn at(&self, parameters: &[FreeParameter], point: &[f64]) -> Self {
        let mut moved = self.clone();
        for (parameter, coordinate) in parameters.iter().zip(point) {
            let value = parameter.value(*coordinate);
            for joint in &parameter.joints {
                parameter.quantity.set(&mut moved.robot.joints[*joint], value);
            }
        }
        moved
    }

    /// Returns the value that a report states: an unknown gain itself in place of its factor.
    pub fn reported(&self, parameter: &FreeParameter, value: f64) -> f64 {
        if parameter.is_factor {
            return value;
        }
        match (parameter.quantity, parameter.joints.as_slice()) {
            (Quantity::PositionGain, [joint]) => value * self.kp[*joint],
            (Quantity::VelocityGain, [joint]) => value * self.kd[*joint],
            _ => value,
        }
    }
}

/// Writes estimated values, with their intervals, to the model file.
///
/// A file states what is added to the robot file. Gains that the log does not state become those of the file, with a factor of 1 that
/// carries the interval.
pub fn write_estimates(
    file: &mut TreeModelFile,
    before: &Candidate,
    log: &JointLog,
    parameters: &[FreeParameter],
    values: &[(f64, [f64; 2])],
) {
    let names: Vec<String> = file.nominal.tree.joints.iter().map(|joint| joint.name.clone()).collect();
    let estimated = |effect: &str, joint: usize| {
        parameters.iter().any(|parameter| parameter.quantity.effect() == effect && parameter.joints.contains(&joint))
    };
    file.effects = std::mem::take(&mut file.effects)
        .into_iter()
        .flat_map(|entry| without(entry, &names, &|effect, joint| estimated(effect, joint)))
        .collect();
    let kept = file.tree_model().expect("it was possible with more entries");
    let mut entries = BTreeMap::<(&str, usize), (Vec<f64>, Vec<Option<[f64; 2]>>)>::new();
    for (parameter, (value, interval)) in parameters.iter().zip(values) {
        for joint in &parameter.joints {
            let effect = parameter.quantity.effect();
            let actuator = &before.robot.joints[*joint].actuator;
            let start = if effect == "pd_gain" { vec![actuator.kp_scale, actuator.kd_scale] } else { vec![0.0] };
            let (numbers, intervals) =
                entries.entry((effect, *joint)).or_insert_with(|| (start.clone(), vec![None; start.len()]));
            let (slot, gains, table) = match parameter.quantity {
                Quantity::VelocityGain => (1, &before.kd, &mut file.kd),
                _ => (0, &before.kp, &mut file.kp),
            };
            let own = parameter.quantity.get(&kept.joints[*joint]);
            if effect != "pd_gain" {
                (numbers[slot], intervals[slot]) = (value - own, Some(interval.map(|end| end - own)));
            } else if log.states_gain(parameter.quantity, *joint) {
                (numbers[slot], intervals[slot]) = (*value, Some(*interval));
            } else {
                set_gain(table, &names, *joint, gains[*joint] * value);
                (numbers[slot], intervals[slot]) = (1.0, Some(interval.map(|end| end / value)));
            }
        }
    }
    for ((effect, joint), (values, intervals)) in entries {
        let effect = Effect::named(effect).expect("a quantity has an effect of the catalogue");
        file.effects.push(JointEffect { effect, scope: JointScope::Joint(names[joint].clone()), values, intervals });
    }
}

/// Returns an entry without the joints at which its effect is estimated: itself, none, or one for each other joint.
fn without(entry: JointEffect, names: &[String], estimated: &dyn Fn(&str, usize) -> bool) -> Vec<JointEffect> {
    let effect = entry.effect.name;
    if (0..names.len()).all(|joint| !estimated(effect, joint)) {
        return vec![entry];
    }
    let applies = |joint: usize| match &entry.scope {
        JointScope::All => true,
        JointScope::Joint(name) => *name == names[joint],
    };
    let others = (0..names.len()).filter(|joint| applies(*joint) && !estimated(effect, *joint));
    others.map(|joint| JointEffect { scope: JointScope::Joint(names[joint].clone()), ..entry.clone() }).collect()
}

/// Sets the gain of one joint in the table of a model file.
fn set_gain(table: &mut Option<NominalGain>, names: &[String], joint: usize, gain: f64) {
    let mut gains = match table.take() {
        None => BTreeMap::new(),
        Some(NominalGain::All(gain)) => names.iter().map(|name| (name.clone(), gain)).collect(),
        Some(NominalGain::PerJoint(gains)) => gains,
    };
    gains.insert(names[joint].clone(), gain);
    *table = Some(NominalGain::PerJoint(gains));
}
