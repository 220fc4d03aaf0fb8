//! Balance of forces: the torques of the motors against the equations of motion, on a base that is fixed or stands on its feet.
//!
//! A fixed base balances whatever it needs, so every joint has an equation of its own. On the ground the force on a foot is unknown: the
//! three joints of its limb give it, and the base must balance with the forces of all feet. Nothing is simulated, and contact needs no
//! model.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use twinstep_dynamics::Vec3;
use twinstep_dynamics::tree::{TreeAcceleration, TreeMotion, TreeParameters, TreeStructure, inverse_dynamics};
use twinstep_model::Foot;

use super::block::Block;
use super::measurements::{Measurements, Regime};
use super::robot::Robot;
use super::samples::{GRAVITY, Motion, Sample, samples, weights};
use super::touch::Touch;
use super::undetermined::Weighting;

/// Error of the height of a foot, by the orientation of the base and the shape of the foot [m].
const HEIGHT_ERROR: f64 = 5e-4;
/// Force on a foot per torque of its joints [1/m].
const FORCE_PER_TORQUE: f64 = 10.0;

/// Samples, and where their residuals are in the blocks.
pub struct Balance {
    /// The samples.
    pub samples: Vec<Sample>,
    /// Block and row of each residual of a sample.
    pub places: Vec<Vec<(usize, usize, usize)>>,
    /// Blocks of this balance: index and number of rows.
    pub sizes: Vec<usize>,
    pub first_block: usize,
    pub structure: TreeStructure,
    pub bodies: TreeParameters<f64>,
    pub joints: usize,
    /// Robot of the columns of motion.
    pub reference: Robot,
    /// Moment and force at the base, and torques of the joints, that the motion of the columns needs, by sample.
    pub needed: Vec<Vec<f64>>,
    /// True if the measured torques are those on the links.
    pub is_at_output: bool,
    /// The measured torques minus what the motion needs, for the reference, by sample.
    pub first_lacking: Vec<Vec<f64>>,
}

impl Balance {
    /// Collects the samples, and adds their blocks.
    pub fn new(measured: &Measurements, robot: &Robot, blocks: &mut Vec<Block>) -> Self {
        let mut samples = samples(measured, robot);
        let noise = base_noise(measured, &samples);
        samples.par_iter_mut().filter(|sample| sample.regime == Regime::Stand).for_each(|sample| {
            let at_rest = (0..robot.joints.len()).filter(|joint| !sample.is_free[*joint] && !sample.turns[*joint]);
            let at_rest: Vec<(usize, f64)> = at_rest.map(|joint| (joint, robot.scale[joint])).collect();
            sample.weighting = Some(Weighting::new(&sample.base_per_torque, &at_rest, noise));
        });
        let joints = robot.joints.len();
        let mut balance = Self {
            samples,
            places: Vec::new(),
            sizes: Vec::new(),
            first_block: blocks.len(),
            structure: TreeStructure::new(&robot.tree),
            bodies: TreeParameters::splat(&robot.tree),
            joints,
            reference: robot.clone(),
            needed: Vec::new(),
            is_at_output: measured.is_at_output,
            first_lacking: Vec::new(),
        };
        let needed = |sample: &Sample| balance.needed(&balance.bodies, robot, sample, &sample.instrument, [0.0; 3]);
        balance.needed = balance.samples.par_iter().map(needed).collect();
        balance.first_lacking = balance.lacking(measured);
        balance.add_blocks(measured, robot, blocks);
        balance
    }

    fn add_blocks(&mut self, measured: &Measurements, robot: &Robot, blocks: &mut Vec<Block>) {
        let mut series: Vec<Block> = Vec::new();
        for regime in [Regime::Hang, Regime::Move] {
            for joint in &robot.tree.joints {
                let name = format!("joint {} {}", joint.name, if regime == Regime::Hang { "hang" } else { "swing" });
                series.push(Block {
                    name,
                    t: Vec::new(),
                    y: Vec::new(),
                    sigma: noise(measured, &self.samples, regime),
                });
            }
        }
        let axes = ["mx", "my", "mz", "fx", "fy", "fz"];
        for (axis, sigma) in axes.into_iter().zip(base_noise(measured, &self.samples)) {
            series.push(Block { name: format!("base {axis} stand"), t: Vec::new(), y: Vec::new(), sigma });
        }
        series.extend(self.feet_blocks(measured, robot));
        let first = self.first_block;
        for sample in &self.samples {
            let residuals = self.residuals_of(sample);
            let place = |residual: usize| (residual, first + residual, series[residual].t.len());
            let places: Vec<_> = residuals.iter().map(|residual| place(*residual)).collect();
            for residual in residuals {
                series[residual].t.push(sample.t);
                series[residual].y.push(0.0);
            }
            self.places.push(places);
        }
        self.sizes = series.iter().map(|block| block.t.len()).collect();
        blocks.extend(series);
    }

    /// Returns the equations of a sample: those of free joints that turn, and of a base that stands.
    fn residuals_of(&self, sample: &Sample) -> Vec<usize> {
        let free = (0..self.joints).filter(|joint| sample.is_free[*joint] && sample.turns[*joint]);
        let of_bases = 2 * self.joints;
        let mut residuals: Vec<usize> = match sample.regime {
            Regime::Hang => free.collect(),
            Regime::Stand => (of_bases..of_bases + 6).collect(),
            // The base of a robot that moves fast lacks forces of its impacts, which are no noise.
            Regime::Move => free.map(|joint| self.joints + joint).collect(),
        };
        let (first, feet) = (of_bases + 6, self.reference.feet.len());
        for touch in &sample.touches {
            residuals.extend(touch.along.map(|_| first + touch.foot));
            residuals.extend(touch.height.map(|_| first + feet + touch.foot));
        }
        residuals
    }

    /// Returns the blocks of sliding and standing feet, without rows.
    fn feet_blocks(&self, measured: &Measurements, robot: &Robot) -> Vec<Block> {
        let rows = weights(4).iter().map(|weight| weight * weight).sum::<f64>();
        let of_base = measured.base.as_ref().map_or(0.0, |base| base.height_noise);
        let height = (of_base * of_base * rows + HEIGHT_ERROR * HEIGHT_ERROR).sqrt();
        let force = FORCE_PER_TORQUE * noise(measured, &self.samples, Regime::Move);
        let of_kind = |(kind, sigma): (&str, f64)| {
            let block =
                |foot: &Foot| Block { name: format!("{kind} {}", foot.name), t: Vec::new(), y: Vec::new(), sigma };
            robot.feet.iter().map(block).collect::<Vec<_>>()
        };
        [("slip", force), ("height", height)].into_iter().flat_map(of_kind).collect()
    }

    /// Returns what is lacking for the robot of the columns, by sample: the measured torques minus what the motion needs.
    fn lacking(&self, measured: &Measurements) -> Vec<Vec<f64>> {
        let robot = &self.reference;
        let lacking = |sample: &Sample| {
            let mut lacking = self.needed(&self.bodies, robot, sample, &sample.response, [0.0; 3]);
            for force in &mut lacking {
                *force = -*force;
            }
            for (joint, rows) in measured.joints.iter().enumerate() {
                let motor = sample.mean(&rows.torque);
                lacking[6 + joint] += if self.is_at_output {
                    motor
                } else {
                    sample.link_torque_at(robot, joint, motor, sample.response.ddq[joint])
                };
            }
            lacking
        };
        self.samples.par_iter().map(lacking).collect()
    }

    /// Returns moment and force at the base, and the torques of the joints, that the motion of the columns needs with a robot's bodies.
    ///
    /// `shifts` is how a link moves differently from its encoder, by joint and sample; empty for a stiff gear.
    pub fn needed_by(&self, robot: &Robot, shifts: &[Vec<[f64; 3]>]) -> Vec<Vec<f64>> {
        let offset =
            |robot: &Robot| robot.joints.iter().map(|joint| joint.actuator.encoder_offset).collect::<Vec<f64>>();
        let same = shifts.iter().all(Vec::is_empty)
            && robot.tree == self.reference.tree
            && offset(robot) == offset(&self.reference)
            && robot.gyro_bias == self.reference.gyro_bias;
        if same {
            return self.needed.clone();
        }
        let bodies = TreeParameters::splat(&robot.tree);
        let needed = |(index, sample): (usize, &Sample)| {
            let mut motion = sample.instrument.clone();
            for (joint, shift) in shifts.iter().enumerate().filter(|(_, shift)| !shift.is_empty()) {
                let [q, dq, ddq] = shift[index];
                motion.q[joint] += q;
                motion.dq[joint] += dq;
                motion.ddq[joint] += ddq;
            }
            self.needed(&bodies, robot, sample, &motion, [0.0; 3])
        };
        self.samples.par_iter().enumerate().map(needed).collect()
    }

    /// Returns the torques of the motors with which a robot is in balance, by sample and joint, close to those of its drives.
    ///
    /// Columns of the torques of motors are computed from them. Otherwise what the model lacks would be in the columns, too, and a robot
    /// with smaller motors and masses would lack less.
    pub fn balanced_motors(&self, robot: &Robot, needed: &[Vec<f64>], drives: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let balanced = |(index, sample): (usize, &Sample)| {
            let needed = &needed[index];
            let link = |joint: usize| {
                if sample.is_free[joint] {
                    needed[6 + joint]
                } else {
                    sample.link_torque(robot, joint, drives[joint][index])
                }
            };
            let mut links: Vec<f64> = (0..self.joints).map(link).collect();
            if sample.regime == Regime::Stand {
                let per = DMatrix::from_fn(6, self.joints, |axis, joint| sample.base_per_torque[joint][axis]);
                let lacking: Vec<f64> = needed
                    .iter()
                    .enumerate()
                    .map(|(row, force)| if row < 6 { -force } else { links[row - 6] - force })
                    .collect();
                let of_joints = DVector::from_row_slice(&lacking[6..]);
                let left = DVector::from_row_slice(&lacking[..6]) - &per * of_joints;
                // Two feet exert no moment about the line between them.
                let square = &per * per.transpose();
                let square = &square + DMatrix::identity(6, 6) * (1e-6 * square.trace() + 1e-12);
                if let Some(share) = square.cholesky() {
                    let change = per.transpose() * share.solve(&left);
                    links.iter_mut().zip(change.iter()).for_each(|(link, change)| *link += change);
                }
            }
            (0..self.joints).map(|joint| sample.motor_torque(robot, joint, links[joint])).collect()
        };
        self.samples.par_iter().enumerate().map(balanced).collect()
    }

    /// Returns what a robot lacks, by sample, given what its motion needs and the torques of its motors in balance.
    ///
    /// `delayed` is by how much the torque of a motor differs because its sensor is late, by joint and sample.
    pub fn lacking_of(
        &self,
        robot: &Robot,
        needed: &[Vec<f64>],
        motors: &[Vec<f64>],
        delayed: &[Vec<f64>],
    ) -> Vec<Vec<f64>> {
        self.lacking_with(needed, |index, sample, joint| {
            let motor = motors[index][joint];
            // What is between motor and link changes no torque on the link.
            let changed = if self.is_at_output {
                0.0
            } else {
                sample.link_torque(robot, joint, motor) - sample.link_torque(&self.reference, joint, motor)
            };
            changed + delayed[joint].get(index).copied().unwrap_or(0.0)
        })
    }

    /// Returns what a robot lacks whose torques were not measured, by sample, given what its motion needs, and the torques of the motors by
    /// its drives and by those of the reference, by joint and sample.
    pub fn lacking_of_drives(
        &self,
        robot: &Robot,
        needed: &[Vec<f64>],
        [now, before]: [&[Vec<f64>]; 2],
    ) -> Vec<Vec<f64>> {
        self.lacking_with(needed, |index, sample, joint| {
            sample.link_torque(robot, joint, now[joint][index])
                - sample.link_torque(&self.reference, joint, before[joint][index])
        })
    }

    /// Returns what is lacking with other needs and other torques on the links, by sample.
    fn lacking_with(
        &self,
        needed: &[Vec<f64>],
        change: impl Fn(usize, &Sample, usize) -> f64 + Send + Sync,
    ) -> Vec<Vec<f64>> {
        let lacking = |(index, sample): (usize, &Sample)| {
            let mut all = self.first_lacking[index].clone();
            for (force, (now, before)) in all.iter_mut().zip(needed[index].iter().zip(&self.needed[index])) {
                *force -= now - before;
            }
            for joint in 0..self.joints {
                all[6 + joint] += change(index, sample, joint);
            }
            all
        };
        self.samples.par_iter().enumerate().map(lacking).collect()
    }

    /// Writes the residuals of a robot, given what it lacks, and how links move differently from their encoders, by joint and sample.
    pub fn write_residuals(&self, robot: &Robot, lacking: &[Vec<f64>], shifts: &[Vec<[f64; 3]>], blocks: &mut [Block]) {
        for (index, sample) in self.samples.iter().enumerate() {
            for (residual, block, row) in &self.places[index] {
                blocks[*block].y[*row] = match self.of_foot(sample, *residual) {
                    None => self.projected(sample, &lacking[index], *residual),
                    Some((touch, false)) => touch.slip(robot.ground_friction, &lacking[index]),
                    Some((touch, true)) => {
                        let moved = |joint: usize| {
                            let shift = shifts[joint].get(index).map_or(0.0, |shift| shift[0]);
                            let offset = |robot: &Robot| robot.joints[joint].actuator.encoder_offset;
                            touch.lever(joint) * (shift - offset(robot) + offset(&self.reference))
                        };
                        let height = touch.height.map_or(0.0, |(height, _)| height);
                        let depth = touch.depth * robot.contact_time.powi(2) * touch.normal_force(&lacking[index]);
                        height + depth + (0..self.joints).map(moved).sum::<f64>()
                    }
                };
            }
        }
    }

    /// Returns the foot of a residual of a sample, and true for its height, false for its slip.
    pub fn of_foot<'a>(&self, sample: &'a Sample, residual: usize) -> Option<(&'a Touch, bool)> {
        let index = residual.checked_sub(2 * self.joints + 6)?;
        let feet = self.reference.feet.len();
        let touch = sample.touches.iter().find(|touch| touch.foot == index % feet)?;
        Some((touch, index >= feet))
    }

    /// Returns a residual of forces, given moment and force at the base and the torques of the joints.
    pub fn projected(&self, sample: &Sample, forces: &[f64], residual: usize) -> f64 {
        if residual < 2 * self.joints {
            return forces[6 + residual % self.joints];
        }
        if let Some((touch, is_height)) = self.of_foot(sample, residual) {
            return if is_height { 0.0 } else { touch.slip(self.reference.ground_friction, forces) };
        }
        let axis = residual - 2 * self.joints;
        sample.weighting.as_ref().map_or(0.0, |weighting| weighting.along(axis, forces, &forces[6..]))
    }

    /// Returns moment and force at the base, and the torque of each joint, that a motion needs.
    pub fn needed(
        &self,
        bodies: &TreeParameters<f64>,
        robot: &Robot,
        sample: &Sample,
        motion: &Motion,
        tilt: [f64; 3],
    ) -> Vec<f64> {
        let state = sample.state(robot, motion, tilt);
        let mut places = TreeMotion::empty(bodies);
        places.set(bodies, &state, GRAVITY);
        let acceleration = TreeAcceleration {
            angular: Vec3(motion.base.angular_acceleration),
            linear: Vec3(motion.base.linear_acceleration),
            ddq: motion.ddq.clone(),
        };
        let forces = inverse_dynamics(&self.structure, bodies, &places, &acceleration);
        [forces.moment.0.as_slice(), &forces.force.0, &forces.tau].concat()
    }
}

/// Returns a series as it was before the delay of the torque sensor of a joint.
pub fn advanced(measured: &Measurements, joint: usize, robot: &Robot, series: &[f64]) -> Vec<f64> {
    let delay = robot.joints[joint].actuator.sensor_delay / measured.dt;
    if delay == 0.0 {
        return series.to_vec();
    }
    let at = |row: usize| {
        let (whole, part) = (delay.floor() as usize, delay.fract());
        let last = series.len() - 1;
        (1.0 - part) * series[(row + whole).min(last)] + part * series[(row + whole + 1).min(last)]
    };
    (0..series.len()).map(at).collect()
}

/// Returns the noise of the balance of a joint in a regime [N·m].
fn noise(measured: &Measurements, samples: &[Sample], regime: Regime) -> f64 {
    let usual = weights(4);
    let rows = samples.iter().find(|sample| sample.regime == regime).map_or(&usual, |one| &*one.weights);
    // Torque, and a link's inertia times the acceleration: differences of the weights.
    let padded: Vec<f64> = std::iter::once(0.0).chain(rows.iter().copied()).chain([0.0]).collect();
    let steps = padded.windows(2).map(|pair| (pair[1] - pair[0]).powi(2)).sum::<f64>().sqrt() / measured.dt;
    let torque = measured.noise[2] * rows.iter().map(|weight| weight * weight).sum::<f64>().sqrt();
    let inertial = if regime == Regime::Hang { 0.03 } else { 0.05 };
    (torque * torque + (inertial * measured.noise[1] * steps).powi(2)).sqrt()
}

/// Returns the noise of moment [N·m] and force [N] in the balance of a base that stands.
fn base_noise(measured: &Measurements, samples: &[Sample]) -> [f64; 6] {
    [2.0, 2.0, 2.0, 10.0, 10.0, 10.0].map(|lever| lever * noise(measured, samples, Regime::Stand))
}
