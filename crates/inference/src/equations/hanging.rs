//! The bodies of a robot with a fixed base along a motion on a grid: the torques that they need, and the matrices of its limbs.

use std::ops::Range;

use glam::{DQuat, DVec3};
use nalgebra::DMatrix;
use rayon::prelude::*;
use twinstep_dynamics::Vec3;
use twinstep_dynamics::tree::{
    TreeAcceleration, TreeMotion, TreeParameters, TreeState, TreeStructure, inverse_dynamics, mass_matrix,
};

use super::robot::Robot;
use super::samples::GRAVITY;

/// Points from which bodies are computed; between them, their torques are linear.
const BODY_POINTS: usize = 5;
/// Step of a derivative with respect to position [rad].
const STEP: f64 = 1e-3;

/// Motion on a grid, by joint and point.
pub struct GridStates {
    /// Positions [rad], velocities [rad/s] and accelerations [rad/s²] of the links.
    pub motion: [Vec<Vec<f64>>; 3],
    /// Ranges of points, with the orientation of the base in each, `[w, x, y, z]`.
    pub ranges: Vec<(Range<usize>, [f64; 4])>,
}

impl GridStates {
    fn points(&self) -> usize {
        self.ranges.last().map_or(0, |(range, _)| range.end)
    }

    fn places(&self, bodies: &TreeParameters<f64>, q: Vec<f64>, point: usize, tilt: [f64; 3]) -> TreeMotion<f64> {
        let range = self.ranges.iter().find(|(range, _)| range.contains(&point));
        let [w, x, y, z] = range.map_or([1.0, 0.0, 0.0, 0.0], |(_, orientation)| *orientation);
        let turn = DQuat::from_xyzw(x, y, z, w) * DQuat::from_scaled_axis(DVec3::from_array(tilt));
        let dq = self.motion[1].iter().map(|cells| cells[point]).collect();
        let orientation = [turn.w, turn.x, turn.y, turn.z];
        let mut places = TreeMotion::empty(bodies);
        let state = TreeState { orientation, dq, ..TreeState::origin(q.len()) };
        places.set(bodies, &TreeState { q, ..state }, GRAVITY);
        places
    }

    /// Returns the torques that bodies need at a point, by joint, with positions that are shifted [rad], and gravity turned by an angle about
    /// each axis of the base [rad].
    pub fn needed(
        &self,
        bodies: &TreeParameters<f64>,
        point: usize,
        shift: impl Fn(usize) -> f64,
        tilt: [f64; 3],
    ) -> Vec<f64> {
        let q = self.motion[0].iter().enumerate().map(|(joint, cells)| cells[point] + shift(joint)).collect();
        let places = self.places(bodies, q, point, tilt);
        let ddq = self.motion[2].iter().map(|cells| cells[point]).collect();
        let acceleration = TreeAcceleration { angular: Vec3([0.0; 3]), linear: Vec3([0.0; 3]), ddq };
        inverse_dynamics(&bodies.structure, bodies, &places, &acceleration).tau
    }

    /// Returns torques by joint and point, given those of a point.
    pub fn everywhere(&self, at: impl Fn(usize) -> Vec<f64> + Sync) -> Vec<Vec<f64>> {
        let mut all = vec![vec![0.0; self.points()]; self.motion[0].len()];
        for (range, _) in &self.ranges {
            let knots: Vec<usize> = range.clone().step_by(BODY_POINTS).chain([range.end - 1]).collect();
            let values: Vec<Vec<f64>> = knots.par_iter().map(|knot| at(*knot)).collect();
            for (pair, ends) in knots.windows(2).zip(values.windows(2)) {
                for point in pair[0]..=pair[1] {
                    let share = (point - pair[0]) as f64 / (pair[1] - pair[0]).max(1) as f64;
                    for (joint, cells) in all.iter_mut().enumerate() {
                        cells[point] = (1.0 - share) * ends[0][joint] + share * ends[1][joint];
                    }
                }
            }
        }
        all
    }

    /// Returns mass matrix and stiffness by gravity and motion of all joints, every [`BODY_POINTS`] points.
    pub fn matrices(&self, robot: &Robot, limbs: &[Vec<usize>]) -> Knots {
        let bodies = TreeParameters::splat(&robot.tree);
        let (depth, joints) = (limbs.iter().map(Vec::len).max().unwrap_or(0), robot.joints.len());
        let base = bodies.structure.num_base_velocities();
        let of_point = |point: usize| {
            let now = self.needed(&bodies, point, |_| 0.0, [0.0; 3]);
            // One joint of each limb moves at a time.
            let slope = |place: usize| {
                let shift =
                    |joint: usize| if limbs.iter().any(|limb| limb.get(place) == Some(&joint)) { STEP } else { 0.0 };
                let moved = self.needed(&bodies, point, shift, [0.0; 3]);
                moved.iter().zip(&now).map(|(moved, now)| (moved - now) / STEP).collect::<Vec<f64>>()
            };
            let slopes: Vec<Vec<f64>> = (0..depth).map(slope).collect();
            let place_of =
                |joint: usize| limbs.iter().find_map(|limb| limb.iter().position(|one| *one == joint)).unwrap_or(0);
            let stiffness = DMatrix::from_fn(joints, joints, |row, column| slopes[place_of(column)][row]);
            let q = self.motion[0].iter().map(|cells| cells[point]).collect();
            let entries = mass_matrix(&bodies.structure, &bodies, &self.places(&bodies, q, point, [0.0; 3]));
            let mass = DMatrix::from_fn(joints, joints, |row, column| {
                entries[base + row][base + column] + if row == column { robot.joints[row].armature } else { 0.0 }
            });
            [mass, stiffness]
        };
        Knots((0..self.points()).into_par_iter().step_by(BODY_POINTS).map(of_point).collect())
    }
}

/// Mass matrix and stiffness of bodies on a coarser grid.
pub struct Knots(Vec<[DMatrix<f64>; 2]>);

impl Knots {
    /// Returns mass matrix and stiffness at a point.
    pub fn at(&self, point: usize) -> &[DMatrix<f64>; 2] {
        &self.0[point / BODY_POINTS]
    }
}

/// Returns the joints of each limb of a fixed base, from the base outwards.
pub fn limbs(structure: &TreeStructure) -> Vec<Vec<usize>> {
    let mut limbs: Vec<Vec<usize>> = Vec::new();
    for joint in 0..structure.num_joints() {
        let first = structure.branches[joint + 1][0];
        match limbs.iter_mut().find(|limb| limb[0] == first) {
            Some(limb) => limb.push(joint),
            None => limbs.push(vec![joint]),
        }
    }
    limbs
}
