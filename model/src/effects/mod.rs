//! What real robots do and ideal ones do not: the catalogue of effects.
//!
//! - [`Effect`]: one effect of the catalogue: what it is, its parameters, what it looks like in data, what it is taken
//!   for, and what it does to the numbers of a [`RobotModel`]. One file an effect.
//! - [`CATALOGUE`]: all of them, in the order of the chain from command to motion.
//! - [`Scope`]: the joints, or the part of the robot, that an entry of a model file is about.
//! - [`Entry`]: an effect with a scope and values; [`compose`] makes a robot of several.
//! - [`RobotDraws`]: robots that differ as far as measured intervals allow.
//!
//! An effect acts by changing numbers alone; [`crate::lanes::Drive`] and the engines have the laws.

mod armature;
mod backlash;
mod com_shift;
mod command_delay;
mod coulomb_friction;
mod draw;
mod drive_lag;
mod encoder_offset;
mod entry;
mod ground_friction;
mod ground_stiffness;
mod gyro_bias;
mod inertia;
mod joint_elasticity;
mod joint_spring;
mod load_friction;
mod payload;
mod scope;
mod stribeck_friction;
mod supply_sag;
mod thermal_derating;
mod torque_delay;
mod torque_gain;
mod torque_ripple;
mod torque_saturation;
mod torque_sensor_delay;
mod torque_speed_limit;
mod viscous_friction;

pub use draw::{SamplingError, RobotSampler};
pub use entry::{EffectEntry, EntryError, apply_effects};
pub use scope::{Scope, UnknownScope};

use crate::RobotModel;

/// Every effect, in the order of the chain from command to motion.
pub const CATALOGUE: [&Effect; 25] = [
    &command_delay::EFFECT,
    &encoder_offset::EFFECT,
    &torque_saturation::EFFECT,
    &supply_sag::EFFECT,
    &thermal_derating::EFFECT,
    &torque_delay::EFFECT,
    &torque_speed_limit::EFFECT,
    &drive_lag::EFFECT,
    &torque_sensor_delay::EFFECT,
    &torque_gain::EFFECT,
    &torque_ripple::EFFECT,
    &backlash::EFFECT,
    &joint_elasticity::EFFECT,
    &coulomb_friction::EFFECT,
    &viscous_friction::EFFECT,
    &stribeck_friction::EFFECT,
    &load_friction::EFFECT,
    &armature::EFFECT,
    &joint_spring::EFFECT,
    &payload::EFFECT,
    &com_shift::EFFECT,
    &inertia::EFFECT,
    &ground_friction::EFFECT,
    &ground_stiffness::EFFECT,
    &gyro_bias::EFFECT,
];

/// An effect of the catalogue.
#[derive(Debug)]
pub struct Effect {
    /// Its name in model files and findings.
    pub name: &'static str,
    /// What it is, in a sentence.
    pub summary: &'static str,
    /// Its law.
    pub equation: &'static str,
    /// Its place in the chain from command to motion: the step's number where it has one, and a word.
    pub chain_stage: &'static str,
    /// What it has.
    pub parameters: &'static [Parameter],
    /// How entries of this name that meet at one joint compose.
    pub composition: Composition,
    /// What it can be about.
    pub target: Target,
    /// What it looks like in data.
    pub signature: &'static str,
    /// What it is taken for.
    pub confounders: &'static [Confounder],
    /// Puts the values, parameter after parameter, into the robot, at one place.
    pub apply: fn(&mut RobotModel, EffectSite, &[f64]) -> Result<(), &'static str>,
}

/// A parameter of an effect.
#[derive(Debug)]
pub struct Parameter {
    /// Its name, with the unit.
    pub name: &'static str,
    /// Its unit as people write it; empty for none.
    pub unit: &'static str,
    /// Numbers in it: 1, or more for a vector.
    pub count: usize,
    /// What is allowed.
    pub bounds: [f64; 2],
    /// What a Go2 may plausibly have: the prior, as a 95 % range.
    pub prior_range: [f64; 2],
    /// The value that changes nothing.
    pub no_effect_value: f64,
    /// Where the plausible range comes from.
    pub source: &'static str,
}

/// How entries of one name that meet at one joint compose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Composition {
    /// Their values add up.
    Add,
    /// Their values multiply.
    Multiply,
    /// The one with the narrowest scope counts, of equal ones the last.
    Replace,
}

/// What an effect can be about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// Joints, one by one.
    Joints,
    /// All joints together.
    Supply,
    /// The trunk, or the link behind a joint.
    Bodies,
    /// The trunk.
    Base,
    /// The ground.
    Ground,
}

/// Where an effect is applied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EffectSite {
    /// A joint, or the link behind it, by its index.
    Joint(usize),
    /// The trunk, the supply or the ground.
    Global,
}

/// Another effect that looks alike, and what tells the two apart.
#[derive(Debug)]
pub struct Confounder {
    /// The other one's name.
    pub effect: &'static str,
    /// What to run.
    pub discriminating_experiment: &'static str,
}

impl Effect {
    /// The effect of this name.
    pub fn named(name: &str) -> Option<&'static Effect> {
        CATALOGUE.into_iter().find(|effect| effect.name == name)
    }

    /// Numbers in all parameters.
    pub fn num_values(&self) -> usize {
        self.parameters.iter().map(|parameter| parameter.count).sum()
    }
}

impl PartialEq for Effect {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

/// Puts a number into every joint that an effect is about; effects of joints are applied to nothing else.
fn joint(robot: &mut RobotModel, place: EffectSite) -> &mut crate::JointModel {
    match place {
        EffectSite::Joint(index) => &mut robot.joints[index],
        EffectSite::Global => unreachable!("an effect of joints is applied joint by joint"),
    }
}

/// Adds to a delay [s].
fn delayed(delay: &mut f64, more: f64) -> Result<(), &'static str> {
    *delay += more;
    if *delay > crate::ActuatorParams::MAX_DELAY + 1e-9 {
        return Err("the delays of a joint add up to more than 0.04 s");
    }
    Ok(())
}

/// The body that an effect is about.
fn body(robot: &mut RobotModel, place: EffectSite) -> &mut crate::RigidBody {
    match place {
        EffectSite::Joint(index) => &mut robot.legs[index / 3].bodies[index % 3],
        EffectSite::Global => &mut robot.trunk,
    }
}

#[cfg(test)]
mod tests;
