//! What is wrong without moving the robot.

use glam::Vec3;
use twinstep_model::{Feet, Joint, JointKind, Leg, PerJoint, RobotModel, frames};
use twinstep_unitree::LowState;

use super::finding::{Blocks, Finding};
use super::sample::{MAX_GAP_S, MIN_USED, Sample, joint_mean, mean};
use crate::SafetyConfig;
use crate::command::scaled_range;

/// Acceleration of gravity [m/s²].
const GRAVITY: f32 = 9.81;
/// Largest deviation of the accelerometer from gravity [m/s²].
const MAX_ACC_ERROR: f32 = 0.7;
/// Largest mean of the gyroscope beside the rate of the quaternion [rad/s].
const MAX_GYRO_BIAS: f32 = 0.1;
/// Largest angle between gravity from the quaternion and from the accelerometer [rad].
const MAX_GRAVITY_ANGLE: f32 = 0.12;
/// A foot of a robot that lies or hangs is not farther above its hip [m].
const MAX_FOOT_ABOVE_HIP: f32 = 0.06;

/// What was observed without moving the robot.
#[derive(Clone, Debug, Default)]
pub(super) struct Observation {
    /// Number of states, and of those with a wrong checksum.
    pub states: u32,
    pub damaged: u32,
    /// Time of the observation [s].
    pub seconds: f64,
    /// Number of states, and time [s], without those in which this computer stood still.
    pub counted: (u32, f64),
    /// First and last value of the robot's clock.
    pub ticks: Option<[u32; 2]>,
    /// Lost messages of all motors, at the start and now.
    pub lost: Option<[u32; 2]>,
    /// States of another robot have arrived.
    pub other_robot: bool,
    /// Largest number of other writers.
    pub foreign_writers: usize,
    /// Name of the active built-in controller.
    pub controller: Option<String>,
    pub remote_received: bool,
    pub last: Option<LowState>,
    pub samples: Vec<Sample>,
}

impl Observation {
    /// Counts a state.
    pub fn add(&mut self, state: &LowState) {
        self.states += 1;
        if state.check_checksum().is_err() {
            self.damaged += 1;
            return;
        }
        let lost = state.motor_state.iter().fold(0_u32, |sum, motor| sum.wrapping_add(motor.lost));
        self.ticks = Some([self.ticks.map_or(state.tick, |[first, _]| first), state.tick]);
        self.lost = Some([self.lost.map_or(lost, |[first, _]| first), lost]);
        self.remote_received |= twinstep_unitree::Remote::decode(&state.wireless_remote).is_some();
        self.last = Some(state.clone());
    }

    /// Counts the states that arrived `seconds` after the step before.
    pub fn count(&mut self, states: usize, seconds: f64) {
        if seconds <= MAX_GAP_S {
            self.counted = (self.counted.0 + states as u32, self.counted.1 + seconds);
        }
    }

    /// Returns true if this computer stood still for so little of the time that the rate of the states is known.
    pub fn has_rate(&self) -> bool {
        self.counted.1 >= MIN_USED * self.seconds
    }

    /// Returns everything that is wrong.
    pub fn findings(&self, robot: &RobotModel, config: &SafetyConfig) -> Vec<Finding> {
        if self.states == 0 {
            return [self.surroundings(), vec![self.no_states()]].concat();
        }
        let mut findings = self.surroundings();
        findings.extend(self.link(config));
        if let Some(state) = &self.last {
            findings.extend(power(state, config));
        }
        if !self.samples.is_empty() {
            let joints = self.joints(robot, config);
            // Feet computed from impossible positions would be a second name for the same mistake.
            findings.extend(if joints.is_empty() { self.feet(robot) } else { joints });
            findings.extend(self.imu(config));
        }
        findings
    }

    fn no_states(&self) -> Finding {
        Finding::new(
            "no_states",
            "the robot sends no states on this interface and domain".to_owned(),
            format!("0 states arrived in {:.1} s", self.seconds),
            "name the interface of the robot's network (192.168.123.0/24) and domain 0 (a simulator: 1), check cable and \
             power",
        )
        .blocking(Blocks::Motion)
    }

    fn surroundings(&self) -> Vec<Finding> {
        let writer = (self.foreign_writers > 0).then(|| {
            Finding::new(
                "foreign_writer",
                "another process commands the motors".to_owned(),
                format!("{} other writers of `rt/lowcmd` were discovered", self.foreign_writers),
                "stop the other process; its messages and yours would be executed in turn",
            )
        });
        let other_robot = self.other_robot.then(|| {
            Finding::new(
                "other_robot",
                "there is more than one robot on this domain".to_owned(),
                "several writers of `rt/lowstate` send states".to_owned(),
                "stop the second robot, the simulator or the replayed log, or use another domain",
            )
        });
        let controller = self.controller.as_ref().map(|name| {
            Finding::new(
                "controller_active",
                "the robot's built-in controller is active".to_owned(),
                format!("`motion_switcher` answers the name `{name}`"),
                "release it (procedure 1003 of `motion_switcher`) while the robot lies",
            )
        });
        writer
            .into_iter()
            .chain(other_robot)
            .chain(controller)
            .map(|finding| finding.blocking(Blocks::Motion))
            .collect()
    }

    fn link(&self, config: &SafetyConfig) -> Vec<Finding> {
        let mut findings = Vec::new();
        if self.damaged > 0 {
            let evidence = format!("{} of {} states have a wrong checksum", self.damaged, self.states);
            let remedy = "check cable and message definition: the checksum is over the C structure, not over the CDR";
            findings.push(Finding::new("checksum", "states are damaged".to_owned(), evidence, remedy));
        }
        let rate = f64::from(self.counted.0) / self.counted.1;
        if self.has_rate() && rate < f64::from(config.min_state_hz) {
            let evidence = format!("{rate:.0} states per second, at least {} are needed", config.min_state_hz);
            let remedy = "read `rt/lowstate`, not `rt/lf/lowstate`; use the cable, not the wireless network";
            findings.push(Finding::new("state_rate", "states arrive too rarely".to_owned(), evidence, remedy));
        }
        if let Some([first, last]) =
            self.lost.filter(|[first, last]| last.wrapping_sub(*first) > config.max_lost_messages)
        {
            let evidence = format!("{} lost messages in {:.1} s", last.wrapping_sub(first), self.seconds);
            let remedy = "check the wiring between main board and motors";
            findings.push(Finding::new("messages_lost", "motors lose their messages".to_owned(), evidence, remedy));
        }
        if config.remote_required && self.last.is_some() && !self.remote_received {
            let evidence = format!("`wireless_remote` was zero for {:.1} s", self.seconds);
            let remedy = "switch the remote control on and bring it closer: it is the emergency stop";
            findings.push(Finding::new("remote_lost", "no remote control is received".to_owned(), evidence, remedy));
        }
        let mut findings: Vec<_> = findings.into_iter().map(|finding| finding.blocking(Blocks::Motion)).collect();
        if let Some([first, last]) = self.ticks.filter(|[first, last]| first == last && self.states > 1) {
            let evidence = format!("`tick` was {first} at the start and {last} at the end of {:.1} s", self.seconds);
            let remedy = "restart the robot; until then measure the age of a state by its arrival";
            findings.push(Finding::new("clock_stopped", "the robot's clock stands still".to_owned(), evidence, remedy));
        }
        findings
    }

    fn joints(&self, robot: &RobotModel, config: &SafetyConfig) -> Vec<Finding> {
        let q = joint_mean(&self.samples, |sample| sample.q);
        let range = |joint: Joint| scaled_range(robot.joints[joint.index()].range, config.max_joint_limit_factor);
        let is_inside = |joint: Joint, q: f32| (range(joint)[0]..=range(joint)[1]).contains(&q);
        let outside: Vec<_> = Joint::ALL.into_iter().filter(|joint| !is_inside(*joint, q[joint.index()])).collect();
        let in_degrees = Joint::ALL.into_iter().all(|joint| is_inside(joint, q[joint.index()].to_radians()));
        if outside.len() >= 4 && in_degrees {
            let largest = q.into_iter().fold(0.0_f32, |largest, q| largest.max(q.abs()));
            let evidence =
                format!("{} joints are beyond their ends, up to {largest:.0}; read as degrees none is", outside.len());
            let remedy = "convert joint positions to radians where the states are made";
            let what = "joint positions are in degrees, not radians".to_owned();
            return vec![Finding::new("encoder_degrees", what, evidence, remedy).blocking(Blocks::Motion)];
        }
        outside.into_iter().map(|joint| outside_finding(joint, q[joint.index()], range(joint))).collect()
    }

    /// Feet far above their hips: a thigh or calf with the wrong sign or zero.
    fn feet(&self, robot: &RobotModel) -> Vec<Finding> {
        let q = joint_mean(&self.samples, |sample| sample.q);
        let feet = Feet::from(robot).motions(&q, &[0.0; 12]).collect::<Vec<_>>();
        let high = Leg::ALL.into_iter().filter(|leg| feet[*leg as usize].position.z > MAX_FOOT_ABOVE_HIP);
        high.map(|leg| {
            let thigh = Joint { leg, kind: JointKind::Thigh };
            let evidence = format!(
                "thigh {:.2} rad and calf {:.2} rad put the foot {:.2} m above the hip; a leg that lies or hangs is below",
                q[thigh.index()],
                q[thigh.index() + 1],
                feet[leg as usize].position.z
            );
            let what = format!("thigh or calf of leg {} has the wrong sign or zero", leg.name());
            let remedy = "compare the joint's zero and direction with the model; positive is a rotation about y, to the left";
            Finding::new("joint_implausible", what, evidence, remedy).blocking(Blocks::Motion)
        })
        .collect()
    }

    fn imu(&self, config: &SafetyConfig) -> Vec<Finding> {
        let acc = mean(&self.samples, |sample| sample.acc);
        let gyro = mean(&self.samples, |sample| sample.gyro);
        let mut findings = Vec::new();
        // A robot that sways is no fault of its gyroscope.
        let bias = (gyro - self.turn_rate()).length();
        if bias > MAX_GYRO_BIAS {
            let evidence = format!(
                "its mean is {bias:.2} rad/s beside the rate of the quaternion; at most {MAX_GYRO_BIAS} is allowed"
            );
            let remedy = "keep the robot at rest while it starts; check the gyroscope's unit";
            findings.push(Finding::new("gyro_bias", "the gyroscope has a bias".to_owned(), evidence, remedy));
        }
        // The mean of a robot that turns is shorter by as much as that of its upward direction.
        let up_length = mean(&self.samples, Sample::up).length();
        findings.extend(accelerometer(acc, GRAVITY * up_length));
        findings.extend(self.orientation(acc, config));
        findings
    }

    /// Returns the mean angular velocity that follows from the quaternion, in the base frame [rad/s].
    fn turn_rate(&self) -> Vec3 {
        let (Some(first), Some(last)) = (self.samples.first(), self.samples.last()) else { return Vec3::ZERO };
        let [from, to] = [first, last].map(|sample| frames::world_from_base(sample.quaternion).normalize());
        let turn = from.inverse() * to;
        let turn = if turn.w < 0.0 { -turn } else { turn };
        turn.to_scaled_axis() / (last.time - first.time).max(f64::EPSILON) as f32
    }

    /// Compares gravity from quaternion and accelerometer, and finds another reading of the quaternion that agrees.
    fn orientation(&self, acc: Vec3, config: &SafetyConfig) -> Vec<Finding> {
        let up = mean(&self.samples, Sample::up).normalize_or_zero();
        let measured = acc.normalize_or_zero();
        let angle = up.angle_between(measured);
        let evidence =
            |angle: f32| format!("gravity of quaternion and accelerometer are {:.0}° apart", angle.to_degrees());
        if angle > std::f32::consts::PI - 4.0 * MAX_GRAVITY_ANGLE {
            let remedy = "the accelerometer measures the specific force, +9.81 m/s² upward at rest: change its sign";
            let what = "the accelerometer has the wrong sign".to_owned();
            return vec![Finding::new("accelerometer_sign", what, evidence(angle), remedy)];
        }
        if angle > MAX_GRAVITY_ANGLE {
            return vec![self.quaternion(measured, evidence(angle)).blocking(Blocks::Motion)];
        }
        let max = config.stand_max_tilt_deg;
        let tilt = up.angle_between(Vec3::Z).to_degrees();
        if up.z < -0.5 {
            let evidence = format!("accelerometer {:.1} m/s² along z and quaternion agree: up is down", acc.z);
            let what = "the inertial measurement unit is mounted upside down, or the robot lies on its back".to_owned();
            let remedy = "lay the robot on its belly; if it does lie there, turn the readings by 180° about x";
            return vec![Finding::new("imu_upside_down", what, evidence, remedy).blocking(Blocks::Motion)];
        }
        if tilt > max {
            let evidence = format!("the trunk is tilted by {tilt:.0}°, at most {max:.0}° are allowed");
            let remedy = "lay the robot on its belly, on level ground";
            return vec![
                Finding::new("tilted", "the robot does not lie level".to_owned(), evidence, remedy)
                    .blocking(Blocks::Motion),
            ];
        }
        Vec::new()
    }

    fn quaternion(&self, measured: Vec3, evidence: String) -> Finding {
        let agrees = |read: &dyn Fn([f32; 4]) -> [f32; 4]| {
            let up = mean(&self.samples, |sample| -frames::projected_gravity(read(sample.quaternion)));
            up.normalize_or_zero().angle_between(measured) < MAX_GRAVITY_ANGLE
        };
        if agrees(&from_xyzw) {
            xyzw(format!("{evidence}; read as x, y, z, w they agree"))
        } else if agrees(&inverted) {
            inverse(format!("{evidence}; with the inverse quaternion they agree"))
        } else {
            let remedy = "check order, sign and frame of quaternion and accelerometer";
            Finding::new("gravity_mismatch", "quaternion and accelerometer disagree".to_owned(), evidence, remedy)
        }
    }
}

/// Returns w, x, y, z of a quaternion x, y, z, w.
pub(super) fn from_xyzw([x, y, z, w]: [f32; 4]) -> [f32; 4] {
    [w, x, y, z]
}

/// Returns the inverse rotation.
pub(super) fn inverted([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    [w, -x, -y, -z]
}

pub(super) fn xyzw(evidence: String) -> Finding {
    let what = "the quaternion is x, y, z, w".to_owned();
    let remedy = "the Go2 sends w, x, y, z: reorder where the quaternion is read";
    Finding::new("quaternion_xyzw", what, evidence, remedy).blocking(Blocks::Stance)
}

pub(super) fn inverse(evidence: String) -> Finding {
    let what = "the quaternion is the rotation from world to base, not from base to world".to_owned();
    let remedy = "invert the quaternion where it is read";
    Finding::new("quaternion_inverted", what, evidence, remedy).blocking(Blocks::Stance)
}

/// Compares the mean of the accelerometer with the expected length [m/s²].
fn accelerometer(acc: Vec3, expected: f32) -> Option<Finding> {
    let length = acc.length();
    let evidence = format!("the mean is {length:.2} in place of {expected:.2} m/s²");
    if (length - expected).abs() <= MAX_ACC_ERROR {
        None
    } else if (length - expected / GRAVITY).abs() < MAX_ACC_ERROR / GRAVITY {
        let remedy = "multiply the readings by 9.81";
        Some(Finding::new("accelerometer_g", "the accelerometer is in g, not m/s²".to_owned(), evidence, remedy))
    } else {
        let remedy = "check the unit and the calibration of the accelerometer";
        Some(Finding::new("accelerometer_scale", "the accelerometer has the wrong scale".to_owned(), evidence, remedy))
    }
}

fn outside_finding(joint: Joint, q: f32, [low, high]: [f32; 2]) -> Finding {
    let evidence = format!("it reads {q:.2} rad; its range with tolerance is {low:.2} to {high:.2}");
    let remedy = "check scale, sign and zero of its encoder (the calf's gear ratio is 1.917)";
    Finding::new("joint_out_of_range", format!("{joint} is beyond its end"), evidence, remedy).blocking(Blocks::Motion)
}

fn power(state: &LowState, config: &SafetyConfig) -> Vec<Finding> {
    let mut findings = Vec::new();
    let (charge, min) = (state.bms_state.soc, config.arm_min_charge_percent);
    if charge < min {
        let evidence = format!("the battery reports {charge} %; at least {min} % are needed");
        findings.push(Finding::new(
            "battery_low",
            "the battery is nearly empty".to_owned(),
            evidence,
            "charge the battery",
        ));
    }
    if state.power_v < config.min_voltage_v {
        let evidence = format!("{:.1} V; at least {} V are needed", state.power_v, config.min_voltage_v);
        findings.push(Finding::new(
            "voltage_low",
            "the supply voltage is too low".to_owned(),
            evidence,
            "charge the battery",
        ));
    }
    let temperature: PerJoint =
        Joint::ALL.map(|joint| f32::from(state.motor_state[twinstep_unitree::motor_index(joint)].temperature));
    for joint in Joint::ALL {
        let (celsius, max) = (temperature[joint.index()], config.arm_max_temperature_c);
        if celsius > f32::from(max) {
            let evidence = format!("it reports {celsius} °C; at most {max} °C are allowed");
            findings.push(Finding::new(
                "motor_hot",
                format!("the motor of {joint} is hot"),
                evidence,
                "let the motor cool",
            ));
        }
    }
    findings.into_iter().map(|finding| finding.blocking(Blocks::Motion)).collect()
}
