//! Pairs of confounded effects: a robot with the first, and both as hypotheses.

use twinstep_diagnose::HypothesisPair;
use twinstep_effects::EffectEntry;
use twinstep_effects::ModelFile;

use crate::ground_truth_robot::effect;

/// Effect, scope and values. The values are about half of the plausible maximum.
type Side = (&'static str, &'static str, &'static [f64]);

/// Two confounded effects.
pub struct Pair {
    /// True effect of the robot.
    pub hidden: Side,
    /// Alternative hypothesis.
    pub alternative: Side,
    /// True if trajectories with a floating base are included, because the base motion is measured.
    pub on_ground: bool,
}

const fn pair(hidden: Side, alternative: Side, on_ground: bool) -> Pair {
    Pair { hidden, alternative, on_ground }
}

/// Pairs that the catalogue lists as confounders.
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
    /// Returns the model of the robot with the true effect.
    pub fn robot(&self) -> ModelFile {
        let (name, scope, values) = self.hidden;
        let (effect, scope) = effect(name, scope);
        let entry = EffectEntry::new(effect, scope, values.to_vec()).expect("plausible values are allowed");
        ModelFile { effects: vec![entry], ..ModelFile::default() }
    }

    /// Returns both effects as hypotheses on the ideal robot.
    pub fn hypothesis_pair(&self) -> HypothesisPair {
        let sides = [self.hidden, self.alternative].map(|(name, scope, values)| {
            let (effect, scope) = effect(name, scope);
            (effect, scope, values.to_vec())
        });
        HypothesisPair::new(ModelFile::default(), sides)
    }
}
