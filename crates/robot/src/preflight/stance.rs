//! Small motions on the feet: what the trunk does must agree with gyroscope, quaternion, accelerometer and encoders.

use std::f32::consts::TAU;

use glam::{Mat3, Quat, Vec3};
use twinstep_model::{Feet, Joint, JointKind, Leg, PerJoint, RobotModel, frames};

use super::finding::{Blocks, Finding, LeftOut};
use super::joint_test::JointTest;
use super::passive::{from_xyzw, inverse, inverted, xyzw};
use super::sample::{Sample, mean, without_gaps};
use crate::SafetyConfig;

/// Low stance: hip, thigh, calf of every leg [rad].
pub(super) const STANCE: [f32; 3] = [0.0, 1.2, -2.2];
/// Amplitude of the motions about it [rad].
const AMPLITUDE: f32 = 0.15;
/// Cycles of the components of a motion, with their shares of the amplitude. Two, so that position, velocity and command
/// are independent of each other.
const COMPONENTS: [(f32, f32); 2] = [(1.0, 0.8), (4.0, 0.2)];
/// Time of one motion [s].
const MOTION_S: f64 = 0.5;
/// Number of motions: one for each joint, and one that turns the trunk about z.
const MOTIONS: usize = 13;
/// Duration of all motions [s].
pub(super) const DURATION_S: f64 = MOTION_S * MOTIONS as f64;
/// A trunk whose direction up varies less did not move [rad].
const MIN_TRUNK_MOTION: f32 = 0.004;
/// Number of states over which a rate is computed.
const RATE_WINDOW: usize = 10;
/// Share of the motion by which gyroscope and quaternion may disagree; most of it is noise of the quaternion's rate.
const MAX_RATE_ERROR: f32 = 0.35;
/// Share of the trunk's motion that may not follow from the legs. A mirrored hip leaves 0.08, healthy robots 0.002.
const MAX_UNEXPLAINED: f32 = 0.03;
/// An explanation leaves at most this share of what is unexplained without it.
const MIN_GAIN: f32 = 0.4;
/// Largest constant angle between the feet's plane and the horizontal [rad].
const MAX_PLANE_ANGLE: f32 = 0.06;

/// Returns the joint positions `elapsed` seconds after the start of the motions [rad].
pub(super) fn pose(elapsed: f64) -> PerJoint {
    let mut q = Joint::map_kinds(STANCE[0], STANCE[1], STANCE[2]);
    let phase = TAU * (elapsed / MOTION_S).fract() as f32;
    let change = AMPLITUDE * COMPONENTS.iter().map(|(cycles, share)| share * (phase * cycles).sin()).sum::<f32>();
    let motion = (elapsed / MOTION_S) as usize;
    if let Some(joint) = Joint::ALL.get(motion) {
        q[joint.index()] += change;
    } else if motion < MOTIONS {
        // Front feet to one side, rear feet to the other.
        for leg in Leg::ALL {
            q[3 * leg as usize] += change * leg.front_sign() as f32;
        }
    }
    q
}

/// Returns the states in which a motion was in force.
fn during(samples: &[Sample], motion: usize) -> Vec<Sample> {
    let start = samples.first().map_or(0.0, |sample| sample.time);
    let of = |sample: &&Sample| ((sample.time - start) / MOTION_S) as usize == motion;
    samples.iter().filter(of).cloned().collect()
}

/// Returns what is wrong with joints that moved too little before, and which of them did so again.
pub(super) fn joint_findings(
    samples: &[Sample],
    joints: &[Joint],
    config: &SafetyConfig,
) -> (Vec<Finding>, Vec<LeftOut>) {
    let (mut findings, mut left_out) = (Vec::new(), Vec::new());
    for joint in joints {
        let kind = joint.kind as usize;
        let gains = [config.stand_kp[kind], config.stand_kd[kind]];
        let result = JointTest::of_samples(*joint, gains, during(samples, joint.index())).findings();
        if !result.moved {
            left_out.push(LeftOut {
                check: "encoder and velocity of a joint",
                reason: format!("{joint} moved too little"),
            });
        }
        findings.extend(result.findings);
    }
    (findings, left_out)
}

/// Returns everything that is wrong, and what could not be checked.
pub(super) fn findings(samples: &[Sample], robot: &RobotModel) -> (Vec<Finding>, Vec<LeftOut>) {
    let moved =
        spread(samples, Sample::up).max(spread(samples, |sample| up_of(inverted(from_xyzw(sample.quaternion)))));
    let turned = integrated_turn(samples);
    if moved < MIN_TRUNK_MOTION && turned < MIN_TRUNK_MOTION {
        let reason = format!("the trunk moved by {moved:.4} rad only: the robot hangs, or its legs do not push");
        let left_out = |check| LeftOut { check, reason: reason.clone() };
        return (
            Vec::new(),
            vec![
                left_out("gyroscope against quaternion"),
                left_out("frame of the IMU"),
                left_out("legs against the trunk"),
            ],
        );
    }
    let rates = rate_finding(samples);
    if !rates.is_empty() {
        let reason = "the readings of the IMU disagree with each other".to_owned();
        let left_out = |check| LeftOut { check, reason: reason.clone() };
        return (rates, vec![left_out("frame of the IMU"), left_out("legs against the trunk")]);
    }
    (frame_finding(samples, robot).into_iter().collect(), Vec::new())
}

fn up_of(quaternion: [f32; 4]) -> Vec3 {
    -frames::projected_gravity(quaternion)
}

/// Returns the root mean square deviation of a vector from its mean.
fn spread(samples: &[Sample], value: impl Fn(&Sample) -> Vec3) -> f32 {
    let centre = mean(samples, &value);
    let square: f32 = samples.iter().map(|sample| (value(sample) - centre).length_squared()).sum();
    (square / samples.len().max(1) as f32).sqrt()
}

/// Returns the root mean square of the gyroscope times the period of the motions [rad].
fn integrated_turn(samples: &[Sample]) -> f32 {
    spread(samples, |sample| sample.gyro) * (MOTION_S / std::f64::consts::TAU) as f32
}

/// A way to read gyroscope and quaternion.
struct RateReading {
    gyro: fn(Vec3) -> Vec3,
    quaternion: fn([f32; 4]) -> [f32; 4],
}

fn same<T>(value: T) -> T {
    value
}

/// Returns gyroscope and rate of the quaternion, both in the base frame [rad/s], of a way to read them.
fn rates(samples: &[Sample], reading: &RateReading) -> Vec<(Vec3, Vec3)> {
    let rate = |window: &[Sample]| {
        let ends = [&window[0], &window[RATE_WINDOW]];
        let [from, to] =
            ends.map(|sample| frames::world_from_base((reading.quaternion)(sample.quaternion)).normalize());
        let time = (ends[1].time - ends[0].time) as f32;
        let turn = from.inverse() * to;
        let turn = if turn.w < 0.0 { -turn } else { turn };
        let gyro = mean(&window[..RATE_WINDOW], |sample| (reading.gyro)(sample.gyro));
        (gyro, turn.to_scaled_axis() / time)
    };
    let rates = |part: &[Sample]| part.windows(RATE_WINDOW + 1).step_by(RATE_WINDOW / 2).map(rate).collect::<Vec<_>>();
    without_gaps(samples).into_iter().flat_map(rates).collect()
}

/// Returns the share of the motion in which gyroscope and quaternion disagree.
fn disagreement(rates: &[(Vec3, Vec3)]) -> f32 {
    let error: f32 = rates.iter().map(|(gyro, rate)| (*gyro - *rate).length_squared()).sum();
    let motion: f32 = rates.iter().map(|(gyro, rate)| gyro.length_squared().min(rate.length_squared())).sum();
    error / motion.max(1e-6)
}

/// Compares gyroscope and quaternion, and names the change that makes them agree.
fn rate_finding(samples: &[Sample]) -> Vec<Finding> {
    let of = |gyro: fn(Vec3) -> Vec3, quaternion| disagreement(&rates(samples, &RateReading { gyro, quaternion }));
    let found = of(same, same);
    if found < MAX_RATE_ERROR {
        return Vec::new();
    }
    let gyro = |id, what: &str, remedy: &str, change: fn(Vec3) -> Vec3| {
        (of(change, same), Finding::new(id, what.to_owned(), String::new(), remedy))
    };
    let sign = "change the sign of this axis where the gyroscope is read; the base frame is x forward, y left, z up";
    let order = "reorder the axes where the gyroscope is read; the base frame is x forward, y left, z up";
    let candidates = [
        gyro("gyro_degrees", "the gyroscope is in degrees per second", "convert it to rad/s", |gyro| {
            gyro.map(f32::to_radians)
        }),
        gyro("gyro_axes", "the x and y axes of the gyroscope are exchanged", order, |gyro| {
            Vec3::new(gyro.y, gyro.x, gyro.z)
        }),
        gyro("gyro_axes", "the y and z axes of the gyroscope are exchanged", order, |gyro| {
            Vec3::new(gyro.x, gyro.z, gyro.y)
        }),
        gyro("gyro_axes", "the x and z axes of the gyroscope are exchanged", order, |gyro| {
            Vec3::new(gyro.z, gyro.y, gyro.x)
        }),
        gyro("gyro_sign", "the x axis of the gyroscope has the wrong sign", sign, |gyro| {
            gyro * Vec3::new(-1.0, 1.0, 1.0)
        }),
        gyro("gyro_sign", "the y axis of the gyroscope has the wrong sign", sign, |gyro| {
            gyro * Vec3::new(1.0, -1.0, 1.0)
        }),
        gyro("gyro_sign", "the z axis of the gyroscope has the wrong sign", sign, |gyro| {
            gyro * Vec3::new(1.0, 1.0, -1.0)
        }),
        (of(same, from_xyzw), xyzw(String::new())),
        (of(same, inverted), inverse(String::new())),
    ];
    let best = candidates.into_iter().min_by(|(first, _), (second, _)| first.total_cmp(second));
    let percent = |share: f32| (100.0 * share).round();
    let Some((left, finding)) = best.filter(|(left, _)| *left < MIN_GAIN * found.min(1.0)) else {
        let evidence = format!("they differ by {} % of the motion", percent(found));
        let what = "gyroscope and quaternion disagree".to_owned();
        let remedy = "check axes, signs and units of the gyroscope, and order and frame of the quaternion";
        return vec![Finding::new("gyro_mismatch", what, evidence, remedy).blocking(Blocks::Stance)];
    };
    let evidence = format!(
        "gyroscope and rate of the quaternion differ by {} % of the motion; after this change by {} %",
        percent(found),
        percent(left)
    );
    vec![Finding { evidence, blocks: Blocks::Stance, ..finding }]
}

/// A way to read joints and inertial measurement unit.
struct FrameReading {
    id: &'static str,
    what: String,
    remedy: &'static str,
    joints: Box<dyn Fn(PerJoint) -> PerJoint>,
    base_from_sensor: Mat3,
}

/// Returns the ways to read joints and inertial measurement unit that are tried.
fn frame_readings() -> Vec<FrameReading> {
    let mut readings = Vec::new();
    for degrees in [90, 180, 270] {
        readings.push(FrameReading {
            id: "imu_turned",
            what: format!("the inertial measurement unit is turned by {degrees}° about z"),
            remedy: "turn quaternion, gyroscope and accelerometer into the base frame: x forward, y left, z up",
            joints: Box::new(same),
            base_from_sensor: Mat3::from_quat(Quat::from_rotation_z((degrees as f32).to_radians())),
        });
    }
    for (index, first) in Leg::ALL.into_iter().enumerate() {
        for second in Leg::ALL.into_iter().skip(index + 1) {
            readings.push(FrameReading {
                id: "legs_swapped",
                what: format!("legs {} and {} are exchanged, in commands and states", first.name(), second.name()),
                remedy: "the robot's motors are FR, FL, RR, RL: map them by name; check the cables of the legs",
                joints: Box::new(move |mut q| {
                    for kind in 0..3 {
                        q.swap(3 * first as usize + kind, 3 * second as usize + kind);
                    }
                    q
                }),
                base_from_sensor: Mat3::IDENTITY,
            });
        }
    }
    for joint in Joint::ALL.into_iter().filter(|joint| joint.kind == JointKind::Hip) {
        readings.push(FrameReading {
            id: "joint_mirrored",
            what: format!("{joint} has the opposite sign, in commands and states"),
            remedy: "positive is a rotation about x for every hip, left and right: change the sign where it is mapped",
            joints: Box::new(move |mut q| {
                q[joint.index()] *= -1.0;
                q
            }),
            base_from_sensor: Mat3::IDENTITY,
        });
    }
    readings
}

/// Returns the direction up in the base frame that follows from the joint positions, if all feet are on level ground.
fn up_of_feet(kinematics: &Feet, q: &PerJoint) -> Vec3 {
    let feet = kinematics.motions(q, &[0.0; 12]).map(|foot| foot.position).collect::<Vec<_>>();
    let centre = feet.iter().sum::<Vec3>() / 4.0;
    // Diagonals of the quadrangle span the plane nearest to four points.
    let (first, second) =
        (feet[Leg::FL as usize] - feet[Leg::RR as usize], feet[Leg::FR as usize] - feet[Leg::RL as usize]);
    let normal = first.cross(second).normalize_or_zero();
    let below = if centre.z < 0.0 { 1.0 } else { -1.0 };
    if normal.z < 0.0 { -normal * below } else { normal * below }
}

/// Returns the share of the measured motion of the trunk that the feet do not explain, and their constant difference.
fn unexplained(samples: &[Sample], kinematics: &Feet, reading: Option<&FrameReading>) -> (f32, Vec3) {
    let turn = reading.map_or(Mat3::IDENTITY, |reading| reading.base_from_sensor);
    let measured = |sample: &Sample| turn * sample.up();
    let joints = |q: PerJoint| reading.map_or(q, |reading| (reading.joints)(q));
    let difference = |sample: &Sample| measured(sample) - up_of_feet(kinematics, &joints(sample.q));
    let motion = spread(samples, measured);
    ((spread(samples, difference) / motion).powi(2), mean(samples, difference))
}

/// Compares the trunk's motion with that of the feet, and names the change that makes them agree.
fn frame_finding(samples: &[Sample], robot: &RobotModel) -> Option<Finding> {
    let kinematics = Feet::from(robot);
    let (found, offset) = unexplained(samples, &kinematics, None);
    // No other mistake turns the plane of the feet on average: the legs pass through the same poses on all sides.
    if offset.length() > MAX_PLANE_ANGLE {
        return offset_finding(samples, &kinematics, offset);
    }
    if found < MAX_UNEXPLAINED {
        return None;
    }
    let percent = |share: f32| (100.0 * share).round();
    let candidates = frame_readings().into_iter().map(|reading| {
        let (left, _) = unexplained(samples, &kinematics, Some(&reading));
        (left, reading)
    });
    let best = candidates.min_by(|(first, _), (second, _)| first.total_cmp(second));
    let Some((left, reading)) = best.filter(|(left, _)| *left < MIN_GAIN * found) else {
        let evidence = format!("{} % of the trunk's motion does not follow from the legs", percent(found));
        let remedy =
            "lay the robot on level, firm ground; check the order and signs of the joints and the frame of the IMU";
        let what = "the trunk does not move as the legs do".to_owned();
        return Some(Finding::new("trunk_mismatch", what, evidence, remedy).blocking(Blocks::Stance));
    };
    let evidence = format!(
        "{} % of the trunk's motion does not follow from the legs; after this change {} %",
        percent(found),
        percent(left)
    );
    Some(Finding::new(reading.id, reading.what, evidence, reading.remedy).blocking(Blocks::Stance))
}

/// Names the joint whose zero explains a constant angle between the plane of the feet and the horizontal.
fn offset_finding(samples: &[Sample], kinematics: &Feet, offset: Vec3) -> Option<Finding> {
    let left = |joint: Joint, angle: f32| {
        let difference = |sample: &Sample| {
            let mut q = sample.q;
            q[joint.index()] -= angle;
            sample.up() - up_of_feet(kinematics, &q)
        };
        let constant = mean(samples, difference);
        (constant.length_squared() + spread(samples, difference).powi(2)).sqrt()
    };
    let angles = (-10..=10).filter(|step| *step != 0).map(|step| 0.05 * step as f32);
    let candidates = angles.flat_map(|angle| Joint::ALL.map(|joint| (left(joint, angle), joint, angle)));
    let (error, joint, angle) = candidates.min_by(|first, second| first.0.total_cmp(&second.0))?;
    let evidence = format!(
        "the feet's plane is tilted by {:.2} rad against gravity; with {joint} at {:+.2} rad by {error:.2} rad",
        offset.length(),
        -angle
    );
    let remedy = "calibrate the joint's zero; if the ground slopes, repeat on level ground";
    let what = format!("the zero of {joint} is wrong by about {angle:+.2} rad, or the ground slopes");
    Some(Finding::new("joint_offset", what, evidence, remedy).blocking(Blocks::Stance))
}
