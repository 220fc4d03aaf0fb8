//! Each stage of the chain from command to torque, compared with its closed form.

use proptest::prelude::*;

use super::{JointForces, SimdActuators, SimdCommands, link_armature};
use twinstep_model::{ActuatorParams, Command, JointModel, NUM_JOINTS, Ripple, RobotModel, Stribeck, go2};

/// Number of physics steps per actuator period.
const STEPS: usize = 5;
/// Physics step [s].
const DT: f64 = 0.001;
/// Actuator period [s].
const PERIOD: f64 = 0.005;

fn robot(change: impl Fn(&mut JointModel)) -> RobotModel {
    let mut robot = go2();
    robot.joints.iter_mut().for_each(change);
    robot
}

fn with_actuator(actuator: ActuatorParams) -> RobotModel {
    robot(|joint| joint.actuator = actuator)
}

/// Returns the actuators of one robot in double precision, with the joints at 0.
fn actuator(robot: &RobotModel) -> SimdActuators<f64, [f64; NUM_JOINTS]> {
    let mut actuator = SimdActuators::new(&robot.joints, robot.control.actuator_dt(), DT);
    actuator.set(0, &robot.joints, &[0.0; NUM_JOINTS], &[0.0; NUM_JOINTS]);
    actuator
}

/// Returns torque and friction of a physics step.
fn forces(
    actuator: &mut SimdActuators<f64, [f64; NUM_JOINTS]>,
    index: usize,
    q: &[f64; NUM_JOINTS],
    dq: &[f64; NUM_JOINTS],
) -> JointForces<[f64; NUM_JOINTS]> {
    actuator.step(index, q, dq);
    *actuator.forces()
}

fn torque(tau_ff: f64) -> Command {
    let mut command = Command::hold([0.0; NUM_JOINTS], 0.0, 0.0);
    command.tau_ff = [tau_ff as f32; NUM_JOINTS];
    command
}

/// Returns the torque of the first joint [N·m] in each physics step, with constant joint state `q` and `dq`.
fn simulate(robot: &RobotModel, commands: impl IntoIterator<Item = Command>, q: f64, dq: f64) -> Vec<f64> {
    let mut actuator = actuator(robot);
    let (q, dq) = ([q; NUM_JOINTS], [dq; NUM_JOINTS]);
    let mut torques = Vec::new();
    for command in commands {
        actuator.update_command(&SimdCommands::new(&[command]), &q, &dq);
        torques.extend((0..STEPS).map(|index| forces(&mut actuator, index, &q, &dq).tau[0]));
    }
    torques
}

fn once(robot: &RobotModel, tau: f64, q: f64, dq: f64) -> f64 {
    simulate(robot, [torque(tau)], q, dq)[0]
}

proptest! {
    #[test]
    fn ideal_actuator_is_pd_control_within_the_limits(target in -4.0f32..4.0, q in -3.0..3.0f64, dq in -20.0..20.0f64) {
        let torques = simulate(&go2(), [Command::hold([target; NUM_JOINTS], 30.0, 0.75)], q, dq);
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
    fn back_emf_reduces_the_available_torque_with_speed(tau in -20.0..20.0f64, dq in -40.0..40.0f64) {
        let robot = with_actuator(ActuatorParams { no_load_speed: 30.0, ..ActuatorParams::IDEAL });
        let available = go2().joints[0].torque_limit * (1.0 - dq * tau.signum() / 30.0).clamp(0.0, 1.0);
        let expected = f64::from(tau as f32).abs().min(available) * tau.signum();
        prop_assert!((once(&robot, tau, 0.0, dq) - expected).abs() < 1e-9);
    }

    #[test]
    fn torque_delay_shifts_a_pulse_exactly_and_keeps_its_impulse(delay in 0.0..0.04f64) {
        let robot = with_actuator(ActuatorParams { torque_delay: delay, ..ActuatorParams::IDEAL });
        // Pulse of one period.
        let commands = (0..12).map(|period| torque(if period == 0 { 1.0 } else { 0.0 }));
        let torques = simulate(&robot, commands, 0.0, 0.0);
        let impulse: f64 = torques.iter().map(|tau| tau * DT).sum();
        prop_assert!((impulse - PERIOD).abs() < 1e-12);
        let middle = |index: usize| (index as f64 + 0.5) * DT;
        let centre: f64 = torques.iter().enumerate().map(|(index, tau)| tau * DT * middle(index)).sum::<f64>() / impulse;
        // The mean over a step counts at the middle of the step.
        prop_assert!((centre - PERIOD / 2.0 - delay).abs() < 1e-9, "{centre}");
    }

    #[test]
    fn command_delay_shifts_a_ramp_by_the_delay(delay in 0.0..0.04f64) {
        let robot = with_actuator(ActuatorParams { command_delay: delay, ..ActuatorParams::IDEAL });
        let ramp = |period: usize| 0.01 * period as f64;
        let commands = (0..20).map(|period| Command::hold([ramp(period) as f32; NUM_JOINTS], 10.0, 0.0));
        let last = *simulate(&robot, commands, 0.0, 0.0).last().expect("torques");
        prop_assert!((last - 10.0 * (ramp(19) - 0.01 * delay / PERIOD)).abs() < 1e-6, "{last}");
    }

    #[test]
    fn pd_gains_scale_position_and_velocity_error_but_not_the_feed_forward_torque(kp in 0.1..3.0f64, kd in 0.0..3.0f64) {
        let robot = with_actuator(ActuatorParams { kp_scale: kp, kd_scale: kd, ..ActuatorParams::IDEAL });
        let mut command = Command::hold([0.1; NUM_JOINTS], 20.0, 2.0);
        (command.dq, command.tau_ff) = ([0.5; NUM_JOINTS], [0.3; NUM_JOINTS]);
        let last = *simulate(&robot, [command], 0.0, 0.0).last().expect("torques");
        let expected = kp * 20.0 * f64::from(0.1f32) + kd * 2.0 * 0.5 + f64::from(0.3f32);
        prop_assert!((last - expected).abs() < 1e-9, "{last} instead of {expected}");
    }

    #[test]
    fn dead_zone_removes_its_half_width(tau in -5.0..5.0f64, width in 0.01..3.0f64) {
        let robot = with_actuator(ActuatorParams { dead_zone: width, ..ActuatorParams::IDEAL });
        let last = *simulate(&robot, vec![torque(tau); 2], 0.0, 0.0).last().expect("torques");
        let tau = f64::from(tau as f32);
        prop_assert!((last - tau.signum() * (tau.abs() - width).max(0.0)).abs() < 1e-12, "{last} from {tau}");
    }

    #[test]
    fn step_response_of_the_lag_is_exponential(lag in 0.001..0.05f64) {
        let robot = with_actuator(ActuatorParams { torque_time_constant: lag, ..ActuatorParams::IDEAL });
        let torques = simulate(&robot, vec![torque(2.0); 4], 0.0, 0.0);
        // The integral of 1 - exp(-t / T).
        let area = |t: f64| t + lag * ((-t / lag).exp() - 1.0);
        for (index, tau) in torques.iter().enumerate() {
            let [from, to] = [index, index + 1].map(|index| index as f64 * DT);
            let mean = 2.0 * (area(to) - area(from)) / DT;
            prop_assert!((tau - mean).abs() < 1e-12, "{tau}, the step's mean is {mean}");
        }
    }

    #[test]
    fn ripple_and_gain_act_after_the_current_sensor(q in -1.0..1.0f64, tau in -5.0..5.0f64) {
        let ripple = Ripple { amplitude: 0.3, cycles: 14.0, phase: 0.4 };
        let robot = with_actuator(ActuatorParams { gain: 0.9, ripple, ..ActuatorParams::IDEAL });
        let mut actuator = actuator(&robot);
        actuator.update_command(&SimdCommands::new(&[torque(tau)]), &[q; NUM_JOINTS], &[0.0; NUM_JOINTS]);
        let output = forces(&mut actuator, 0, &[q; NUM_JOINTS], &[0.0; NUM_JOINTS]).tau[0];
        let tau = f64::from(tau as f32);
        prop_assert!((output - 0.9 * tau - 0.3 * (14.0 * q + 0.4).sin()).abs() < 1e-9);
        prop_assert!((actuator.estimated_torque()[0] - tau).abs() < 1e-12);
    }

    #[test]
    fn dry_friction_depends_on_speed_and_load(dq in -2.0..2.0f64, tau in -5.0..5.0f64) {
        let robot = robot(|joint| {
            joint.coulomb_friction = 0.2;
            joint.stribeck_friction = Stribeck { breakaway_torque: 0.5, stribeck_velocity: 0.3 };
            joint.load_friction = 0.1;
        });
        let mut actuator = actuator(&robot);
        actuator.update_command(&SimdCommands::new(&[torque(tau)]), &[0.0; NUM_JOINTS], &[dq; NUM_JOINTS]);
        let dry = forces(&mut actuator, 0, &[0.0; NUM_JOINTS], &[dq; NUM_JOINTS]).dry_friction[0];
        let expected = 0.2 + 0.5 * (-(dq / 0.3).powi(2)).exp() + 0.1 * f64::from(tau as f32).abs();
        prop_assert!((dry - expected).abs() < 1e-9, "{dry} N·m, {expected} expected");
    }
}

#[test]
fn derating_factor_multiplies_the_torque() {
    let mut actuator = actuator(&go2());
    actuator.set_derating(0, &[0.7; NUM_JOINTS]);
    actuator.update_command(&SimdCommands::new(&[torque(4.0)]), &[0.0; NUM_JOINTS], &[0.0; NUM_JOINTS]);
    assert!((forces(&mut actuator, 0, &[0.0; NUM_JOINTS], &[0.0; NUM_JOINTS]).tau[0] - 2.8).abs() < 1e-6);
}

#[test]
fn encoder_offset_shifts_the_position_error() {
    let robot = with_actuator(ActuatorParams { encoder_offset: 0.05, ..ActuatorParams::IDEAL });
    let torque = simulate(&robot, [Command::hold([0.0; NUM_JOINTS], 20.0, 0.0)], 0.0, 0.0)[0];
    assert!((torque + 20.0 * 0.05).abs() < 1e-9, "{torque} N·m");
}

#[test]
fn spring_torque_is_proportional_to_the_distance_from_rest() {
    let robot = robot(|joint| joint.spring = twinstep_model::JointSpring { stiffness: 3.0, torque_offset: 3.0 * 0.5 });
    assert!((once(&robot, 0.0, 0.2, 0.0) - 3.0 * (0.5 - 0.2)).abs() < 1e-9);
}

/// With a fixed link, the rotor oscillates at √(k/J). Its damping is k dt / 8, so that the amplitude decays with k dt / (16 J).
#[test]
fn rotor_with_an_elastic_gear_oscillates_at_its_natural_frequency() {
    let robot = with_actuator(ActuatorParams { gear_stiffness: 300.0, ..ActuatorParams::IDEAL });
    let mut actuator = actuator(&robot);
    // No rotor inertia moves with the link.
    actuator.set(0, &robot.joints, &[0.0; NUM_JOINTS], &[1.0; NUM_JOINTS]);
    assert!(robot.joints.iter().all(|joint| link_armature(joint) == 0.0));
    let zero = [0.0; NUM_JOINTS];
    let transmitted: Vec<f64> = (0..2000).map(|_| forces(&mut actuator, 0, &zero, &zero).tau[0]).collect();
    let crossings = transmitted.windows(2).filter(|pair| pair[0] < 0.0 && pair[1] >= 0.0).count();
    let expected = (300.0 / robot.joints[0].armature).sqrt() / std::f64::consts::TAU * 2.0;
    assert!((crossings as f64 - expected).abs() <= 1.0, "{crossings} periods in 2 s, {expected} expected");
    // Amplitude of the torque: v √(k J).
    let amplitude = |from: usize| transmitted[from..from + 100].iter().copied().fold(0.0, f64::max);
    let first = amplitude(0);
    assert!((first / (300.0 * robot.joints[0].armature).sqrt() - 1.0).abs() < 0.02, "{first} N·m");
    let decay = 300.0 * DT / (16.0 * robot.joints[0].armature);
    let left = amplitude(500) / first;
    assert!((left / (-0.5 * decay).exp() - 1.0).abs() < 0.05, "{left} of the amplitude after 0.5 s");
}

/// Positions of the links are those of the middle of each step, or of the sample before it.
#[test]
fn rotor_moves_with_a_link_of_constant_speed() {
    let robot = with_actuator(ActuatorParams { gear_stiffness: 300.0, ..ActuatorParams::IDEAL });
    let speed = 5.0;
    for (mut actuator, lead) in [(actuator(&robot), 0.5 * DT), (actuator(&robot).with_sampled_positions(), 0.0)] {
        actuator.set(0, &robot.joints, &[0.0; NUM_JOINTS], &[speed; NUM_JOINTS]);
        for step in 0..100 {
            let link = speed * (DT * f64::from(step) + lead);
            let transmitted = forces(&mut actuator, 0, &[link; NUM_JOINTS], &[speed; NUM_JOINTS]).tau[0];
            assert!(transmitted.abs() < 1e-9, "{transmitted} N·m");
        }
        let (q, dq) = actuator.encoder_reading(0, f64::NAN, f64::NAN);
        assert!((q - 100.0 * speed * DT).abs() < 1e-9 && (dq - speed).abs() < 1e-9, "{q} rad, {dq} rad/s");
    }
}

/// Inside the gap nothing holds the rotor: its reading is that of a constant acceleration.
#[test]
fn rotor_accelerates_freely_inside_the_backlash() {
    let robot = with_actuator(ActuatorParams { backlash: 0.2, ..ActuatorParams::IDEAL });
    let mut actuator = actuator(&robot);
    let zero = [0.0; NUM_JOINTS];
    let torque = [1.0; NUM_JOINTS];
    actuator.set_torque(&torque);
    for index in 0..20 {
        assert_eq!(forces(&mut actuator, index % STEPS, &zero, &zero).tau[0], 0.0);
    }
    let (q, dq) = actuator.encoder_reading(0, 0.0, 0.0);
    let (time, acceleration) = (20.0 * DT, 1.0 / robot.joints[0].armature);
    assert!((dq / (acceleration * time) - 1.0).abs() < 1e-9, "{dq} rad/s");
    assert!((q / (0.5 * acceleration * time * time) - 1.0).abs() < 1e-3, "{q} rad");
}

#[test]
fn gear_transmits_no_torque_inside_its_backlash() {
    let robot = with_actuator(ActuatorParams { backlash: 0.02, ..ActuatorParams::IDEAL });
    let mut actuator = actuator(&robot);
    let inside = |twist: f64| [-twist; NUM_JOINTS];
    assert_eq!(forces(&mut actuator, 0, &inside(0.009), &[0.0; NUM_JOINTS]).tau[0], 0.0);
    // The tolerance is for the rotor's motion within the step.
    let transmitted = forces(&mut actuator, 0, &inside(0.011), &[0.0; NUM_JOINTS]).tau[0];
    assert!((transmitted / (2000.0 * 0.001) - 1.0).abs() < 0.05, "{transmitted} N·m");
}

#[test]
fn nan_torque_is_not_clipped() {
    assert!(once(&go2(), f64::NAN, 0.0, 0.0).is_nan());
}
