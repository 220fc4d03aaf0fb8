//! Equations of a log without motor currents whose base is fixed: measured minus simulated positions.
//!
//! Nothing measured is differentiated: the robot is simulated in short windows, and what a change of the robot changes of the torques
//! along that motion moves the joints by their linear [`Response`].

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use twinstep_dynamics::tree::{TreeParameters, TreeStructure};
use twinstep_logs::Log;
use twinstep_model::{ActuatorParams, CONTACT, RigidBody, TreeModel};

use super::block::{Block, Column};
use super::columns::only;
use super::drive::{link_lead, link_torque, sensed_torque};
use super::hanging::{GridStates, limbs};
use super::law::{Law, Place};
use super::measurements::{JointRows, Measurements, Regime};
use super::nuisance::{STICK, TILT};
use super::residuals::{Residuals, State};
use super::response::{LimbMatrices, Response};
use super::robot::Robot;
use super::site::Site;
use super::unknown;
use crate::simulate::{GridMotion, simulate_on_grid};
use crate::{Candidate, JointLog, Window, WindowLength, windows};

/// Time between points of the grid, if the drives are fast [s].
const GRID_S: f64 = 0.002;
/// Least time between compared rows [s].
const ROW_S: f64 = 0.008;
/// Least standard deviation of a position [rad]: two physics engines differ by 1 mrad on the same commands.
const POSITION: f64 = 2e-3;
/// Standard deviations of delays that all joints share [s]: of the commands, by the log's clock, and of the torques, by the rate of the
/// drives; and a short one, from which their columns are computed.
const CLOCK: f64 = 1e-3;
const DRIVES: f64 = 1e-3;
const SHORT: f64 = 5e-4;
/// Standard deviation of the time by which positions of all encoders are ahead of their velocities [s]: a step of a simulator.
const LEAD: f64 = 1e-3;
/// Residual where a simulation has no finite position [rad].
const DIVERGED: f64 = 10.0;
/// Change of a position that only an unstable response has [rad].
const UNSTABLE: f64 = 1e4;
/// Step of a derivative with respect to position [rad] and velocity [rad/s].
const STEP: f64 = 1e-3;

/// A measured position on the grid.
struct Row {
    /// Point before it, and its distance from there, in steps of the grid.
    point: usize,
    share: f64,
    /// Measured position [rad].
    q: f64,
}

impl Row {
    /// Returns a series of points at this row.
    fn of(&self, points: &[f64]) -> f64 {
        (1.0 - self.share) * points[self.point] + self.share * points[self.point + 1]
    }
}

/// Measured minus simulated positions of the joints of a log.
pub struct MotionResiduals {
    log: JointLog,
    windows: Vec<Window>,
    /// Commands on the grid.
    grid: Measurements,
    blocks: Vec<Block>,
    /// Compared rows, by joint.
    rows: Vec<Vec<Row>>,
    limbs: Vec<Vec<usize>>,
    clock: Clock,
}

/// Clock of the drives.
#[derive(Clone, Copy)]
struct Clock {
    /// Rate at which they update their torques [Hz].
    actuator_hz: f64,
    /// Their periods from point to point of the grid.
    stride: usize,
}

impl Clock {
    fn new(actuator_hz: f64) -> Self {
        Self { actuator_hz, stride: ((GRID_S * actuator_hz).round() as usize).max(1) }
    }

    /// Returns the time between points of the grid [s].
    fn step(self) -> f64 {
        self.stride as f64 / self.actuator_hz
    }
}

/// Simulation of a robot.
pub struct Simulated {
    /// Commands and simulated readings on the grid.
    readings: Measurements,
    /// Motion of the links between a point and the next.
    states: GridStates,
    /// What the readings are ahead of the links, by joint [rad].
    offsets: Vec<f64>,
    /// Torques of the motors, by joint and point [N·m].
    motor: Vec<Vec<f64>>,
    response: Response,
}

impl Simulated {
    /// Returns the torque on the link of a joint between a point and the next [N·m].
    fn link_torque(&self, robot: &Robot, joint: usize, point: usize, motor: f64) -> f64 {
        let model = &robot.joints[joint];
        let [q, dq, ddq] = [0, 1, 2].map(|order| self.states.motion[order][joint][point]);
        link_torque(model, motor, [q + self.offsets[joint], dq, ddq])
    }
}

impl MotionResiduals {
    /// Prepares the windows of the rows that are used. Returns `None` if none has a fixed base, a gain is unknown, or a joint of the robot
    /// is missing.
    pub fn new(log: &Log, robot: &Robot, is_used: impl Fn(usize) -> bool, actuator_hz: f64) -> Option<Self> {
        let clock = Clock::new(actuator_hz);
        let joints = JointLog::new(log, &robot.tree, is_used).ok()?;
        if joints.joints.len() != robot.joints.len() || joints.has_unknown_gains() {
            return None;
        }
        let windows = windows(&joints, &robot.tree, WindowLength::IDENTIFICATION);
        let motions = simulated(&joints, &windows, robot, clock)?;
        let noise = log.joints().first().and_then(|name| log.noise(&format!("q_{name}"))).unwrap_or(0.0);
        let grid = grid(&joints, &windows, &motions, clock.step());
        let rows: Vec<Vec<Row>> = (0..joints.joints.len()).map(|joint| rows(&joints, joint, &windows, &grid)).collect();
        let block = |(joint, rows): (usize, &Vec<Row>)| {
            let t = rows.iter().map(|row| grid.t[row.point] + row.share * grid.dt).collect();
            let name = format!("position {} hang", robot.tree.joints[joint].name);
            Block { name, t, y: vec![0.0; rows.len()], sigma: noise.max(POSITION) }
        };
        let blocks = rows.iter().enumerate().map(block).collect();
        let limbs = limbs(&TreeStructure::new(&robot.tree));
        Some(Self { log: joints, windows, grid, blocks, rows, limbs, clock })
    }

    /// Returns the drive's torque of a joint on a motion, by point [N·m].
    fn motor(&self, readings: &Measurements, joint: usize, robot: &Robot, [q, dq]: [&[f64]; 2]) -> Vec<f64> {
        let mut robot = robot.clone();
        robot.joints[joint].actuator.sensor_delay = 0.0;
        sensed_torque(readings, &readings.joints[joint], [q, dq], &robot)
    }

    /// Returns the derivatives of a drive's torque with respect to velocity and position, by point.
    fn drive_slopes(&self, robot: &Robot, readings: &Measurements, motor: &[f64], joint: usize) -> [Vec<f64>; 2] {
        let rows = &readings.joints[joint];
        [[0.0, STEP], [STEP, 0.0]].map(|[of_q, of_dq]| {
            let q: Vec<f64> = rows.q.iter().map(|q| q + of_q).collect();
            let dq: Vec<f64> = rows.dq.iter().map(|dq| dq + of_dq).collect();
            let moved = self.motor(readings, joint, robot, [&q, &dq]);
            let gain = robot.joints[joint].actuator.gain;
            moved.iter().zip(motor).map(|(moved, before)| or_zero(gain * (moved - before) / STEP)).collect()
        })
    }

    /// Returns the linear response around a motion.
    fn response(&self, robot: &Robot, readings: &Measurements, states: &GridStates, motor: &[Vec<f64>]) -> Response {
        let slopes: Vec<[Vec<f64>; 2]> = (0..motor.len())
            .into_par_iter()
            .map(|joint| self.drive_slopes(robot, readings, &motor[joint], joint))
            .collect();
        let link_slope = |joint: usize, point: usize, of: [f64; 2]| {
            let [q, dq] = [0, 1].map(|order| states.motion[order][joint][point]);
            let model = &robot.joints[joint];
            let offset = model.actuator.encoder_offset;
            let [before, after] = [0.0, STEP].map(|step| {
                link_torque(model, motor[joint][point], [q + offset + step * of[1], dq + step * of[0], 0.0])
            });
            or_zero((after - before) / STEP)
        };
        let knots = states.matrices(robot, &self.limbs);
        let at = |limb: usize, point: usize| {
            let joints = &self.limbs[limb];
            let [mass, stiffness] = knots.at(point);
            let of = |matrix: &DMatrix<f64>| {
                DMatrix::from_fn(joints.len(), joints.len(), |row, column| matrix[(joints[row], joints[column])])
            };
            let diagonal = |entry: &dyn Fn(usize) -> f64| {
                DMatrix::from_diagonal(&DVector::from_iterator(joints.len(), joints.iter().map(|joint| entry(*joint))))
            };
            LimbMatrices {
                mass: of(mass),
                links: [
                    diagonal(&|joint| -link_slope(joint, point, [1.0, 0.0])),
                    of(stiffness) + diagonal(&|joint| -link_slope(joint, point, [0.0, 1.0])),
                ],
                drives: [0, 1].map(|which: usize| diagonal(&|joint| -slopes[joint][which][point])),
            }
        };
        let Clock { actuator_hz, stride } = self.clock;
        Response::new(self.limbs.clone(), self.grid.ranges.clone(), (stride, 1.0 / actuator_hz), at)
    }

    /// Returns the column of additional torques on the links: joints with their torques by point [N·m].
    fn torque_column(&self, simulated: &Simulated, torques: &[(usize, Vec<f64>)]) -> Column {
        let mut parts = Vec::new();
        for (limb, joints) in self.limbs.iter().enumerate() {
            let of = |joint: &usize| {
                torques.iter().find(|(other, _)| other == joint).map_or(&[][..], |(_, cells)| cells.as_slice())
            };
            let own: Vec<&[f64]> = joints.iter().map(of).collect();
            if own.iter().all(|cells| cells.iter().all(|cell| *cell == 0.0)) {
                continue;
            }
            for (joint, positions) in joints.iter().zip(simulated.response.positions(limb, &own)) {
                let is_possible = positions.iter().all(|position| position.abs() < UNSTABLE);
                let at = |row: &Row| if is_possible { row.of(&positions) } else { 0.0 };
                parts.push((*joint, self.rows[*joint].iter().map(at).collect()));
            }
        }
        Column { parts }
    }

    /// Returns the column of torques that bodies need at a point, by joint [N·m].
    fn needed_column(&self, simulated: &Simulated, at: impl Fn(usize) -> Vec<f64> + Sync) -> Column {
        let mut lacking = simulated.states.everywhere(at);
        lacking.iter_mut().flatten().for_each(|torque| *torque = -*torque);
        self.torque_column(simulated, &lacking.into_iter().enumerate().collect::<Vec<_>>())
    }

    /// Returns the column of a link's motion that differs from that of its encoder.
    fn link_column(&self, joint: usize, (robot, simulated): (&Robot, &Simulated), after: &Robot) -> Column {
        let shift_at = |point: usize| {
            let motor = simulated.motor[joint][point];
            let lead =
                |robot: &Robot| link_lead(&robot.joints[joint], simulated.link_torque(robot, joint, point, motor));
            lead(after) - lead(robot)
        };
        let shift: Vec<f64> = (0..self.grid.t.len()).map(shift_at).collect();
        let limb = self.limbs.iter().position(|joints| joints.contains(&joint)).expect("a limb of each joint");
        let place = self.limbs[limb].iter().position(|one| *one == joint).expect("a joint of its limb");
        let accelerations = self.derivative(&self.derivative(&shift));
        let mut torques = simulated.response.inertial(limb, place, &accelerations);
        let bodies = TreeParameters::splat(&robot.tree);
        let moved = simulated.states.everywhere(|point| {
            let of = |other: usize| if other == joint { shift[point] } else { 0.0 };
            let [now, before] = [
                simulated.states.needed(&bodies, point, of, [0.0; 3]),
                simulated.states.needed(&bodies, point, |_| 0.0, [0.0; 3]),
            ];
            now.iter().zip(&before).map(|(now, before)| now - before).collect()
        });
        for (joint, cells) in &mut torques {
            cells.iter_mut().zip(&moved[*joint]).for_each(|(torque, moved)| *torque = -(*torque + moved));
        }
        self.torque_column(simulated, &torques)
    }

    /// Returns the column of a delay that all joints share, per second.
    fn late_column(
        &self,
        robot: &Robot,
        simulated: &Simulated,
        delay: impl Fn(&mut ActuatorParams) -> &mut f64,
    ) -> Column {
        let mut late = robot.clone();
        late.joints.iter_mut().for_each(|joint| *delay(&mut joint.actuator) += SHORT);
        let of_joint = |rows: &JointRows| {
            let motor = self.motor(&simulated.readings, rows.joint, &late, [&rows.q, &rows.dq]);
            let gain = robot.joints[rows.joint].actuator.gain;
            let changes =
                motor.iter().zip(&simulated.motor[rows.joint]).map(|(now, before)| gain * (now - before) / SHORT);
            (rows.joint, changes.map(or_zero).collect())
        };
        let torques: Vec<(usize, Vec<f64>)> = simulated.readings.joints.par_iter().map(of_joint).collect();
        self.torque_column(simulated, &torques)
    }

    /// Returns the column of the time by which positions of all encoders are ahead of their velocities, per second.
    fn lead_column(&self, robot: &Robot, simulated: &Simulated) -> Column {
        let of_joint = |rows: &JointRows| {
            let ahead: Vec<f64> = rows.q.iter().zip(&rows.dq).map(|(q, dq)| q + SHORT * dq).collect();
            let motor = self.motor(&simulated.readings, rows.joint, robot, [&ahead, &rows.dq]);
            let gain = robot.joints[rows.joint].actuator.gain;
            let changes =
                motor.iter().zip(&simulated.motor[rows.joint]).map(|(now, before)| gain * (now - before) / SHORT);
            (rows.joint, changes.map(or_zero).collect())
        };
        let torques: Vec<(usize, Vec<f64>)> = simulated.readings.joints.par_iter().map(of_joint).collect();
        let mut column = self.torque_column(simulated, &torques);
        let readings = simulated
            .readings
            .joints
            .iter()
            .map(|rows| (rows.joint, self.rows[rows.joint].iter().map(|row| or_zero(row.of(&rows.dq))).collect()));
        column.add(&Column { parts: readings.collect() });
        column
    }

    /// Returns a function of a point and the next, by point; of the last point of a range, as of the one before.
    fn of_steps(&self, series: &[f64], of: impl Fn(f64, f64) -> f64) -> Vec<f64> {
        let step = |range: &Range<usize>, point: usize| {
            let point = point.min(range.end.saturating_sub(2)).max(range.start);
            of(series[point], series[(point + 1).min(range.end - 1)])
        };
        let of_range = |range: &Range<usize>| range.clone().map(|point| step(range, point)).collect::<Vec<f64>>();
        self.grid.ranges.iter().flat_map(of_range).collect()
    }

    /// Returns the derivative of a series of points.
    fn derivative(&self, series: &[f64]) -> Vec<f64> {
        let slope = |range: &Range<usize>, point: usize| {
            let (before, after) = (point.saturating_sub(1).max(range.start), (point + 1).min(range.end - 1));
            (series[after] - series[before]) / ((after - before).max(1) as f64 * self.grid.dt)
        };
        self.grid.ranges.iter().flat_map(|range| range.clone().map(move |point| slope(range, point))).collect()
    }
}

impl Residuals for MotionResiduals {
    type Predicted = Simulated;

    fn is_linear(&self) -> bool {
        false
    }

    fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    fn predicted(&self, robot: &Robot) -> Simulated {
        let mut readings = self.grid.clone();
        let motions = simulated(&self.log, &self.windows, robot, self.clock).unwrap_or_default();
        for rows in &mut readings.joints {
            rows.q = motions.iter().flat_map(|motion| motion.q[rows.joint].iter().copied()).collect();
            rows.dq = motions.iter().flat_map(|motion| motion.dq[rows.joint].iter().copied()).collect();
            rows.q.resize(readings.t.len(), f64::NAN);
            rows.dq.resize(readings.t.len(), f64::NAN);
        }
        let joints = &readings.joints;
        let offsets: Vec<f64> = robot.joints.iter().map(|joint| joint.actuator.encoder_offset).collect();
        let middle = |cells: &[f64], offset: f64| self.of_steps(cells, |now, next| 0.5 * (now + next) - offset);
        let q = joints.iter().zip(&offsets).map(|(rows, offset)| middle(&rows.q, *offset)).collect();
        let dq = joints.iter().map(|rows| middle(&rows.dq, 0.0)).collect();
        let ddq = joints.iter().map(|rows| self.of_steps(&rows.dq, |now, next| (next - now) / self.grid.dt)).collect();
        let orientations = self.windows.iter().map(|window| window.start.base_orientation);
        let ranges = self.grid.ranges.iter().cloned().zip(orientations).collect();
        let states = GridStates { motion: [q, dq, ddq], ranges };
        let motor = |rows: &JointRows| self.motor(&readings, rows.joint, robot, [&rows.q, &rows.dq]);
        let motor: Vec<Vec<f64>> = joints.par_iter().map(motor).collect();
        let response = self.response(robot, &readings, &states, &motor);
        Simulated { readings, states, offsets, motor, response }
    }

    fn residuals(&self, _: &Robot, simulated: &Simulated) -> Vec<Block> {
        let mut blocks = self.blocks.clone();
        for (joint, block) in blocks.iter_mut().enumerate() {
            let points = &simulated.readings.joints[joint].q;
            let residual = |row: &Row| row.q - row.of(points);
            let clamped =
                |residual: f64| if residual.is_finite() { residual.clamp(-DIVERGED, DIVERGED) } else { DIVERGED };
            block.y = self.rows[joint].iter().map(|row| clamped(residual(row))).collect();
        }
        blocks
    }

    fn column(&self, law: &Law, site: Site, before: (&Robot, &Simulated), after: &Robot) -> Column {
        let (robot, simulated) = before;
        match (law.place, site) {
            (Place::Drive | Place::Joint, Site::Joint(joint)) if after.thermal == robot.thermal => {
                let rows = &simulated.readings.joints[joint];
                let motor = match law.place {
                    Place::Drive => self.motor(&simulated.readings, joint, after, [&rows.q, &rows.dq]),
                    _ => simulated.motor[joint].clone(),
                };
                let change = |(point, motor): (usize, &f64)| {
                    simulated.link_torque(after, joint, point, *motor)
                        - simulated.link_torque(robot, joint, point, simulated.motor[joint][point])
                };
                self.torque_column(simulated, &[(joint, motor.iter().enumerate().map(change).collect())])
            }
            (Place::Link, Site::Joint(joint)) => self.link_column(joint, before, after),
            (Place::Body, _) => {
                let [first, second] = [robot, after].map(|robot| TreeParameters::splat(&robot.tree));
                self.needed_column(simulated, |point| {
                    let [now, before] =
                        [&second, &first].map(|bodies| simulated.states.needed(bodies, point, |_| 0.0, [0.0; 3]));
                    now.iter().zip(&before).map(|(now, before)| now - before).collect()
                })
            }
            // The simulation has no supply and no heat, and no sensor but encoders.
            _ => Column::default(),
        }
    }

    fn inertia_column(&self, robot: &Robot, simulated: &Simulated, body: usize, added: RigidBody) -> Column {
        let bodies = TreeParameters::splat(&only(&robot.tree, body, added));
        self.needed_column(simulated, |point| simulated.states.needed(&bodies, point, |_| 0.0, [0.0; 3]))
    }

    fn small_at_joint(&self, simulated: &Simulated, joint: usize) -> Vec<(Column, f64)> {
        let ones = vec![1.0; self.grid.t.len()];
        vec![(self.torque_column(simulated, &[(joint, ones)]), STICK)]
    }

    fn small_of_motion(&self, robot: &Robot, simulated: &Simulated) -> Vec<(Column, f64)> {
        let bodies = TreeParameters::splat(&robot.tree);
        let column = |axis: usize| {
            let mut tilt = [0.0; 3];
            tilt[axis] = STEP;
            self.needed_column(simulated, |point| {
                let [now, before] = [tilt, [0.0; 3]].map(|tilt| simulated.states.needed(&bodies, point, |_| 0.0, tilt));
                now.iter().zip(&before).map(|(now, before)| (now - before) / STEP).collect()
            })
        };
        let tilts = [0, 1].map(|axis| (column(axis), TILT));
        let late = [
            (self.late_column(robot, simulated, |actuator| &mut actuator.command_delay), CLOCK),
            (self.late_column(robot, simulated, |actuator| &mut actuator.torque_delay), DRIVES),
        ];
        tilts.into_iter().chain(late).chain([(self.lead_column(robot, simulated), LEAD)]).collect()
    }

    fn state(&self, simulated: &Simulated, joint: usize, t: f64) -> State {
        let point = self.grid.t.partition_point(|time| *time < t).min(self.grid.t.len() - 1);
        let rows = &simulated.readings.joints[joint];
        State { q: rows.q[point], dq: rows.dq[point], torque: simulated.motor[joint][point] }
    }

    fn places(&self) -> &[Place] {
        &[Place::Joint]
    }

    fn functions(&self, simulated: &Simulated, joint: usize, _: Place) -> Vec<(&'static str, Column)> {
        let rows = &simulated.readings.joints[joint];
        let of_point = |point: usize| {
            let temperature = rows.temperature.get(point).copied().unwrap_or(0.0);
            let error = rows.command[0][point] - rows.q[point];
            [rows.q[point], rows.dq[point], error, simulated.motor[joint][point], temperature, self.grid.t[point]]
        };
        let raw: Vec<[f64; 6]> = (0..self.grid.t.len()).map(of_point).collect();
        let column = |values: Vec<f64>| self.torque_column(simulated, &[(joint, values)]);
        unknown::functions(&raw).into_iter().map(|(variable, values)| (variable, column(values))).collect()
    }
}

fn or_zero(value: f64) -> f64 {
    if value.is_finite() { value } else { 0.0 }
}

/// Simulates a robot in the windows. Returns `None` if it cannot be simulated.
fn simulated(log: &JointLog, windows: &[Window], robot: &Robot, clock: Clock) -> Option<Vec<GridMotion>> {
    let zeros = vec![0.0; robot.joints.len()];
    let model =
        TreeModel { tree: robot.tree.clone(), joints: robot.joints.clone(), points: Vec::new(), contact: CONTACT };
    let candidate = Candidate { robot: model, kp: zeros.clone(), kd: zeros };
    simulate_on_grid(log, windows, &candidate, clock.actuator_hz, clock.stride).ok()
}

/// Returns the commands on the grid.
fn grid(log: &JointLog, windows: &[Window], motions: &[GridMotion], dt: f64) -> Measurements {
    let (mut t, mut ranges, mut rows) = (Vec::new(), Vec::new(), Vec::new());
    for (window, motion) in windows.iter().zip(motions) {
        let start = t.len();
        t.extend((0..motion.row.len()).map(|point| log.t[window.rows.start] + dt * point as f64));
        rows.extend(motion.row.iter().map(|row| window.rows.start + row));
        ranges.push(start..t.len());
    }
    let on_grid = |cells: &[f64]| rows.iter().map(|row| cells[*row]).collect::<Vec<f64>>();
    let gain = |cells: &Option<Vec<f64>>| cells.as_deref().map(on_grid).unwrap_or_default();
    let joint = |channels: &crate::joint_log::JointChannels| JointRows {
        joint: channels.joint,
        q: Vec::new(),
        dq: Vec::new(),
        smooth: [Vec::new(), Vec::new()],
        torque: Vec::new(),
        command: [&channels.q_cmd, &channels.dq_cmd, &channels.tau_ff].map(|cells| on_grid(cells)),
        gains: [gain(&channels.kp), gain(&channels.kd)],
        temperature: Vec::new(),
    };
    Measurements {
        dt,
        ranges,
        regime: vec![Regime::Hang; t.len()],
        joints: log.joints.iter().map(joint).collect(),
        base: None,
        contact: Vec::new(),
        voltage_share: Vec::new(),
        noise: [0.0; 3],
        t,
    }
}

/// Returns the rows of a joint that are compared.
fn rows(log: &JointLog, joint: usize, windows: &[Window], grid: &Measurements) -> Vec<Row> {
    let mut rows = Vec::new();
    let mut last = f64::NEG_INFINITY;
    for (window, range) in windows.iter().zip(&grid.ranges) {
        for row in window.first_compared..window.rows.end {
            let (now, q) = (log.t[row], log.joints[joint].q[row]);
            let place = (now - log.t[window.rows.start]) / grid.dt;
            if q.is_finite() && now - last > ROW_S - 1e-6 && place + 1.0 < range.len() as f64 {
                rows.push(Row { point: range.start + place as usize, share: place.fract(), q });
                last = now;
            }
        }
    }
    rows
}
