//! All equations of a log: blocks of residuals, and the column of any change of the robot.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::OnceLock;

use rayon::prelude::*;

use super::balance::{Balance, advanced};
use super::block::{Block, Column};
use super::drive::{link_torque, sensed_torque};
use super::gaussian::Group;
use super::law::{Law, Place};
use super::measurements::{JointRows, Measurements, Regime};
use super::robot::Robot;
use super::samples::Sample;
use super::site::Site;

/// Rows at the start of a range in which a drive has the commands of before [s].
const HISTORY_S: f64 = 0.05;
/// Speed below which the dry friction between motor and torque sensor is not determined [rad/s].
const LEAST_SPEED: f64 = 0.1;
/// Torque within which the teeth of a gear with backlash change sides [N·m].
const SLACK: f64 = 0.05;
/// Time between samples of the gyroscope [s].
const GYRO_S: f64 = 0.05;

/// The equations of a log.
pub struct System {
    /// What was measured.
    pub measured: Measurements,
    /// Force balance.
    pub balance: Balance,
    /// Blocks with the residuals of the robot for which they were written last.
    pub blocks: Vec<Block>,
    /// Block and rows of the log of the torques of each joint.
    drive_rows: Vec<Vec<(usize, Vec<usize>)>>,
    /// Blocks of the gyroscope, with the rows of the log.
    gyro_rows: Vec<(usize, Vec<usize>)>,
    /// The robot whose residuals are from measured torques.
    reference: Robot,
    /// Mean torques of its motors on smooth readings, by joint and sample; empty if torques were measured [N·m].
    first_motors: Vec<Vec<f64>>,
    /// Small unknowns of bodies and their motion.
    pub of_bodies: OnceLock<Vec<Group>>,
}

/// Torques that a robot's drives have on the measured states, by joint.
pub struct Predicted {
    /// At the sensor, by row [N·m].
    sensed: Vec<Vec<f64>>,
    /// At the motor, by joint and sample [N·m].
    motor: Vec<Vec<f64>>,
    /// At motors that are in balance with the motion, by sample and joint [N·m].
    balanced: Vec<Vec<f64>>,
    /// Moment and force at the base, and torques of the joints, that the robot lacks, by sample.
    lacking: Vec<Vec<f64>>,
    /// How a link moves differently from its encoder, by joint and sample; empty for a stiff gear.
    shifts: Vec<Vec<[f64; 3]>>,
}

impl Predicted {
    /// Returns the torque at the sensor of a joint, by row [N·m].
    pub fn sensed(&self, joint: usize) -> &[f64] {
        &self.sensed[joint]
    }

    /// Returns the torques of motors that are in balance with the motion of a sample, by joint [N·m].
    pub fn balanced(&self, sample: usize) -> &[f64] {
        &self.balanced[sample]
    }
}

impl System {
    /// Returns blocks and rows of the torques of a joint.
    pub fn drive_rows(&self, joint: usize) -> &[(usize, Vec<usize>)] {
        &self.drive_rows[joint]
    }

    /// Collects the equations of a log.
    pub fn new(mut measured: Measurements, robot: &Robot) -> Self {
        if !measured.has_torque {
            measured.set_torques_of_drives(robot);
        }
        let mut blocks = Vec::new();
        let drive_rows = drive_blocks(&measured, robot, &mut blocks);
        let gyro_rows = gyro_blocks(&measured, &mut blocks);
        let balance = Balance::new(&measured, robot, &mut blocks);
        let lacking = |smooth: bool| -> Vec<Vec<f64>> {
            let of = |rows: &JointRows| {
                let readings = if smooth { [&rows.smooth[0], &rows.smooth[1]] } else { [&rows.q, &rows.dq] };
                let sensed = sensed_torque(&measured, rows, readings.map(Vec::as_slice), robot);
                rows.torque.iter().zip(&sensed).map(|(measured, sensed)| measured - sensed).collect()
            };
            measured.joints.par_iter().map(of).collect()
        };
        let [raw, smooth] = [lacking(false), lacking(true)];
        let has_readings = measured.has_torque && roughness(&raw) < roughness(&smooth);
        if has_readings {
            for rows in &mut measured.joints {
                rows.smooth = [rows.q.clone(), rows.dq.clone()];
            }
        }
        let mut system = Self {
            measured,
            balance,
            blocks,
            drive_rows,
            gyro_rows,
            reference: robot.clone(),
            first_motors: Vec::new(),
            of_bodies: OnceLock::new(),
        };
        if !system.measured.has_torque {
            system.first_motors = system.predicted(robot).motor;
        }
        system
    }

    /// Returns the torques of the drives of a robot.
    pub fn predicted(&self, robot: &Robot) -> Predicted {
        let joints = &self.measured.joints;
        let sensed: Vec<Vec<f64>> = joints.par_iter().map(|rows| self.sensed(rows, robot)).collect();
        let motor =
            joints.par_iter().zip(&sensed).map(|(rows, sensed)| self.motor(robot, rows.joint, sensed)).collect();
        let mut rigid = robot.clone();
        for joint in &mut rigid.joints {
            (joint.actuator.backlash, joint.actuator.gear_stiffness) = (0.0, f64::INFINITY);
        }
        let shift = |joint: usize| {
            let is_rigid = robot.joints[joint] == rigid.joints[joint];
            if is_rigid { Vec::new() } else { self.link_motion(joint, &sensed[joint], &rigid, robot) }
        };
        let shifts: Vec<_> = (0..robot.joints.len()).map(shift).collect();
        let needed = self.balance.needed_by(robot, &shifts);
        let motor: Vec<Vec<f64>> = motor;
        let balanced = self.balance.balanced_motors(robot, &needed, &motor);
        let lacking = if self.measured.has_torque {
            let late = |joint: usize| {
                if robot.joints[joint].actuator.sensor_delay == self.reference.joints[joint].actuator.sensor_delay {
                    return Vec::new();
                }
                let on_time = self.motor(&self.reference, joint, &sensed[joint]);
                motor[joint].iter().zip(on_time).map(|(now, before)| now - before).collect()
            };
            let late: Vec<Vec<f64>> = (0..robot.joints.len()).map(late).collect();
            self.balance.lacking_of(robot, &needed, &balanced, &late)
        } else {
            let first = if self.first_motors.is_empty() { &motor } else { &self.first_motors };
            self.balance.lacking_of_drives(robot, &needed, [&motor, first])
        };
        Predicted { sensed, motor, balanced, lacking, shifts }
    }

    /// Returns the torque at the sensor of a joint for smooth readings, by row [N·m].
    fn sensed(&self, rows: &JointRows, robot: &Robot) -> Vec<f64> {
        sensed_torque(&self.measured, rows, [&rows.smooth[0], &rows.smooth[1]], robot)
    }

    /// Returns the mean torque of a motor by sample, given that at its sensor by row.
    fn motor(&self, robot: &Robot, joint: usize, sensed: &[f64]) -> Vec<f64> {
        let at_motor = advanced(&self.measured, joint, robot, sensed);
        let or_zero = |value: f64| if value.is_finite() { value } else { 0.0 };
        self.balance.samples.iter().map(|sample| or_zero(sample.mean(&at_motor))).collect()
    }

    /// Returns the blocks with the residuals of a robot.
    pub fn residuals(&self, robot: &Robot, predicted: &Predicted) -> Vec<Block> {
        let mut blocks = self.blocks.clone();
        for (joint, parts) in self.drive_rows.iter().enumerate() {
            for (block, rows) in parts {
                let [measured, sensed] = [&self.measured.joints[joint].torque, &predicted.sensed[joint]];
                let residual = |row: &usize| measured[*row] - sensed[*row];
                blocks[*block].y = rows.iter().map(residual).collect();
            }
        }
        if let Some(base) = &self.measured.base {
            for (axis, (block, rows)) in self.gyro_rows.iter().enumerate() {
                let length = rows_of(GYRO_S, &self.measured);
                let mean = |row: &usize| {
                    base.gyro[*row..row + length].iter().map(|gyro| gyro[axis]).sum::<f64>() / length as f64
                };
                blocks[*block].y = rows.iter().map(|row| mean(row) - robot.gyro_bias[axis]).collect();
            }
        }
        self.balance.write_residuals(robot, &predicted.lacking, &predicted.shifts, &mut blocks);
        blocks
    }

    /// Returns what a law changes at a site: the column of `after` minus `before`.
    pub fn column(&self, law: &Law, site: Site, before: (&Robot, &Predicted), after: &Robot) -> Column {
        let (robot, predicted) = before;
        match (law.form.place, site) {
            (Place::Drive | Place::Supply, Site::Joint(joint)) => self.drive_column(joint, predicted, after),
            (Place::Supply, Site::Base) => {
                let mut column = Column::default();
                for joint in 0..robot.joints.len() {
                    column.add(&self.drive_column(joint, predicted, after));
                }
                column
            }
            (Place::Joint, Site::Joint(joint)) if self.measured.is_at_output => {
                self.drive_column(joint, predicted, after)
            }
            (Place::Joint, Site::Joint(joint)) => self.joint_column(joint, robot, after, predicted),
            (Place::Sensor, Site::Joint(joint)) => {
                let mut column = self.drive_column(joint, predicted, after);
                let moved = self.motor(after, joint, &predicted.sensed[joint]);
                let change = |(index, motor): (usize, &f64)| {
                    let sample = &self.balance.samples[index];
                    sample.link_torque(robot, joint, *motor)
                        - sample.link_torque(robot, joint, predicted.motor[joint][index])
                };
                let changes: Vec<f64> = moved.iter().enumerate().map(change).collect();
                column.add(&self.balance.joint_column(joint, &changes));
                column
            }
            (Place::Link, Site::Joint(joint)) => {
                self.balance.motion_column(joint, &self.link_motion(joint, &predicted.sensed[joint], robot, after))
            }
            (Place::Body, _) => self.balance.body_column(robot, after),
            (Place::Gyro, _) => self.gyro_column(robot, after),
            (Place::Slip | Place::Sink, _) => self.balance.ground_column(robot, after, &predicted.lacking),
            (_, Site::Base) => Column::default(),
        }
    }

    /// Returns the column of an offset of a joint's torque sensor, per N·m.
    pub fn torque_offset(&self, joint: usize) -> Column {
        if !self.measured.has_torque {
            return Column::default();
        }
        let mut parts: Vec<(usize, Vec<f64>)> =
            self.drive_rows[joint].iter().map(|(block, rows)| (*block, vec![1.0; rows.len()])).collect();
        // The motor has less torque than the sensor reads.
        let lacking = vec![-1.0; self.balance.samples.len()];
        parts.extend(self.balance.joint_column(joint, &lacking).parts);
        Column { parts }
    }

    fn drive_column(&self, joint: usize, predicted: &Predicted, after: &Robot) -> Column {
        let sensed = self.sensed(&self.measured.joints[joint], after);
        if !self.measured.has_torque {
            let change = |(index, motor): (usize, f64)| {
                let sample = &self.balance.samples[index];
                sample.link_torque(after, joint, motor)
                    - sample.link_torque(after, joint, predicted.motor[joint][index])
            };
            let changes: Vec<f64> = self.motor(after, joint, &sensed).into_iter().enumerate().map(change).collect();
            return self.balance.joint_column(joint, &changes);
        }
        let part = |(block, rows): &(usize, Vec<usize>)| {
            let change = |row: &usize| sensed[*row] - predicted.sensed[joint][*row];
            (*block, rows.iter().map(change).collect())
        };
        Column { parts: self.drive_rows[joint].iter().map(part).collect() }
    }

    fn joint_column(&self, joint: usize, before: &Robot, after: &Robot, predicted: &Predicted) -> Column {
        let change = |(sample, motors): (&Sample, &Vec<f64>)| {
            sample.link_torque(after, joint, motors[joint]) - sample.link_torque(before, joint, motors[joint])
        };
        let changes: Vec<f64> = self.balance.samples.iter().zip(&predicted.balanced).map(change).collect();
        self.balance.joint_column(joint, &changes)
    }

    /// Returns how the motion of a link changes: position, velocity and acceleration, by sample.
    ///
    /// The gear is twisted by the torque of the motor that turns neither the rotor nor its friction.
    fn link_motion(&self, joint: usize, predicted: &[f64], before: &Robot, after: &Robot) -> Vec<[f64; 3]> {
        let measured = &self.measured;
        let [q, dq] = &measured.joints[joint].smooth;
        let last = measured.t.len() - 1;
        let shift = |row: usize| {
            let ddq = (dq[(row + 1).min(last)] - dq[row.saturating_sub(1)]) / (2.0 * measured.dt);
            let lag = |robot: &Robot| {
                let actuator = &robot.joints[joint].actuator;
                // The torque of the row before acts until the row.
                let motor = 0.5 * (predicted[row.saturating_sub(1)] + predicted[row]);
                let torque = link_torque(&robot.joints[joint], motor, [q[row], dq[row], ddq]);
                let gap = 0.5 * actuator.backlash * (torque / SLACK).tanh();
                // The encoder is ahead of the link by the twist and by its offset.
                -torque / actuator.gear_stiffness - gap - actuator.encoder_offset
            };
            lag(after) - lag(before)
        };
        let shift: Vec<f64> = (0..=last).map(shift).collect();
        let or_zero = |motion: [f64; 3]| if motion.iter().all(|one| one.is_finite()) { motion } else { [0.0; 3] };
        self.balance.samples.iter().map(|sample| or_zero(sample.motion(measured, &shift))).collect()
    }

    fn gyro_column(&self, before: &Robot, after: &Robot) -> Column {
        let change = after.gyro_bias - before.gyro_bias;
        let part = |(axis, (block, rows)): (usize, &(usize, Vec<usize>))| (*block, vec![change[axis]; rows.len()]);
        let mut parts: Vec<(usize, Vec<f64>)> = self.gyro_rows.iter().enumerate().map(part).collect();
        parts.extend(self.balance.body_column(before, after).parts);
        parts.retain(|(_, rows)| rows.iter().any(|row| *row != 0.0));
        Column { parts }
    }
}

/// Returns a number that changes with all from which the columns of a place at a site are computed; `None` where they are few.
pub fn fingerprint(place: Place, site: Site, robot: &Robot, predicted: &Predicted) -> Option<u64> {
    let mut hash = DefaultHasher::new();
    match (place, site) {
        (Place::Body, _) => {
            let offsets: Vec<f64> = robot.joints.iter().map(|joint| joint.actuator.encoder_offset).collect();
            format!("{:?}", (&robot.tree, robot.gyro_bias, offsets)).hash(&mut hash);
        }
        (Place::Slip | Place::Sink | Place::Gyro, _) | (_, Site::Base) => return None,
        (_, Site::Joint(joint)) => {
            let models = (&robot.joints[joint], robot.thermal[joint], robot.voltage_exponent);
            format!("{models:?}").hash(&mut hash);
            let torques = predicted.sensed[joint].iter().chain(&predicted.motor[joint]);
            let torques = torques.chain(predicted.balanced.iter().map(|motors| &motors[joint]));
            torques.for_each(|torque| torque.to_bits().hash(&mut hash));
        }
    }
    Some(hash.finish())
}

/// Returns the mean square of the differences of neighbouring torques, which are noise rather than what a model lacks.
///
/// It shows whether the controller had the readings of the log: their noise then is in the measured torques, too.
fn roughness(torques: &[Vec<f64>]) -> f64 {
    let steps = torques.iter().flat_map(|rows| rows.windows(2).map(|pair| (pair[1] - pair[0]).powi(2)));
    let (sum, count) =
        steps.filter(|step| step.is_finite()).fold((0.0, 0.0), |(sum, count), step| (sum + step, count + 1.0));
    sum / f64::max(count, 1.0)
}

fn rows_of(time: f64, measured: &Measurements) -> usize {
    ((time / measured.dt).round() as usize).max(1)
}

fn drive_blocks(measured: &Measurements, robot: &Robot, blocks: &mut Vec<Block>) -> Vec<Vec<(usize, Vec<usize>)>> {
    if !measured.has_torque {
        return vec![Vec::new(); measured.joints.len()];
    }
    let skipped = rows_of(HISTORY_S, measured);
    let mut all = Vec::new();
    for rows in &measured.joints {
        let sensed = sensed_torque(measured, rows, [&rows.q, &rows.dq], robot);
        let mut parts = Vec::new();
        for regime in [Regime::Hang, Regime::Stand, Regime::Move] {
            let own = |row: &usize| {
                let is_known = !measured.is_at_output || rows.smooth[1][*row].abs() > LEAST_SPEED;
                measured.regime[*row] == regime && rows.torque[*row].is_finite() && sensed[*row].is_finite() && is_known
            };
            let inner = measured.ranges.iter().flat_map(|range| range.start + skipped..range.end.saturating_sub(2));
            let kept: Vec<usize> = inner.filter(own).collect();
            if kept.is_empty() {
                continue;
            }
            let name = format!("torque {} {regime:?}", robot.tree.joints[rows.joint].name).to_lowercase();
            let t = kept.iter().map(|row| measured.t[*row]).collect();
            blocks.push(Block { name, t, y: vec![0.0; kept.len()], sigma: measured.noise[2] });
            parts.push((blocks.len() - 1, kept));
        }
        all.push(parts);
    }
    all
}

fn gyro_blocks(measured: &Measurements, blocks: &mut Vec<Block>) -> Vec<(usize, Vec<usize>)> {
    let Some(base) = &measured.base else { return Vec::new() };
    let length = rows_of(GYRO_S, measured);
    let hanging = measured.ranges.iter().filter(|range| measured.regime[range.start] == Regime::Hang);
    let rows: Vec<usize> = hanging
        .flat_map(|range| (range.start..range.end.saturating_sub(length)).step_by(length))
        .filter(|row| base.gyro[*row..row + length].iter().flatten().all(|cell| cell.is_finite()))
        .collect();
    if rows.is_empty() {
        return Vec::new();
    }
    (0..3)
        .map(|axis| {
            let t = rows.iter().map(|row| measured.t[*row]).collect();
            let sigma = 0.02 / (length as f64).sqrt();
            blocks.push(Block { name: format!("gyro {axis}"), t, y: vec![0.0; rows.len()], sigma });
            (blocks.len() - 1, rows.clone())
        })
        .collect()
}
