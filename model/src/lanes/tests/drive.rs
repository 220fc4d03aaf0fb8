//! Every link of the chain from command to torque against its closed form.

use proptest::prelude::*;

use super::super::{SimdCommands, SimdActuators};
use crate::{Command, ActuatorParams, JointModel, NUM_JOINTS, Ripple, RobotModel, Stribeck, go2};

/// Physics steps in a drive period, and one of them [s].
const STEPS: usize = 5;
const DT: f64 = 0.001;
/// One drive period [s].
const PERIOD: f64 = 0.005;

fn robot(change: impl Fn(&mut JointModel)) -> RobotModel {
    let mut robot = go2();
    robot.joints.iter_mut().for_each(change);
    robot
}

fn with_drive(drive: ActuatorParams) -> RobotModel {
    robot(|joint| joint.actuator = drive)
}

/// The drives of one robot in double precision, with the joints at 0.
fn drive(robot: &RobotModel) -> SimdActuators<f64> {
    let mut drive = SimdActuators::new(robot, DT);
    drive.set(0, robot, &[0.0; NUM_JOINTS], &[0.0; NUM_JOINTS]);
    drive
}

fn torque(tau_ff: f64) -> Command {
    let mut command = Command::hold([0.0; NUM_JOINTS], 0.0, 0.0);
    command.tau_ff = [tau_ff as f32; NUM_JOINTS];
    command
}

/// Torque of the first joint in each physics step of each period, with the joints at `q` and `dq`.
fn play(robot: &RobotModel, commands: impl IntoIterator<Item = Command>, q: f64, dq: f64) -> Vec<f64> {
    let mut drive = drive(robot);
    let (q, dq) = ([q; NUM_JOINTS], [dq; NUM_JOINTS]);
    let mut torques = Vec::new();
    for command in commands {
        drive.update_command(&SimdCommands::new(&[command]), &q, &dq);
        torques.extend((0..STEPS).map(|index| drive.step(index, &q, &dq).tau[0]));
    }
    torques
}

fn once(robot: &RobotModel, tau: f64, q: f64, dq: f64) -> f64 {
    play(robot, [torque(tau)], q, dq)[0]
}

proptest! {
    #[test]
    fn ideal_drive_is_pd_within_the_limits(target in -4.0f32..4.0, q in -3.0..3.0f64, dq in -20.0..20.0f64) {
        let torques = play(&go2(), [Command::hold([target; NUM_JOINTS], 30.0, 0.75)], q, dq);
        let limit = go2().joints[0].torque_limit;
        let expected = (30.0 * (f64::from(target) - q) - 0.75 * dq).clamp(-limit, limit);
        for torque in torques {
            prop_assert!((torque - expected).abs() < 1e-9, "{torque} N·m, {expected} expected");
        }
    }

    #[test]
    fn saturation_is_the_hyperbolic_tangent(tau in -60.0..60.0f64, kappa in 5.0..40.0f64) {
        let robot = robot(|joint| {
            joint.torque_limit = 1e3;
            joint.actuator.saturation = kappa;
        });
        let expected = kappa * (f64::from(tau as f32) / kappa).tanh();
        prop_assert!((once(&robot, tau, 0.0, 0.0) - expected).abs() < 1e-9);
    }

    #[test]
    fn back_emf_leaves_less_torque_the_faster_a_joint_turns(tau in -20.0..20.0f64, dq in -40.0..40.0f64) {
        let robot = with_drive(ActuatorParams { no_load_speed: 30.0, ..ActuatorParams::IDEAL });
        let left = go2().joints[0].torque_limit * (1.0 - dq * tau.signum() / 30.0).clamp(0.0, 1.0);
        let expected = f64::from(tau as f32).abs().min(left) * tau.signum();
        prop_assert!((once(&robot, tau, 0.0, dq) - expected).abs() < 1e-9);
    }

    #[test]
    fn delayed_torque_comes_late_by_exactly_the_delay_and_loses_nothing(delay in 0.0..0.04f64) {
        let robot = with_drive(ActuatorParams { torque_delay: delay, ..ActuatorParams::IDEAL });
        // A pulse of one period.
        let commands = (0..12).map(|period| torque(if period == 0 { 1.0 } else { 0.0 }));
        let torques = play(&robot, commands, 0.0, 0.0);
        let impulse: f64 = torques.iter().map(|tau| tau * DT).sum();
        prop_assert!((impulse - PERIOD).abs() < 1e-12);
        let middle = |index: usize| (index as f64 + 0.5) * DT;
        let centre: f64 = torques.iter().enumerate().map(|(index, tau)| tau * DT * middle(index)).sum::<f64>() / impulse;
        // The mean over a step is placed in its middle.
        prop_assert!((centre - PERIOD / 2.0 - delay).abs() < 1e-9, "{centre}");
    }

    #[test]
    fn delayed_command_of_a_ramp_is_the_ramp_that_was(delay in 0.0..0.04f64) {
        let robot = with_drive(ActuatorParams { command_delay: delay, ..ActuatorParams::IDEAL });
        let ramp = |period: usize| 0.01 * period as f64;
        let commands = (0..20).map(|period| Command::hold([ramp(period) as f32; NUM_JOINTS], 10.0, 0.0));
        let last = *play(&robot, commands, 0.0, 0.0).last().expect("torques");
        prop_assert!((last - 10.0 * (ramp(19) - 0.01 * delay / PERIOD)).abs() < 1e-6, "{last}");
    }

    #[test]
    fn bandwidth_is_an_exponential_approach(lag in 0.001..0.05f64) {
        let robot = with_drive(ActuatorParams { torque_time_constant, ..ActuatorParams::IDEAL });
        let torques = play(&robot, vec![torque(2.0); 4], 0.0, 0.0);
        // The integral of 1 - exp(-t / T).
        let area = |t: f64| t + lag * ((-t / lag).exp() - 1.0);
        for (index, tau) in torques.iter().enumerate() {
            let [from, to] = [index, index + 1].map(|index| index as f64 * DT);
            let mean = 2.0 * (area(to) - area(from)) / DT;
            prop_assert!((tau - mean).abs() < 1e-12, "{tau}, the step's mean is {mean}");
        }
    }

    #[test]
    fn ripple_and_gain_come_behind_the_currents_sensor(q in -1.0..1.0f64, tau in -5.0..5.0f64) {
        let ripple = Ripple { amplitude: 0.3, cycles: 14.0, phase: 0.4 };
        let robot = with_drive(ActuatorParams { gain: 0.9, ripple, ..ActuatorParams::IDEAL });
        let mut drive = drive(&robot);
        drive.update_command(&SimdCommands::new(&[torque(tau)]), &[q; NUM_JOINTS], &[0.0; NUM_JOINTS]);
        let pushed = drive.step(0, &[q; NUM_JOINTS], &[0.0; NUM_JOINTS]).tau[0];
        let tau = f64::from(tau as f32);
        prop_assert!((pushed - 0.9 * tau - 0.3 * (14.0 * q + 0.4).sin()).abs() < 1e-9);
        prop_assert!((drive.estimated_torque()[0] - tau).abs() < 1e-12);
    }

    #[test]
    fn dry_friction_follows_speed_and_load(dq in -2.0..2.0f64, tau in -5.0..5.0f64) {
        let robot = robot(|joint| {
            joint.coulomb_friction = 0.2;
            joint.stribeck_friction = Stribeck { breakaway_torque: 0.5, stribeck_velocity: 0.3 };
            joint.load_friction = 0.1;
        });
        let mut drive = drive(&robot);
        drive.update_command(&SimdCommands::new(&[torque(tau)]), &[0.0; NUM_JOINTS], &[dq; NUM_JOINTS]);
        let dry = drive.step(0, &[0.0; NUM_JOINTS], &[dq; NUM_JOINTS]).dry_friction[0];
        let expected = 0.2 + 0.5 * (-(dq / 0.3).powi(2)).exp() + 0.1 * f64::from(tau as f32).abs();
        prop_assert!((dry - expected).abs() < 1e-9, "{dry} N·m, {expected} expected");
    }
}

#[test]
fn weakened_motor_has_its_share_of_the_torque() {
    let mut command = torque(4.0);
    command.derating_factor = [0.7; NUM_JOINTS];
    assert!((play(&go2(), [command], 0.0, 0.0)[0] - 2.8).abs() < 1e-6);
}

#[test]
fn offset_encoder_pulls_the_joint_to_where_it_believes_the_target() {
    let robot = with_drive(ActuatorParams { encoder_offset: 0.05, ..ActuatorParams::IDEAL });
    let torque = play(&robot, [Command::hold([0.0; NUM_JOINTS], 20.0, 0.0)], 0.0, 0.0)[0];
    assert!((torque + 20.0 * 0.05).abs() < 1e-9, "{torque} N·m");
}

#[test]
fn spring_pulls_to_its_rest() {
    let robot = robot(|joint| joint.spring = crate::JointSpring { stiffness: 3.0, torque_offset: 3.0 * 0.5 });
    assert!((once(&robot, 0.0, 0.2, 0.0) - 3.0 * (0.5 - 0.2)).abs() < 1e-9);
}

/// A rotor on a spring, its link held: it swings with √(k/J).
#[test]
fn rotor_behind_an_elastic_gear_swings_at_its_frequency() {
    let robot = with_drive(ActuatorParams { gear_stiffness: 300.0, ..ActuatorParams::IDEAL });
    let mut drive = drive(&robot);
    // The rotor no longer moves with the link.
    assert_eq!(drive.set(0, &robot, &[0.0; NUM_JOINTS], &[1.0; NUM_JOINTS]), [0.0; NUM_JOINTS]);
    let still = [0.0; NUM_JOINTS];
    let carried: Vec<f64> = (0..2000).map(|_| drive.step(0, &still, &still).tau[0]).collect();
    let crossings = carried.windows(2).filter(|pair| pair[0] < 0.0 && pair[1] >= 0.0).count();
    let expected = (300.0 / robot.joints[0].armature).sqrt() / std::f64::consts::TAU * 2.0;
    assert!((crossings as f64 - expected).abs() <= 1.0, "{crossings} swings in 2 s, {expected} expected");
    // Amplitude of the torque: v √(k J).
    let most = carried.iter().copied().fold(0.0, f64::max);
    assert!((most / (300.0 * robot.joints[0].armature).sqrt() - 1.0).abs() < 0.02, "{most} N·m");
}

#[test]
fn gear_with_play_carries_nothing_inside_it() {
    let robot = with_drive(ActuatorParams { backlash: 0.02, ..ActuatorParams::IDEAL });
    let mut drive = drive(&robot);
    let inside = |twist: f64| [-twist; NUM_JOINTS];
    assert_eq!(drive.step(0, &inside(0.009), &[0.0; NUM_JOINTS]).tau[0], 0.0);
    // The rotor gives way within the step by J/k-th parts of a second squared.
    let carried = drive.step(0, &inside(0.011), &[0.0; NUM_JOINTS]).tau[0];
    assert!((carried / (2000.0 * 0.001) - 1.0).abs() < 0.05, "{carried} N·m");
}

#[test]
fn torque_that_is_not_a_number_is_seen() {
    assert!(once(&go2(), f64::NAN, 0.0, 0.0).is_nan());
}
