//! Catalogue of effects: differences between real robots and the ideal one.
//!
//! - [`Effect`]: an effect of the catalogue: equation, parameters, signature in data, confounders, and the change of a
//!   [`RobotModel`]. One file per effect.
//! - [`LawForm`]: an effect as equations of motion see it, with its priors.
//! - [`Search`], [`Visibility`], [`Variable`], [`demo`]: how diagnosis searches for an effect and how it is plotted.
//! - [`CATALOGUE`]: all effects, in the order of the chain from command to motion.
//! - [`Scope`]: the joints or the part of the robot to which an entry of a model file applies.
//! - [`EffectEntry`]: an effect with a scope and values; [`apply_effects`] applies several to a robot.
//! - [`ModelFile`]: a nominal robot and a list of entries, in TOML; [`NominalRobot`]: built in, or from a robot file.
//! - [`TreeModelFile`]: the same for a robot of any tree, with the effects of joints.
//! - [`RobotSampler`]: domain randomisation within the intervals of a model file.
//!
//! An effect only changes parameters. `SimdActuators` of `twinstep-dynamics` and the engines implement the laws.

mod catalogue;
mod data_requirement;
pub mod demo;
mod entry;
mod law;
mod model_file;
mod nominal;
mod parse_toml;
mod sampler;
mod scope;
mod search;
mod shipped_robots;

pub use catalogue::CATALOGUE;
pub use data_requirement::{DataRequirement, LOW_SPEED};
pub use demo::{DemoMotion, EffectDemo, PlotQuantity};
pub use entry::{EffectEntry, EntryError, apply_effects};
pub use law::{LawForm, Place, Presence, Shapes};
pub use model_file::{
    ActuatorNetworkConfig, EffectEntryError, JointEffect, JointScope, MemberSampling, ModelFile, ModelFileError,
    NetworkMode, NominalGain, ShapeText, TreeGroups, TreeModelFile, load_robot, parse_robot,
};
pub use nominal::{ControlTable, JointGains, JointsTable, KindGains, NominalRobot, NominalRobotError, is_robot_file};
pub use parse_toml::parse_toml;
pub use sampler::{RobotSampler, SamplingError};
pub use scope::{Scope, UnknownScope};
pub use search::{BlindTestCondition, Search, Variable, Visibility};
pub use shipped_robots::shipped_robots;

use twinstep_model::{JointModel, RobotModel};

/// Least sum of what cannot be negative: a sum of entries is rounded.
const LEAST_SUM: f64 = -1e-9;

/// Effect of the catalogue.
#[derive(Debug)]
pub struct Effect {
    /// Name in model files and findings.
    pub name: &'static str,
    /// Description in one sentence.
    pub summary: &'static str,
    /// Equation of the effect.
    pub equation: &'static str,
    /// Stage in the chain from command to motion: number of the step, if it has one, and a word.
    pub chain_stage: &'static str,
    /// Parameters, in the order of their values.
    pub parameters: &'static [Parameter],
    /// Composition of entries of this effect that apply to the same joint.
    pub composition: Composition,
    /// Scopes that the effect can have.
    pub target: Target,
    /// Signature in measured data.
    pub signature: &'static str,
    /// Effects that it is often confused with.
    pub confounders: &'static [Confounder],
    /// What a log must contain so that the effect is identifiable from it.
    pub needs: &'static [DataRequirement],
    /// What a log should also contain; without it the effect is weakly identifiable.
    pub recommended: &'static [DataRequirement],
    /// Caveat to any conclusion about the effect; empty for none.
    pub caveat: &'static str,
    /// What to do about it: change a number or add a law in the simulator, or mend or retune the robot.
    pub remedy: &'static str,
    /// How diagnosis searches for it.
    pub search: Search,
    /// Residual in which it is visible.
    pub visibility: Visibility,
    /// Variable that explains its residual.
    pub explained_by: Variable,
    /// Motion and quantities of its plot.
    pub demo: EffectDemo,
    /// What a log of the blind test must contain for it to be hidden there. `None`: it is not hidden.
    pub blind_test: Option<&'static [BlindTestCondition]>,
    /// The effect in the equations of motion. Empty for effects that diagnosis by equations does not look for.
    pub laws: &'static [LawForm],
    /// Returns what a joint has of it, if values add up.
    pub amount: Option<fn(&JointModel) -> f64>,
    /// What it changes. The values of a parameter are contiguous.
    pub apply: Apply,
}

/// Change of a robot by an effect, given its values. Fails with the reason if it cannot be combined with earlier changes.
#[derive(Clone, Copy, Debug)]
pub enum Apply {
    /// Changes a joint, of any robot.
    Joint(fn(&mut JointModel, &[f64]) -> Result<(), &'static str>),
    /// Changes another part of a quadruped.
    Robot(fn(&mut RobotModel, EffectSite, &[f64]) -> Result<(), &'static str>),
}

/// Parameter of an effect.
#[derive(Debug)]
pub struct Parameter {
    /// Name, with the unit as suffix.
    pub name: &'static str,
    /// Unit for display; empty if dimensionless.
    pub unit: &'static str,
    /// Number of components: 1, or more for a vector.
    pub count: usize,
    /// Lowest and highest allowed value.
    pub bounds: [f64; 2],
    /// Central 95 % interval of the prior for a Go2.
    pub prior_range: [f64; 2],
    /// Value without any effect.
    pub no_effect_value: f64,
    /// Source of the prior.
    pub source: &'static str,
}

/// Composition of entries of one effect that apply to the same joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Composition {
    /// Values add up.
    Add,
    /// Values multiply.
    Multiply,
    /// The entry with the narrowest scope applies; among equal scopes, the last.
    Replace,
}

/// Scopes that an effect can have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// Any scope over joints.
    Joints,
    /// Only all joints together: the common power supply.
    Supply,
    /// The trunk, or the child link of a joint.
    Bodies,
    /// The inertial measurement unit in the trunk.
    Imu,
    /// The ground.
    Ground,
}

impl Composition {
    /// Returns the rule in a sentence.
    pub fn rule(self) -> &'static str {
        match self {
            Self::Add => "values of overlapping entries add up",
            Self::Multiply => "values of overlapping entries multiply",
            Self::Replace => "the entry with the narrowest scope applies; among equal scopes, the last",
        }
    }
}

impl Target {
    /// Returns the scopes as in a model file, in words.
    pub fn scopes(self) -> &'static str {
        match self {
            Self::Joints => "all, hip, thigh, calf, FL, FR, RL, RR, left, right, or a joint such as FL_hip",
            Self::Supply => "all",
            Self::Bodies => "base, or a joint for its child link",
            Self::Imu => "base",
            Self::Ground => "ground",
        }
    }
}

/// Site at which an effect is applied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EffectSite {
    /// A joint, or its child link, by the index of the joint.
    Joint(usize),
    /// The trunk, the supply or the ground.
    Global,
}

/// Effect with a similar signature, and an experiment that discriminates between the two.
#[derive(Debug)]
pub struct Confounder {
    /// Name of the other effect.
    pub effect: &'static str,
    /// Experiment, and what distinguishes the two effects in it.
    pub discriminating_experiment: &'static str,
}

impl Effect {
    /// Returns the effect of this name. Returns `None` if the catalogue has no such effect.
    pub fn named(name: &str) -> Option<&'static Effect> {
        CATALOGUE.into_iter().find(|effect| effect.name == name)
    }

    /// Returns true if it replaces a body, so that effects that change the body are applied after it.
    pub fn replaces_body(&self) -> bool {
        self.composition == Composition::Replace && self.target == Target::Bodies
    }

    /// Returns true if values add up to a sum that cannot be negative, so that an entry may take away what a robot's file states.
    pub fn is_of_sum(&self) -> bool {
        self.amount.is_some() && self.parameters[0].bounds[0] < 0.0
    }

    /// Returns what a joint has of it, zero if values do not add up.
    pub fn amount(&self, joint: &JointModel) -> f64 {
        self.amount.map_or(0.0, |amount| amount(joint))
    }

    /// Returns the number of components of all parameters.
    pub fn num_values(&self) -> usize {
        self.parameters.iter().map(|parameter| parameter.count).sum()
    }
}

impl Effect {
    /// Applies the values to a quadruped at one site. The values of a parameter are contiguous.
    pub fn apply(&self, robot: &mut RobotModel, site: EffectSite, values: &[f64]) -> Result<(), &'static str> {
        match (self.apply, site) {
            (Apply::Joint(change), EffectSite::Joint(index)) => change(&mut robot.joints[index], values),
            (Apply::Joint(_), EffectSite::Global) => unreachable!("an effect of joints is applied joint by joint"),
            (Apply::Robot(change), site) => change(robot, site, values),
        }
    }
}

impl PartialEq for Effect {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

/// Returns the body of a site: the child link of the joint, or the trunk.
fn body(robot: &mut RobotModel, site: EffectSite) -> &mut twinstep_model::RigidBody {
    match site {
        EffectSite::Joint(index) => &mut robot.legs[index / 3].bodies[index % 3],
        EffectSite::Global => &mut robot.trunk,
    }
}

#[cfg(test)]
mod tests;
