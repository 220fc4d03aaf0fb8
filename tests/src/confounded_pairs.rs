//! Pairs of effects that are taken for each other: a robot that has the first, and the question whether it is the second.

use twinstep_diagnose::HypothesisPair;
use twinstep_effects::EffectEntry;
use twinstep_effects::ModelFile;

use crate::ground_truth_robot::effect;

/// An effect with its scope and its values, half of what is plausible or so.
type Side = (&'static str, &'static str, &'static [f64]);

/// Two effects that are taken for each other.
pub struct Pair {
    /// What the robot has.
    pub hidden: Side,
    /// What it might have.
    pub alternative: Side,
    /// Whether the trunk's motion is measured, so that motions on the ground tell something.
    pub on_ground: bool,
}

const fn pair(hidden: Side, rival: Side, on_ground: bool) -> Pair {
    Pair { hidden, alternative: rival, on_ground }
}

/// Pairs that the catalogue says are taken for each other.
pub const PAIRS: [Pair; 8] = [
    pair(("backlash", "RR_calf", &[0.012]), ("joint_elasticity", "RR_calf", &[300.0]), false),
    pair(("command_delay", "all", &[0.008]), ("armature", "all", &[0.01]), false),
    pair(("drive_lag", "thigh", &[0.006]), ("torque_delay", "thigh", &[0.005]), false),
    pair(("viscous_friction", "calf", &[0.3]), ("coulomb_friction", "calf", &[0.6]), false),
    pair(("coulomb_friction", "FL_thigh", &[0.7]), ("backlash", "FL_thigh", &[0.012]), false),
    pair(("joint_spring", "FR", &[1.5, 0.5]), ("encoder_offset", "FR", &[0.03]), false),
    pair(("load_friction", "thigh", &[0.15]), ("coulomb_friction", "thigh", &[0.6]), true),
    pair(("payload", "base", &[2.0, 0.1, 0.0, 0.05]), ("com_shift", "base", &[0.03, 0.0, 0.0]), true),
];

impl Pair {
    /// The robot with the hidden effect.
    pub fn robot(&self) -> ModelFile {
        let (name, scope, values) = self.hidden;
        let (effect, scope) = effect(name, scope);
        let entry = EffectEntry::new(effect, scope, values.to_vec()).expect("plausible values are allowed");
        ModelFile { effects: vec![entry], ..ModelFile::default() }
    }

    /// The question.
    pub fn pair(&self) -> HypothesisPair {
        let sides = [self.hidden, self.alternative].map(|(name, scope, values)| {
            let (effect, scope) = effect(name, scope);
            (effect, scope, values.to_vec())
        });
        HypothesisPair::new(ModelFile::default(), sides)
    }
}
