//! The motor's torque ripples with its angle.

use super::{Composition, Confusion, Effect, Parameter, Target};
use crate::Ripple;

/// The motor's torque ripples with its angle.
pub const EFFECT: Effect = Effect {
    name: "torque_ripple",
    what: "The motor's torque ripples with its angle.",
    equation: "tau_m += A sin(N q + phi)",
    place: "11, ripple",
    parameters: &[
        Parameter {
            name: "amplitude_nm",
            unit: "N·m",
            count: 1,
            bounds: [0.0, 5.0],
            plausible: [0.0, 0.4],
            neutral: 0.0,
            source: "cogging of such motors is a few per cent of their torque",
        },
        Parameter {
            name: "cycles_per_turn",
            unit: "",
            count: 1,
            bounds: [1.0, 400.0],
            plausible: [6.0, 150.0],
            neutral: 42.0,
            source: "pole pairs times gear ratio",
        },
        Parameter {
            name: "phase_rad",
            unit: "rad",
            count: 1,
            bounds: [-6.3, 6.3],
            plausible: [-3.0, 3.0],
            neutral: 0.0,
            source: "where the magnets are",
        },
    ],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The residual is periodic in the joint's position, not in time.",
    confusions: &[Confusion { with: "backlash", experiment: "Turn slowly one way: ripple goes on, play does not." }],
    apply: |robot, place, values| {
        let ripple = &mut super::joint(robot, place).drive.ripple;
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
