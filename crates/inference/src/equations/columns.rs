//! Columns of the balance of forces: what an unknown changes in its residuals.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use twinstep_dynamics::tree::TreeParameters;
use twinstep_model::{RigidBody, RobotTree};

use super::balance::Balance;
use super::block::Column;
use super::measurements::Regime;
use super::robot::Robot;
use super::samples::Sample;
use super::touch::Touch;

impl Balance {
    /// Returns the column of a change of the torque on a joint's link, by sample [N·m].
    pub fn joint_column(&self, joint: usize, change: &[f64]) -> Column {
        self.column(|index, residual| {
            let sample = &self.samples[index];
            if let Some((touch, is_height)) = self.of_foot(sample, residual) {
                let mut forces = vec![0.0; 6 + self.joints];
                forces[6 + joint] = -change[index];
                return if is_height { 0.0 } else { touch.slip(self.reference.ground_friction, &forces) };
            }
            match residual.checked_sub(2 * self.joints) {
                None if residual % self.joints == joint => -change[index],
                None => 0.0,
                Some(axis) => {
                    let weighting = sample.weighting.as_ref();
                    weighting.map_or(0.0, |weighting| weighting.per_torque[joint][axis] * change[index])
                }
            }
        })
    }

    /// Returns the column of other bodies, or of another bias of the gyroscope.
    pub fn body_column(&self, before: &Robot, after: &Robot) -> Column {
        let [first, second] = [before, after].map(|robot| (TreeParameters::splat(&robot.tree), robot));
        let needed = |(bodies, robot): &(TreeParameters<f64>, &Robot), sample: &Sample| {
            self.needed(bodies, robot, sample, &sample.instrument, [0.0; 3])
        };
        self.needed_column(|_, sample| less(needed(&second, sample), &needed(&first, sample)))
    }

    /// Returns the column of additional inertia of one body.
    pub fn inertia_column(&self, tree: &RobotTree, robot: &Robot, body: usize, added: RigidBody) -> Column {
        let mut only = tree.clone();
        only.bodies.iter_mut().for_each(|body| {
            body.inertia = RigidBody { mass: 0.0, com: DVec3::ZERO, inertia: DMat3::ZERO };
        });
        only.bodies[body].inertia = added;
        let parameters = TreeParameters::splat(&only);
        self.needed_column(|_, sample| self.needed(&parameters, robot, sample, &sample.instrument, [0.0; 3]))
    }

    /// Returns the column of a motion of the links that differs from that of the encoders: position, velocity and acceleration of one
    /// joint, by sample.
    pub fn motion_column(&self, joint: usize, change: &[[f64; 3]]) -> Column {
        let mut column = self.needed_column(|index, sample| {
            let mut motion = sample.instrument.clone();
            let [q, dq, ddq] = change[index];
            motion.q[joint] += q;
            motion.dq[joint] += dq;
            motion.ddq[joint] += ddq;
            less(self.needed(&self.bodies, &self.reference, sample, &motion, [0.0; 3]), &self.needed[index])
        });
        // A link that is elsewhere has its foot elsewhere.
        column.add(&self.column(|index, residual| match self.of_foot(&self.samples[index], residual) {
            Some((touch, true)) => -touch.lever(joint) * change[index][0],
            _ => 0.0,
        }));
        column
    }

    /// Returns the column of another ground, for a robot that lacks these forces, by sample.
    pub fn ground_column(&self, before: &Robot, after: &Robot, lacking: &[Vec<f64>]) -> Column {
        let friction = after.ground_friction - before.ground_friction;
        let time_square = after.contact_time.powi(2) - before.contact_time.powi(2);
        self.column(|index, residual| match self.of_foot(&self.samples[index], residual) {
            None => 0.0,
            Some((touch, false)) => -friction * touch.normal_force(&lacking[index]),
            Some((touch, true)) => -time_square * touch.depth * touch.normal_force(&lacking[index]),
        })
    }

    /// Returns the column of a change of the heights of feet, given their foot on the ground.
    pub fn height_column(&self, change: impl Fn(&Touch) -> f64) -> Column {
        self.column(|index, residual| match self.of_foot(&self.samples[index], residual) {
            Some((touch, true)) => change(touch),
            _ => 0.0,
        })
    }

    /// Returns the column of the time by which the positions of a joint's encoder are ahead of its velocities [s].
    pub fn lead_column(&self, joint: usize) -> Column {
        let accelerations: Vec<f64> = self.samples.iter().map(|sample| sample.instrument.ddq[joint]).collect();
        let change = |index: usize| [0.0, accelerations[index], self.slope(&accelerations, index)];
        self.motion_column(joint, &(0..accelerations.len()).map(change).collect::<Vec<_>>())
    }

    /// Returns the derivative of a series by sample; zero at the ends of a contiguous range.
    pub fn slope(&self, series: &[f64], index: usize) -> f64 {
        self.step_around(index).map_or(0.0, |step| (series[index + 1] - series[index - 1]) / (2.0 * step))
    }

    /// Returns the time to the samples before and after one [s]; `None` if one of them is missing.
    fn step_around(&self, index: usize) -> Option<f64> {
        let [earlier, now, later] = [index.checked_sub(1)?, index, index + 1].map(|index| self.samples.get(index));
        let (earlier, now, later) = (earlier?, now?, later?);
        let contiguous = earlier.rows.contains(&now.rows.start) && now.rows.contains(&later.rows.start);
        contiguous.then_some(0.5 * (later.t - earlier.t))
    }

    /// Returns the column of an acceleration of a base that stands, along an axis of the base [m/s²].
    pub fn acceleration_column(&self, axis: usize) -> Column {
        self.needed_column(|index, sample| {
            if sample.regime == Regime::Hang {
                return vec![0.0; 6 + self.joints];
            }
            let mut motion = sample.instrument.clone();
            motion.base.linear_acceleration[axis] += 1.0;
            less(self.needed(&self.bodies, &self.reference, sample, &motion, [0.0; 3]), &self.needed[index])
        })
    }

    /// Returns the column of the position of the accelerometer along an axis of a base that is not fixed [m].
    pub fn lever_column(&self, axis: usize) -> Column {
        let mut lever = DVec3::ZERO;
        lever[axis] = 1.0;
        self.needed_column(|index, sample| {
            if sample.regime == Regime::Hang {
                return vec![0.0; 6 + self.joints];
            }
            let mut motion = sample.instrument.clone();
            let [turning, speeding] =
                [motion.base.angular_velocity, motion.base.angular_acceleration].map(DVec3::from_array);
            let felt = speeding.cross(lever) + turning.cross(turning.cross(lever));
            motion.base.linear_acceleration = (DVec3::from_array(motion.base.linear_acceleration) - felt).to_array();
            less(self.needed(&self.bodies, &self.reference, sample, &motion, [0.0; 3]), &self.needed[index])
        })
    }

    /// Returns the column of a rotation of gravity about an axis of the base [rad], where the base is fixed.
    pub fn tilt_column(&self, axis: usize) -> Column {
        let mut tilt = [0.0; 3];
        tilt[axis] = 1e-3;
        self.needed_column(|index, sample| {
            if sample.regime != Regime::Hang {
                return vec![0.0; 6 + self.joints];
            }
            let turned = self.needed(&self.bodies, &self.reference, sample, &sample.instrument, tilt);
            less(turned, &self.needed[index]).into_iter().map(|change| change / 1e-3).collect()
        })
    }

    fn needed_column(&self, change: impl Fn(usize, &Sample) -> Vec<f64> + Send + Sync) -> Column {
        let changes: Vec<Vec<f64>> =
            self.samples.par_iter().enumerate().map(|(index, sample)| change(index, sample)).collect();
        // The residual has the needed forces with a negative sign, so that the column has a positive one.
        self.column(|index, residual| self.projected(&self.samples[index], &changes[index], residual))
    }

    fn column(&self, value: impl Fn(usize, usize) -> f64) -> Column {
        let mut parts: Vec<(usize, Vec<f64>)> =
            self.sizes.iter().enumerate().map(|(index, size)| (self.first_block + index, vec![0.0; *size])).collect();
        for (index, places) in self.places.iter().enumerate() {
            for (residual, block, row) in places {
                parts[block - self.first_block].1[*row] = value(index, *residual);
            }
        }
        parts.retain(|(_, rows)| rows.iter().any(|row| *row != 0.0));
        Column { parts }
    }
}

fn less(mut forces: Vec<f64>, others: &[f64]) -> Vec<f64> {
    forces.iter_mut().zip(others).for_each(|(force, other)| *force -= other);
    forces
}
