//! Motor torque ripple that depends on the joint position.

use crate::{
    BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, Parameter, PlotQuantity, Probes,
    Search, Target, Variable, Visibility, demo,
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
    search: Search { probes: Probes::Values(probes), ..Search::DEFAULT },
    visibility: Visibility::OutputTorque,
    explained_by: Variable::Position,
    demo: EffectDemo {
        motion: &demo::SWING,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::Position, PlotQuantity::InverseDynamicsResidual],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    apply: |robot, site, values| {
        let ripple = &mut crate::joint(robot, site).actuator.ripple;
        let [amplitude, cycles, phase] = [values[0], values[1], values[2]];
        if ripple.amplitude > 0.0 && (ripple.cycles - cycles).abs() > 1e-9 {
            return Err("two ripples of different `cycles_per_turn` on one joint");
        }
        let sine = ripple.amplitude * ripple.phase.sin() + amplitude * phase.sin();
        let cosine = ripple.amplitude * ripple.phase.cos() + amplitude * phase.cos();
        *ripple = Ripple { amplitude: sine.hypot(cosine), cycles, phase: sine.atan2(cosine) };
        Ok(())
    },
};

/// Returns ripples of one amplitude, with every third number of cycles and four phases.
///
/// Joints move within 0.5 rad of their mean position. There the phase error to the nearest probe is at most 0.5 rad,
/// which the refinement corrects.
fn probes() -> Vec<Vec<f64>> {
    let phases = [0.0, 0.5, 1.0, -0.5].map(|turn| turn * std::f64::consts::PI);
    (7..=150).step_by(3).flat_map(|cycles| phases.map(|phase| vec![0.12, f64::from(cycles), phase])).collect()
}
