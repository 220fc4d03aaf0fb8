//! Residuals of a log with torques: the equations of its drives, joints and base.

use rayon::prelude::*;

use super::block::{Block, Column};
use super::law::{Law, Place};
use super::nuisance;
use super::residuals::{Change, Formula, Little, Residuals, Small, State};
use super::robot::Robot;
use super::site::Site;
use super::system::{self, Predicted, System};
use super::unknown;

impl Residuals for System {
    type Predicted = Predicted;

    fn usual(&self) -> Vec<(&'static str, Option<Vec<f64>>)> {
        Vec::new()
    }

    fn is_simulated(&self) -> bool {
        false
    }

    fn trial_steps(&self) -> usize {
        3
    }

    fn fit_steps(&self) -> usize {
        8
    }

    fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    fn predicted(&self, robots: &[Robot]) -> Vec<Predicted> {
        robots.iter().map(|robot| self.predicted(robot)).collect()
    }

    fn residuals(&self, robot: &Robot, predicted: &Predicted) -> Vec<Block> {
        self.residuals(robot, predicted)
    }

    fn columns(&self, before: (&Robot, &Predicted), changes: &[Change]) -> Vec<Column> {
        changes.par_iter().map(|change| self.column(change.law, change.site, before, &change.after)).collect()
    }

    fn fingerprint(&self, place: Place, site: Site, robot: &Robot, predicted: &Predicted) -> Option<u64> {
        system::fingerprint(place, site, robot, predicted)
    }

    fn small(&self, laws: &[Law], robot: &Robot, predicted: &Predicted) -> Small {
        let of_joints = nuisance::of_joints(self, laws, robot, predicted);
        // Their columns hardly depend on the robot.
        let of_bodies = self.of_bodies.get_or_init(|| nuisance::of_bodies(self, laws, robot, predicted));
        Small::new([of_bodies.as_slice(), &of_joints].concat())
    }

    fn apply_small(&self, _: &[Law], _: &mut Robot, _: &mut [f64]) -> bool {
        false
    }

    fn little(&self, _: &[f64], _: &[f64]) -> Vec<Little> {
        Vec::new()
    }

    fn places(&self) -> &[Place] {
        &[Place::Drive, Place::Joint]
    }

    fn functions(&self, predicted: &Predicted, joint: usize, place: Place) -> Vec<Column> {
        unknown::columns(self, predicted, joint, place)
    }

    fn formulas(&self, predicted: &Predicted, joint: usize, place: Place) -> Vec<Formula> {
        unknown::formulas(self, predicted, joint, place)
    }

    fn state(&self, predicted: &Predicted, joint: usize, t: f64) -> State {
        let row = self.measured.t.partition_point(|time| *time < t).min(self.measured.t.len() - 1);
        let [q, dq] = [0, 1].map(|quantity| self.measured.joints[joint].smooth[quantity][row]);
        State { q, dq, torque: predicted.sensed(joint)[row] }
    }
}
