//! Motions of a case: with a fixed base, standing, or both in turn, 20 to 25 s; walking, half a minute; with trot and hops,
//! a minute.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use rand::{Rng, RngExt};
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, Joint, JointKind, NUM_JOINTS, go2};

use crate::base_schedule::BaseSchedule;
use crate::log_setup::LogSetup;

/// Rate of the log [Hz].
pub const RATE_HZ: f64 = 200.0;
/// Number of poses of [`Phase::Holds`].
const POSES: usize = 12;
/// Duration of a pose, with the transition to it [s].
const POSE_S: f64 = 1.0;
/// Duration of the transition to a pose [s].
const WAY_S: f64 = 0.35;
/// Period of [`Phase::Sway`] [s].
const SWAY_S: f64 = 3.0;
/// Part of the period of [`Phase::Sway`] in which the robot moves [s].
const SWAYING_S: f64 = 2.2;
/// Periods of the strides of [`Phase::Walk`]: forwards and backwards, and left and right [s].
const STRIDE_S: [f64; 2] = [9.0, 5.0];

/// Phase of a motion, and what it makes visible.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Chirps of all joints: inertia, viscous friction, delays.
    Chirp,
    /// Ramps of about 0.15 rad/s with reversals: friction at low speed, backlash.
    Creep,
    /// Square waves with higher gains: torque and speed limits, delays.
    Steps,
    /// Sequence of poses: gravity, springs, gains.
    Holds,
    /// Slow motion of the base over standing feet, with pauses: payload, offsets, ground.
    Sway,
    /// The default pose.
    Stand,
    /// Trot on the spot: diagonal pairs of legs swing in turn.
    Trot,
    /// Hops on all legs.
    Hop,
    /// Trot with strides that change their length and direction.
    Walk,
}

/// Random parameters of a motion.
struct Style {
    /// Phase shift of each joint [rad].
    shift: [f64; NUM_JOINTS],
    /// Factor on each joint's rate.
    pace: [f64; NUM_JOINTS],
    /// Poses of [`Phase::Holds`], as offsets from the default pose [rad].
    poses: [[f64; NUM_JOINTS]; POSES],
    /// Highest frequency of the chirp [Hz].
    chirp_hz: f64,
    /// Position gains: low, high, standing [N·m/rad].
    kp: [f64; 3],
    /// Velocity gain [N·m·s/rad].
    kd: f64,
}

impl Style {
    fn draw(random: &mut impl Rng) -> Self {
        let mut joints = |low: f64, high: f64| std::array::from_fn(|_| random.random_range(low..high));
        let (shift, pace) = (joints(0.0, TAU), joints(0.8, 1.25));
        let poses = std::array::from_fn(|_| joints(-0.35, 0.35));
        let kp = [random.random_range(20.0..35.0), random.random_range(55.0..75.0), random.random_range(40.0..60.0)];
        Self { shift, pace, poses, chirp_hz: random.random_range(4.0..6.0), kp, kd: random.random_range(0.6..1.0) }
    }

    /// Returns the position gain of a phase [N·m/rad].
    fn kp(&self, phase: Phase) -> f64 {
        match phase {
            Phase::Steps => self.kp[1],
            Phase::Sway | Phase::Stand | Phase::Trot | Phase::Hop | Phase::Walk => self.kp[2],
            Phase::Chirp | Phase::Creep | Phase::Holds => self.kp[0],
        }
    }

    /// Returns the commanded offset from the default pose [rad], `time` [s] into a phase of `length` [s].
    fn offset(&self, phase: Phase, joint: Joint, time: f64, length: f64) -> f64 {
        let index = joint.index();
        let (shift, pace) = (self.shift[index], self.pace[index]);
        let reach = if joint.kind == JointKind::Hip { 0.75 } else { 1.0 };
        let ease = (time / 0.3).min(1.0);
        reach
            * match phase {
                Phase::Chirp => {
                    let turns = (0.3 + 0.5 * (self.chirp_hz - 0.3) * time / length) * time;
                    ease * 0.35 * (TAU * pace * turns + shift).sin()
                }
                Phase::Creep => ease * triangle(0.15 * pace * time / 0.8 + shift / TAU) * 0.2,
                Phase::Steps => {
                    // Keeps a distance from the end of the calf's range, because steps overshoot.
                    let middle = if joint.kind == JointKind::Calf { -0.2 } else { 0.0 };
                    middle + 0.34 * (TAU * 1.4 * pace * time + shift).sin().signum()
                }
                Phase::Holds => {
                    let pose = (time / POSE_S) as usize;
                    let before = if pose == 0 { 0.0 } else { self.poses[(pose - 1) % POSES][index] };
                    let way = ((time - pose as f64 * POSE_S) / WAY_S).min(1.0);
                    before + (self.poses[pose % POSES][index] - before) * way * way * (3.0 - 2.0 * way)
                }
                Phase::Sway => self.sway(joint, time) / reach,
                Phase::Stand => 0.0,
                Phase::Trot => ease * fold(joint.kind, 0.25 * self.swing(joint, time).sin().max(0.0)),
                Phase::Walk => {
                    let swing = self.swing(joint, time);
                    let [ahead, turn] = STRIDE_S.map(|period| (TAU * time / period + self.shift[1]).sin());
                    let stride = 0.14 * ahead + 0.05 * joint.leg.left_sign() * turn;
                    let way = if joint.kind == JointKind::Thigh { stride * swing.cos() } else { 0.0 };
                    ease * (fold(joint.kind, 0.25 * swing.sin().max(0.0)) + way)
                }
                Phase::Hop => {
                    let crouch = 0.5 - 0.5 * (TAU * 2.0 * self.pace[1] * time).cos();
                    ease * fold(joint.kind, 0.3 * crouch)
                }
            }
    }

    /// Returns the phase of a leg in a trot [rad]: it swings in the first half.
    fn swing(&self, joint: Joint, time: f64) -> f64 {
        let first = joint.leg.front_sign() * joint.leg.left_sign() > 0.0;
        let half = if first { 0.0 } else { 0.5 };
        TAU * (1.8 * self.pace[0] * time + half).fract()
    }

    /// Returns the offset [rad] of a joint that lifts, pitches, rolls and shifts the base over fixed feet, with pauses.
    fn sway(&self, joint: Joint, time: f64) -> f64 {
        let swaying = (time / SWAY_S).floor() * SWAYING_S + (time % SWAY_S).min(SWAYING_S);
        let wave = |way: usize| {
            let rates = [(0.31, 0.5), (0.57, 0.3), (0.97, 0.2)];
            let waves = rates.iter().enumerate().map(|(index, (rate, part))| {
                part * (TAU * rate * self.pace[way] * swaying + self.shift[(way + 5 * index) % 12]).sin()
            });
            time.min(1.0) * waves.sum::<f64>()
        };
        let (front, left) = (joint.leg.front_sign(), joint.leg.left_sign());
        let length = 0.14 * wave(0) + 0.07 * front * wave(1) + 0.03 * left * wave(2);
        match joint.kind {
            JointKind::Hip => 0.05 * wave(3),
            JointKind::Thigh => length + 0.06 * wave(4),
            JointKind::Calf => -2.0 * length,
        }
    }
}

/// Returns the offset of a joint [rad] when a leg is folded by `angle` [rad] below its hip.
fn fold(kind: JointKind, angle: f64) -> f64 {
    match kind {
        JointKind::Hip => 0.0,
        JointKind::Thigh => angle,
        JointKind::Calf => -2.0 * angle,
    }
}

/// Returns a triangle wave of period 1, from −1 to 1.
fn triangle(turns: f64) -> f64 {
    4.0 * ((turns - turns.floor()) - 0.5).abs() - 1.0
}

/// Returns the phases with their durations [s]. The base floats in [`Phase::Sway`] and the phases after it.
fn phases(place: BaseSchedule) -> &'static [(Phase, f64)] {
    match place {
        BaseSchedule::Fixed => &[(Phase::Chirp, 8.0), (Phase::Creep, 5.0), (Phase::Steps, 4.0), (Phase::Holds, 6.0)],
        BaseSchedule::Floating => &[(Phase::Sway, 22.0)],
        BaseSchedule::FixedThenFloating => {
            &[(Phase::Chirp, 5.0), (Phase::Creep, 4.0), (Phase::Steps, 2.5), (Phase::Holds, 4.0), (Phase::Sway, 9.0)]
        }
        BaseSchedule::Whole => &[
            (Phase::Chirp, 6.0),
            (Phase::Creep, 5.0),
            (Phase::Steps, 3.0),
            (Phase::Holds, 4.0),
            (Phase::Stand, 6.0),
            (Phase::Sway, 16.0),
            (Phase::Trot, 12.0),
            (Phase::Hop, 8.0),
        ],
        BaseSchedule::Walking => &[(Phase::Stand, 2.0), (Phase::Walk, 28.0)],
    }
}

/// Returns the commands of a case, with voltage and temperatures if they are measured.
pub fn motion(setting: LogSetup, random: &mut impl Rng) -> Log {
    let style = Style::draw(random);
    let mut columns = BTreeMap::<String, Vec<f64>>::new();
    for (phase, length) in phases(setting.place) {
        let length = &(length * setting.length.factor());
        for row in 0..(length * RATE_HZ).round() as usize {
            let time = row as f64 / RATE_HZ;
            let t = columns.get("t").map_or(0, Vec::len) as f64 / RATE_HZ;
            let mut cell = |name: String, value: f64| columns.entry(name).or_default().push(value);
            cell("t".to_owned(), t);
            cell("segment".to_owned(), segment_index(setting.place, *phase));
            cell("kp".to_owned(), style.kp(*phase));
            cell("kd".to_owned(), style.kd);
            for joint in Joint::ALL {
                let pose = go2().control.default_pose[joint.index()];
                cell(format!("q_cmd_{}", joint.name()), pose + style.offset(*phase, joint, time, *length));
            }
            if setting.battery {
                cell("battery_V".to_owned(), voltage(t, style.shift[0]));
            }
            if setting.temperature {
                for (index, name) in JOINT_NAMES.iter().enumerate() {
                    cell(format!("temp_{name}"), temperature(t, style.pace[index]));
                }
            }
        }
    }
    let segment = |name: &str, base| Segment { name: name.to_owned(), base };
    let (air, stance) = (segment("air", BaseMount::Fixed), segment("stance", BaseMount::Floating));
    let segments = match setting.place {
        BaseSchedule::Fixed => vec![air],
        BaseSchedule::Floating => vec![stance],
        BaseSchedule::Walking => vec![segment("walk", BaseMount::Floating)],
        BaseSchedule::FixedThenFloating => vec![air, stance],
        BaseSchedule::Whole => {
            vec![air, stance, segment("trot", BaseMount::Floating), segment("hop", BaseMount::Floating)]
        }
    };
    let mut meta = Meta::new(RATE_HZ, TorqueSensor::MotorCurrent, segments);
    meta.joints = JOINT_NAMES.map(str::to_owned).to_vec();
    Log::new_commands(meta, columns).expect("a motion")
}

/// Returns the index of the segment of a phase.
fn segment_index(place: BaseSchedule, phase: Phase) -> f64 {
    if matches!(place, BaseSchedule::Fixed | BaseSchedule::Floating | BaseSchedule::Walking) {
        return 0.0;
    }
    match phase {
        Phase::Chirp | Phase::Creep | Phase::Steps | Phase::Holds => 0.0,
        Phase::Sway | Phase::Stand => 1.0,
        Phase::Trot | Phase::Walk => 2.0,
        Phase::Hop => 3.0,
    }
}

/// Returns the voltage of a battery that discharges and sags under a varying load [V].
fn voltage(t: f64, shift: f64) -> f64 {
    let load = 0.5 + 0.3 * (TAU * t / 3.7 + shift).sin() + 0.2 * (TAU * t / 1.3).sin();
    29.4 - 0.05 * t - 3.5 * load
}

/// Returns the temperature of a motor that heats up [°C], faster than a real one, so that half a minute is enough.
fn temperature(t: f64, pace: f64) -> f64 {
    30.0 + 50.0 * (1.0 - (-t * pace / 12.0).exp())
}

#[cfg(test)]
mod tests {
    use twinstep_model::stream;

    use super::*;
    use crate::base_schedule::LogLength;

    #[test]
    fn commands_stay_within_the_joint_ranges() {
        for (place, length, seconds, seed) in [
            (BaseSchedule::Fixed, LogLength::Standard, 20.0..25.0, 0),
            (BaseSchedule::Floating, LogLength::Standard, 20.0..25.0, 1),
            (BaseSchedule::FixedThenFloating, LogLength::Standard, 20.0..25.0, 2),
            (BaseSchedule::Whole, LogLength::Standard, 60.0..61.0, 3),
            (BaseSchedule::Walking, LogLength::Standard, 30.0..31.0, 4),
            (BaseSchedule::Whole, LogLength::TenSeconds, 9.9..10.1, 5),
            (BaseSchedule::Whole, LogLength::FiveMinutes, 300.0..301.0, 6),
        ] {
            let setting = LogSetup { battery: true, temperature: true, length, ..LogSetup::with_torque(place) };
            let motion = motion(setting, &mut stream(seed, "test", 0));
            assert!(seconds.contains(&(motion.rows() as f64 / RATE_HZ)), "{place:?}");
            for joint in Joint::ALL {
                let [low, high] = go2().joints[joint.index()].range;
                let cells = motion.q_cmd(joint.name()).expect("commanded");
                assert!(cells.iter().all(|cell| (low + 0.1..high - 0.1).contains(cell)), "{place:?} {joint}");
            }
        }
    }
}
