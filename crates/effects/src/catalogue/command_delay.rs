//! Delay between a command and its arrival at the actuator.

use crate::{
    Apply, BlindTestCondition, Composition, Confounder, DataRequirement, Effect, EffectDemo, LawForm, Parameter, Place,
    PlotQuantity, Presence, Search, Target, Variable, Visibility, demo,
};

pub const EFFECT: Effect = Effect {
    name: "command_delay",
    summary: "Delay between a command and its arrival at the actuator.",
    equation: "q_cmd, dq_cmd and tau_ff of time t - T reach the actuator at t; linear interpolation between two \
               commands",
    chain_stage: "1, command",
    parameters: &[Parameter {
        name: "delay_s",
        unit: "s",
        count: 1,
        bounds: [0.0, 0.04],
        prior_range: [0.0, 0.02],
        no_effect_value: 0.0,
        source: "walk-these-ways randomises 0 to 30 ms; PACE allows 25 ms; real Go2 logs gave 1 to 6 ms",
    }],
    composition: Composition::Add,
    target: Target::Joints,
    signature: "The torque responds to command changes with a delay: its phase lag grows linearly with frequency. The \
                feedback of position and velocity is not delayed.",
    confounders: &[
        Confounder {
            effect: "armature",
            discriminating_experiment: "Command steps: during a delay nothing moves, with more inertia the motion \
                                        starts at once but slowly. Also chirps with two different spectra.",
        },
        Confounder {
            effect: "drive_lag",
            discriminating_experiment: "A chirp to high frequency: a lag reduces the amplitude, a delay does not.",
        },
        Confounder {
            effect: "torque_delay",
            discriminating_experiment: "Constant command, joint pushed by hand or swinging under gravity: a command \
                                        delay has no effect, a torque delay does.",
        },
    ],
    needs: &[DataRequirement::Reversals, DataRequirement::Rate(100.0)],
    recommended: &[DataRequirement::Bandwidth(2.0)],
    caveat: "confounded with armature in slow motion",
    remedy: "Add the law: delay commands in the simulator by this time. Or shorten the path from controller to motor.",
    search: Search::DEFAULT,
    visibility: Visibility::MotorTorque,
    explained_by: Variable::CommandRate,
    demo: EffectDemo {
        motion: &demo::CHIRP,
        over_time: PlotQuantity::Position,
        law: [PlotQuantity::CommandedTorque, PlotQuantity::EstimatedTorque],
    },
    blind_test: Some(&[BlindTestCondition::FixedBase]),
    laws: &[LawForm { is_usual: true, ..LawForm::strength(Place::Drive, |c, _| vec![0.02 * c[0].max(0.0)]) }
        .with_small(&[0.005], Presence::Everywhere)],
    amount: Some(|joint| joint.actuator.command_delay),
    apply: Apply::Joint(|joint, values| {
        joint.actuator.command_delay += values[0];
        Ok(())
    }),
};
