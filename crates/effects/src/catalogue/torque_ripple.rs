//! Motor torque ripple that depends on the joint position.

use std::f64::consts::PI;

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Search, Shapes, Target, Variable, Visibility, demo,
};
use twinstep_model::Ripple;

pub const EFFECT: Effect = Effect {
    name: "torque_ripple",
    summary: "Motor torque ripple that depends on the joint position.",
    equation: "tau_m += A sin(N q + phi)",
    chain_stage: "11, ripple",
    parameters: &[
        Parameter {
            name: "amplitude_nm",
            unit: "N·m",
            count: 1,
            bounds: [0.0, 5.0],
            prior_range: [0.0, 0.4],
            no_effect_value: 0.0,
            source: "cogging of such motors is a few per cent of their torque",
        },
        Parameter {
            name: "cycles_per_turn",
            unit: "",
            count: 1,
            bounds: [1.0, 400.0],
            prior_range: [6.0, 150.0],
            no_effect_value: 42.0,
            source: "pole pairs times gear ratio",
        },
        Parameter {
            name: "phase_rad",
            unit: "rad",
            count: 1,
            bounds: [-6.3, 6.3],
            prior_range: [-3.0, 3.0],
            no_effect_value: 0.0,
            source: "position of the magnets",
        },
    ],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is periodic in the joint position, not in time.",
    confounders: &[Confounder {
        effect: "backlash",
        discriminating_experiment: "Slow motion in one direction: ripple persists, backlash has no effect.",
    }],
    needs: &[DataRequirement::Range(0.5), DataRequirement::Rate(100.0)],
    recommended: &[DataRequirement::LowSpeed, DataRequirement::TorqueMeasured],
    caveat: "",
    remedy: "Mend the robot: calibrate the commutation of the motor. Or add the law to the simulator.",
    // A tenth of the standard deviation of the number of cycles would turn the phase by half a period.
    search: Search { derivative_step: 0.01, ..Search::DEFAULT },
    visibility: Visibility::OutputTorque,
    explained_by: Variable::Position,
    demo: EffectDemo {
        motion: &demo::SWING,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Position, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm {
        is_of_torque: true,
        shapes: Shapes::Range([6.0, 150.0, 1.5]),
        // Cogging of 0.1 % of the peak torque, in phase and out of phase.
        small: &[0.02, 0.02],
        ..LawForm::new(Place::Joint, &[0.2, 0.2], |c, cycles| {
            vec![c[0].hypot(c[1]), cycles, c[1].atan2(c[0]).clamp(-PI, PI)]
        })
    }],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        let ripple = &mut joint.actuator.ripple;
        let [amplitude, cycles, phase] = [values[0], values[1], values[2]];
        if ripple.amplitude > 0.0 && (ripple.cycles - cycles).abs() > 1e-9 {
            return Err("two ripples of different `cycles_per_turn` on one joint");
        }
        let sine = ripple.amplitude * ripple.phase.sin() + amplitude * phase.sin();
        let cosine = ripple.amplitude * ripple.phase.cos() + amplitude * phase.cos();
        *ripple = Ripple { amplitude: sine.hypot(cosine), cycles, phase: sine.atan2(cosine) };
        Ok(())
    }),
};

#[cfg(test)]
mod tests {
    use super::*;

    /// Derivatives over half a period have the wrong sign.
    #[test]
    fn derivatives_of_a_fit_turn_the_phase_by_less_than_half_a_radian() {
        let [low, high] = EFFECT.parameters[1].prior_range;
        let step = EFFECT.search.derivative_step * (high - low) / (2.0 * 1.96);
        assert!(step * 1.3 < 0.5, "{step} cycles per revolution at 1.3 rad");
    }
}
