//! The catalogue: one file per effect, with its description, its parameters and what it changes in a robot model.

mod armature;
mod backlash;
mod com_shift;
mod command_delay;
mod coulomb_friction;
mod drive_lag;
mod encoder_offset;
mod ground_friction;
mod ground_stiffness;
mod gyro_bias;
mod inertia;
mod joint_elasticity;
mod joint_spring;
mod load_friction;
mod payload;
mod pd_gain;
mod stribeck_friction;
mod supply_sag;
mod thermal_derating;
mod torque_dead_zone;
mod torque_delay;
mod torque_gain;
mod torque_ripple;
mod torque_saturation;
mod torque_sensor_delay;
mod torque_speed_limit;
mod viscous_friction;

use crate::Effect;

/// All effects, in the order of the chain from command to motion.
pub const CATALOGUE: [&Effect; 27] = [
    &command_delay::EFFECT,
    &encoder_offset::EFFECT,
    &pd_gain::EFFECT,
    &torque_saturation::EFFECT,
    &supply_sag::EFFECT,
    &thermal_derating::EFFECT,
    &torque_delay::EFFECT,
    &torque_speed_limit::EFFECT,
    &torque_dead_zone::EFFECT,
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
