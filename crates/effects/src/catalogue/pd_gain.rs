//! The gains of the PD loop differ from the commanded gains.

use crate::{
    Apply, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place, PlotQuantity,
    Presence, Search, Target, Variable, Visibility, demo,
};

/// Prior range of the factor on kp.
const KP_RANGE: [f64; 2] = [0.7, 1.3];
/// Prior range of the factor on kd.
const KD_RANGE: [f64; 2] = [0.5, 1.5];

/// The gains of the PD loop differ from the commanded gains.
pub const EFFECT: Effect = Effect {
    name: "pd_gain",
    summary: "The gains of the PD loop differ from the commanded gains.",
    equation: "tau = s_p kp (q_cmd - q) + s_d kd (dq_cmd - dq) + tau_ff",
    chain_stage: "2a, PD",
    parameters: &[
        Parameter {
            name: "kp_scale",
            unit: "",
            count: 1,
            bounds: [0.1, 5.0],
            prior_range: KP_RANGE,
            no_effect_value: 1.0,
            source: "legged_gym and Walk These Ways randomise the stiffness by 0.8 to 1.3",
        },
        Parameter {
            name: "kd_scale",
            unit: "",
            count: 1,
            bounds: [0.0, 10.0],
            prior_range: KD_RANGE,
            no_effect_value: 1.0,
            source: "legged_gym and Walk These Ways randomise the damping by 0.5 to 1.5",
        },
    ],
    composition: Composition::Multiply,
    target: Target::Joints,
    signature: "The measured torque is proportional to the position error, or to the speed, with another factor than the commanded gain. Feed-forward torque is not scaled.",
    confounders: &[
        Confounder {
            effect: "torque_gain",
            discriminating_experiment: "Measure the motor current: it follows the gains of the loop, not the torque constant.",
        },
        Confounder {
            effect: "viscous_friction",
            discriminating_experiment: "Repeat the motion at another commanded kd: friction does not change with it. A motor-current sensor does not measure friction.",
        },
        Confounder {
            effect: "torque_saturation",
            discriminating_experiment: "Two amplitudes of the same motion: a gain has the same ratio at both.",
        },
    ],
    needs: &[DataRequirement::TorqueMeasured, DataRequirement::Reversals],
    recommended: &[DataRequirement::KdVaries],
    caveat: "",
    remedy: "Retune the robot: set the gains that the log states, or state the gains that the motors have.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::CommandedTorque,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::CommandedTorque, PlotQuantity::EstimatedTorque],
    },
    blind_test: None,
    laws: &[
        LawForm { is_gain: true, ..LawForm::new(Place::Drive, &[0.15], |c, _| vec![1.0 + c[0], 1.0]) }
            .with_small(&[0.02], Presence::Nowhere),
        LawForm { is_gain: true, ..LawForm::new(Place::Drive, &[0.3], |c, _| vec![1.0, 1.0 + c[0]]) }
            .with_small(&[0.04], Presence::Nowhere),
        LawForm { is_gain: true, ..LawForm::new(Place::Drive, &[0.15, 0.3], |c, _| vec![1.0 + c[0], 1.0 + c[1]]) }
            .with_small(&[0.02, 0.04], Presence::Everywhere),
    ],
    amount: None,
    apply: Apply::Joint(|joint, values| {
        let actuator = &mut joint.actuator;
        actuator.kp_scale *= values[0];
        actuator.kd_scale *= values[1];
        Ok(())
    }),
};
