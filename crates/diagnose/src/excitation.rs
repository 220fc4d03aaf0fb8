//! Excitation trajectories for the next experiment: 10 s each, within the limits of the Go2.

use std::f64::consts::TAU;

use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, Joint, JointKind, RobotModel};

/// Length of every trajectory [s]; equal lengths make their information comparable.
const LENGTH_S: f64 = 10.0;
/// Time over which a trajectory starts and ends smoothly [s].
const EASE_S: f64 = 0.5;

/// Excitation trajectory that is safe for any Go2 that does not differ strongly from the ideal one.
#[derive(Clone, Copy, Debug)]
pub struct ExcitationTrajectory {
    /// Name, as in `chirp_calf`.
    pub name: &'static str,
    /// Description of the motion.
    pub what: &'static str,
    /// Mount of the base.
    pub base: BaseMount,
    /// Offset of a joint from the default pose [rad] at a time [s].
    offset: fn(Joint, f64) -> f64,
    /// Position gain [N·m/rad] and velocity gain [N·m·s/rad] at a time [s].
    gains: fn(f64) -> [f64; 2],
}

/// All excitation trajectories.
///
/// Chirps excite inertia and delays, steps delays, slow reversals friction and backlash, and static poses gravity,
/// springs and gains. Standing trajectories excite effects under load.
pub const EXCITATION_TRAJECTORIES: [ExcitationTrajectory; 14] = [
    fixed_base(
        "chirp_hip",
        "a chirp of the hips in the air",
        |joint, t| only(JointKind::Hip, joint, 0.15 * chirp(t)),
        default_gains,
    ),
    fixed_base(
        "chirp_thigh",
        "a chirp of the thighs in the air",
        |joint, t| only(JointKind::Thigh, joint, 0.15 * chirp(t)),
        default_gains,
    ),
    fixed_base(
        "chirp_calf",
        "a chirp of the calves in the air",
        |joint, t| only(JointKind::Calf, joint, 0.2 * chirp(t)),
        default_gains,
    ),
    fixed_base(
        "chirp_firm",
        "a chirp of all joints in the air with high gains",
        |joint, t| 0.1 * chirp(t) * if joint.index() % 2 == 0 { 1.0 } else { -1.0 },
        stiff_gains,
    ),
    fixed_base(
        "steps",
        "small steps of all joints in the air",
        |joint, t| 0.1 * wave(joint, 0.9, t).signum(),
        stiff_gains,
    ),
    fixed_base(
        "creep",
        "slow reversals of all joints in the air",
        |joint, t| 0.1 * triangle(joint, 0.3, t),
        default_gains,
    ),
    fixed_base(
        "creep_soft",
        "slow reversals of all joints in the air with low gains",
        |joint, t| 0.15 * triangle(joint, 0.25, t),
        soft,
    ),
    fixed_base(
        "two_speeds",
        "reversals in the air, first slow, then fast",
        |joint, t| if t < 5.0 { 0.1 * triangle(joint, 0.3, t) } else { 0.3 * triangle(joint, 1.2, t) },
        default_gains,
    ),
    fixed_base("holds", "slow changes between postures in the air", |joint, t| pose(joint, t, 1.25), default_gains),
    fixed_base(
        "holds_two_gains",
        "postures in the air, each held with low and with high gains",
        |joint, t| pose(joint, t, 2.5),
        |t| if t % 2.5 < 1.25 { soft(t) } else { stiff_gains(t) },
    ),
    fixed_base(
        "multisine",
        "five sines of all joints at once in the air",
        |joint, t| 0.3 * multisine(joint, t),
        default_gains,
    ),
    standing("sway", "swaying of the trunk over standing feet", |joint, t| {
        let fore = 0.08 * (TAU * 0.37 * t).sin();
        stance(joint, 0.06 * (TAU * 0.23 * t).sin(), 0.05 * (TAU * 0.61 * t).sin(), fore)
    }),
    standing("squat", "slow squats", |joint, t| stance(joint, 0.14 * (TAU * 0.4 * t).sin(), 0.0, 0.0)),
    standing("lean", "leaning of the standing robot to each side, with holds", |joint, t| {
        let [pitch, fore] = [0.0, 1.7].map(|shift| hold_of(0.07, 1.25, shift, t));
        stance(joint, 0.0, pitch, fore)
    }),
];

const fn fixed_base(
    name: &'static str,
    what: &'static str,
    offset: fn(Joint, f64) -> f64,
    gains: fn(f64) -> [f64; 2],
) -> ExcitationTrajectory {
    ExcitationTrajectory { name, what, base: BaseMount::Fixed, offset, gains }
}

const fn standing(name: &'static str, what: &'static str, offset: fn(Joint, f64) -> f64) -> ExcitationTrajectory {
    ExcitationTrajectory { name, what, base: BaseMount::Floating, offset, gains: |_| [60.0, 1.5] }
}

fn soft(_: f64) -> [f64; 2] {
    [20.0, 0.6]
}

fn default_gains(_: f64) -> [f64; 2] {
    [30.0, 0.8]
}

fn stiff_gains(_: f64) -> [f64; 2] {
    [60.0, 1.5]
}

fn only(kind: JointKind, joint: Joint, offset: f64) -> f64 {
    if joint.kind == kind { offset } else { 0.0 }
}

/// Chirp from 0.4 to 6 Hz.
fn chirp(t: f64) -> f64 {
    (TAU * (0.4 + 0.5 * (6.0 - 0.4) * t / LENGTH_S) * t).sin()
}

/// Sine with a different phase and frequency for each joint, so that no two joints move alike.
fn wave(joint: Joint, rate_hz: f64, t: f64) -> f64 {
    (TAU * rate_hz * (1.0 + 0.02 * joint.index() as f64) * t + 2.4 * joint.index() as f64).sin()
}

fn triangle(joint: Joint, rate_hz: f64, t: f64) -> f64 {
    wave(joint, rate_hz, t).asin() * 4.0 / TAU
}

fn multisine(joint: Joint, t: f64) -> f64 {
    [0.3, 0.7, 1.3, 2.3, 3.9].map(|rate| 0.2 * wave(joint, rate, t + rate)).iter().sum()
}

/// Sequence of postures of `length` [s].
fn pose(joint: Joint, t: f64, length: f64) -> f64 {
    let reach = if joint.kind == JointKind::Hip { 0.25 } else { 0.35 };
    hold_of(reach, length, 2.1 * joint.index() as f64, t)
}

/// Sequence of levels within ±`reach`, each of `length` [s] including the transition to it.
fn hold_of(reach: f64, length: f64, shift: f64, t: f64) -> f64 {
    let level = |number: f64| reach * (7.3 * number + shift).sin();
    let number = (t / length).floor();
    let way = ((t / length - number) / 0.4).min(1.0);
    level(number) + (level(number + 1.0) - level(number)) * way * way * (3.0 - 2.0 * way)
}

/// Joint offsets that lift, pitch and shift the trunk while the feet do not move.
fn stance(joint: Joint, lift: f64, pitch: f64, fore: f64) -> f64 {
    let length = lift + pitch * joint.leg.front_sign();
    match joint.kind {
        JointKind::Hip => 0.5 * fore,
        JointKind::Thigh => length + fore,
        JointKind::Calf => -2.0 * length,
    }
}

impl ExcitationTrajectory {
    /// Returns the commands of the trajectory for `robot`, with one row per actuator period.
    pub fn motion(&self, robot: &RobotModel) -> Log {
        let rate_hz = robot.control.actuator_hz;
        let t: Vec<f64> = (0..(LENGTH_S * rate_hz) as usize).map(|row| row as f64 / rate_hz).collect();
        let of_time = |of: &dyn Fn(f64) -> f64| t.iter().map(|t| of(*t)).collect::<Vec<_>>();
        let ease = |t: f64| (t.min(LENGTH_S - t) / EASE_S).clamp(0.0, 1.0);
        let mut columns: Vec<_> = ["kp", "kd"]
            .into_iter()
            .enumerate()
            .map(|(gain, name)| (name.to_owned(), of_time(&|t| (self.gains)(t)[gain])))
            .collect();
        for joint in Joint::ALL {
            let pose = robot.control.default_pose[joint.index()];
            let command = of_time(&|t| pose + ease(t) * (self.offset)(joint, t));
            columns.push((format!("q_cmd_{}", joint.name()), command));
        }
        columns.push(("t".to_owned(), t));
        let segments = vec![Segment { name: self.name.to_owned(), base: self.base }];
        let mut meta = Meta::new(rate_hz, TorqueSensor::None, segments);
        meta.joints = Joint::ALL.map(|joint| joint.name().to_owned()).to_vec();
        meta.source = Some(format!("twinstep: {}", self.what));
        Log::new_commands(meta, columns).expect("commands of all joints at uniform times are a valid motion file")
    }
}
