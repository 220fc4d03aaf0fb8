//! Residuals of a log without motor currents: measured minus simulated positions of a robot with a fixed base.
//!
//! Nothing measured is differentiated. The robot is simulated in windows from their first measured states, and columns are differences of
//! simulations. On a fixed base the limbs move independently, so one simulation has a change at each of them.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use twinstep_effects::{CATALOGUE, Effect};
use twinstep_logs::Log;
use twinstep_model::{CONTACT, JointModel, RobotTree, TreeModel};

use super::block::{Block, Column};
use super::gaussian::Group;
use super::law::{Law, Place};
use super::residuals::{Change, Formula, Little, Residuals, Small, State};
use super::robot::Robot;
use super::site::Site;
use super::small_changes::{SmallChange, SmallUnknown, small_unknowns};
use crate::{Candidate, InferenceError, JointLog, Trace, Window, WindowLength, simulate, windows};

/// Least time between compared rows [s].
const ROW_S: f64 = 0.008;
/// Most time that is simulated, in windows over the whole log, times the number of joints [s].
const MOST_S: f64 = 192.0;
/// Least standard deviation of a position [rad]: two physics engines differ by 1 mrad on the same commands.
const POSITION: f64 = 1e-3;
/// Residual where a simulation has no finite position [rad].
const DIVERGED: f64 = 10.0;
/// Change of a position that only an unstable simulation has [rad].
const UNSTABLE: f64 = 3.0;

/// Measured minus simulated positions of the joints of a log.
pub struct Positions {
    log: JointLog,
    windows: Vec<Window>,
    blocks: Vec<Block>,
    /// Compared rows by joint of the log: window, and row in it.
    rows: Vec<Vec<(usize, usize)>>,
    /// Limb of each joint.
    limbs: Vec<usize>,
    small: Vec<SmallUnknown>,
    drives: Drives,
    /// Joints of the given robot.
    given: Vec<JointModel>,
}

/// Drives of a robot.
#[derive(Clone)]
pub struct Drives {
    /// Position gain of each joint that the log does not state [N·m/rad].
    pub kp: Vec<f64>,
    /// Velocity gain of each joint that the log does not state [N·m·s/rad].
    pub kd: Vec<f64>,
    /// Rate [Hz].
    pub actuator_hz: f64,
    /// First estimates of the joints.
    pub estimates: Option<Vec<JointModel>>,
    /// Ends simulations when it is true: what they would have is then missing.
    pub stop: Arc<AtomicBool>,
}

/// Simulation of a robot, by window.
pub struct Simulated(Option<Vec<Trace>>);

impl Positions {
    /// Prepares the windows of the rows that are used. Returns an error if the log cannot be simulated on a fixed base.
    pub fn new(
        log: &Log,
        robot: &Robot,
        laws: &[Law],
        is_used: impl Fn(usize) -> bool,
        drives: &Drives,
    ) -> Result<Self, InferenceError> {
        let log_noise = |name: &str| log.noise(&format!("q_{name}"));
        let noise = log.joints().iter().filter_map(|name| log_noise(name)).fold(POSITION, f64::max);
        let log = JointLog::new(log, &robot.tree, is_used)?;
        let mut windows = windows(&log, &robot.tree, WindowLength::IDENTIFICATION);
        let length: f64 = windows.iter().map(|window| log.t[window.rows.end - 1] - log.t[window.rows.start]).sum();
        let kept =
            ((MOST_S / log.joints.len() as f64 / length).min(1.0) * windows.len() as f64).ceil().max(1.0) as usize;
        let all = windows.len();
        let mut index = 0;
        windows.retain(|_| {
            index += 1;
            index * kept / all > (index - 1) * kept / all
        });
        let rows: Vec<Vec<(usize, usize)>> =
            (0..log.joints.len()).map(|joint| compared_rows(&log, joint, &windows)).collect();
        let block = |(channels, rows): (&crate::joint_log::JointChannels, &Vec<(usize, usize)>)| {
            let t = rows.iter().map(|(window, inner)| log.t[windows[*window].rows.start + inner]).collect();
            Block { name: format!("position {} hang", channels.name), t, y: vec![0.0; rows.len()], sigma: noise }
        };
        let blocks = log.joints.iter().zip(&rows).map(block).collect();
        let limbs = limbs(&robot.tree);
        let small = small_unknowns(robot, laws, &log);
        Ok(Self { log, windows, blocks, rows, limbs, small, drives: drives.clone(), given: robot.joints.clone() })
    }

    fn simulated(&self, robots: &[Robot]) -> Vec<Simulated> {
        let candidate = |robot: &Robot| {
            let robot = TreeModel {
                tree: robot.tree.clone(),
                joints: robot.joints.clone(),
                points: Vec::new(),
                contact: CONTACT,
            };
            Candidate { robot, kp: self.drives.kp.clone(), kd: self.drives.kd.clone() }
        };
        let candidates: Vec<Candidate> = robots.iter().map(candidate).collect();
        let run = |candidates: &[Candidate]| {
            simulate(&self.log, &self.windows, candidates, self.drives.actuator_hz, &self.drives.stop)
        };
        if let Ok(all) = run(&candidates) {
            return all.into_iter().map(|traces| Simulated(Some(traces))).collect();
        }
        // One of them is impossible.
        let alone = |one: &Candidate| Simulated(run(std::slice::from_ref(one)).ok().map(|mut all| all.remove(0)));
        candidates.iter().map(alone).collect()
    }

    /// Returns a simulated position of a joint of the log in its compared rows.
    fn positions(&self, simulated: &Simulated, joint: usize) -> Option<Vec<f64>> {
        let traces = simulated.0.as_ref()?;
        Some(self.rows[joint].iter().map(|(window, inner)| traces[*window].q[joint][*inner]).collect())
    }

    /// Returns the columns of changed robots: what each has in addition to the robot before.
    fn columns_of(&self, (robot, before): (&Robot, &Simulated), changed: &[Robot]) -> Vec<Column> {
        let limbs = self.limbs.iter().max().map_or(0, |last| last + 1);
        let touched: Vec<Vec<usize>> = changed.iter().map(|after| self.touched(robot, after, limbs)).collect();
        // Robots with changes at different limbs are simulated as one.
        let mut merged: Vec<(Vec<bool>, Robot)> = Vec::new();
        let mut place = vec![None; changed.len()];
        for (index, limbs_of) in touched.iter().enumerate().filter(|(_, limbs)| !limbs.is_empty()) {
            let free = |taken: &(Vec<bool>, Robot)| limbs_of.iter().all(|limb| !taken.0[*limb]);
            let found = merged.iter().position(free).unwrap_or_else(|| {
                merged.push((vec![false; limbs], robot.clone()));
                merged.len() - 1
            });
            let (taken, together) = &mut merged[found];
            for limb in limbs_of {
                taken[*limb] = true;
                for joint in (0..self.limbs.len()).filter(|joint| self.limbs[*joint] == *limb) {
                    together.joints[joint] = changed[index].joints[joint];
                    together.tree.joints[joint] = changed[index].tree.joints[joint].clone();
                    together.tree.bodies[joint + 1] = changed[index].tree.bodies[joint + 1].clone();
                }
            }
            place[index] = Some(found);
        }
        let robots: Vec<Robot> = merged.into_iter().map(|(_, robot)| robot).collect();
        let simulated = self.simulated(&robots);
        let column = |(found, limbs_of): (&Option<usize>, &Vec<usize>)| {
            let Some(found) = found else { return Column::default() };
            let part = |joint: usize| {
                if !limbs_of.contains(&self.limbs[self.log.joints[joint].joint]) {
                    return None;
                }
                let [now, then] = [self.positions(&simulated[*found], joint)?, self.positions(before, joint)?];
                let change: Vec<f64> = now.iter().zip(&then).map(|(now, then)| now - then).collect();
                let is_stable = change.iter().all(|one| one.is_finite() && one.abs() < UNSTABLE);
                (is_stable && change.iter().any(|one| *one != 0.0)).then_some((joint, change))
            };
            Column { parts: (0..self.log.joints.len()).filter_map(part).collect() }
        };
        place.iter().zip(&touched).map(column).collect()
    }

    /// Returns the limbs at which two robots differ.
    fn touched(&self, robot: &Robot, after: &Robot, limbs: usize) -> Vec<usize> {
        let differs = |limb: usize| {
            (0..self.limbs.len()).filter(|joint| self.limbs[*joint] == limb).any(|joint| {
                robot.joints[joint] != after.joints[joint]
                    || robot.tree.joints[joint] != after.tree.joints[joint]
                    || robot.tree.bodies[joint + 1] != after.tree.bodies[joint + 1]
            })
        };
        (0..limbs).filter(|limb| differs(*limb)).collect()
    }
}

impl Residuals for Positions {
    type Predicted = Simulated;

    fn usual(&self) -> Vec<(&'static str, Option<Vec<f64>>)> {
        let usual = CATALOGUE.into_iter().filter(|effect| effect.laws.iter().any(|form| form.is_usual));
        let start = |effect: &Effect| {
            let pairs = self.drives.estimates.as_ref()?.iter().zip(&self.given);
            Some(pairs.map(|(now, before)| effect.amount(now) - effect.amount(before)).collect())
        };
        usual.map(|effect| (effect.name, start(effect))).collect()
    }

    fn is_simulated(&self) -> bool {
        true
    }

    fn trial_steps(&self) -> usize {
        2
    }

    fn fit_steps(&self) -> usize {
        4
    }

    fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    fn predicted(&self, robots: &[Robot]) -> Vec<Simulated> {
        self.simulated(robots)
    }

    fn residuals(&self, _: &Robot, predicted: &Simulated) -> Vec<Block> {
        let mut blocks = self.blocks.clone();
        for (joint, block) in blocks.iter_mut().enumerate() {
            let channels = &self.log.joints[joint];
            let measured =
                self.rows[joint].iter().map(|(window, inner)| channels.q[self.windows[*window].rows.start + inner]);
            block.y = match self.positions(predicted, joint) {
                Some(simulated) => measured
                    .zip(simulated)
                    .map(|(measured, simulated)| measured - simulated)
                    .map(|left| if left.is_finite() { left.clamp(-DIVERGED, DIVERGED) } else { DIVERGED })
                    .collect(),
                None => vec![DIVERGED; self.rows[joint].len()],
            };
        }
        blocks
    }

    fn columns(&self, before: (&Robot, &Simulated), changes: &[Change]) -> Vec<Column> {
        let robots: Vec<Robot> = changes.iter().map(|change| change.after.clone()).collect();
        self.columns_of(before, &robots)
    }

    fn fingerprint(&self, _: Place, _: Site, _: &Robot, _: &Simulated) -> Option<u64> {
        // Every joint moves all the others.
        None
    }

    fn small(&self, laws: &[Law], robot: &Robot, predicted: &Simulated) -> Small {
        let changed = |small: &SmallUnknown| {
            let mut after = robot.clone();
            small.change.apply(laws, &mut after, small.std);
            after
        };
        let robots: Vec<Robot> = self.small.iter().map(changed).collect();
        let columns = self.columns_of((robot, predicted), &robots);
        let group = |(column, small): (&Column, &SmallUnknown)| {
            let gain = match small.change {
                SmallChange::OfLaw { law, unknown, .. } if laws[law].form.is_gain => Some(unknown),
                _ => None,
            };
            Group { gain, ..Group::single(column.scaled(1.0 / small.std), small.std) }
        };
        Small::new(columns.iter().zip(&self.small).map(group).collect())
    }

    fn apply_small(&self, laws: &[Law], robot: &mut Robot, values: &mut [f64]) -> bool {
        for (small, value) in self.small.iter().zip(values) {
            *value = value.max(small.change.least(laws, robot));
            small.change.apply(laws, robot, *value);
        }
        true
    }

    fn little(&self, values: &[f64], stds: &[f64]) -> Vec<Little> {
        let mut all: Vec<Little> = Vec::new();
        for ((small, value), std) in self.small.iter().zip(values).zip(stds) {
            let SmallChange::OfLaw { law, joint, .. } = small.change else { continue };
            match all.last_mut() {
                Some(last) if last.law == law && last.joint == joint => {
                    last.unknowns.push(*value);
                    last.stds.push(*std);
                }
                _ => all.push(Little { law, joint, unknowns: vec![*value], stds: vec![*std] }),
            }
        }
        all
    }

    fn places(&self) -> &[Place] {
        &[]
    }

    fn functions(&self, _: &Simulated, _: usize, _: Place) -> Vec<Column> {
        Vec::new()
    }

    fn formulas(&self, _: &Simulated, _: usize, _: Place) -> Vec<Formula> {
        Vec::new()
    }

    fn state(&self, predicted: &Simulated, joint: usize, t: f64) -> State {
        let still = State { q: 0.0, dq: 0.0, torque: 0.0 };
        let Some(index) = self.log.joints.iter().position(|channels| channels.joint == joint) else { return still };
        let holds = |window: &Window| t <= self.log.t[window.rows.end - 1];
        let place = self.windows.iter().position(holds).unwrap_or(self.windows.len() - 1);
        let Some(trace) = predicted.0.as_ref().map(|traces| &traces[place]) else { return still };
        let rows = &self.windows[place].rows;
        let inner = self.log.t[rows.clone()].partition_point(|time| *time < t).min(rows.len() - 1);
        let (from, to) = (inner.saturating_sub(1), (inner + 1).min(rows.len() - 1));
        let [q, torque] = [&trace.q[index], &trace.tau[index]];
        let dq = (q[to] - q[from]) / (self.log.t[rows.start + to] - self.log.t[rows.start + from]).max(1e-6);
        State { q: q[inner], dq, torque: if torque[inner].is_finite() { torque[inner] } else { 0.0 } }
    }
}

/// Returns the limb of each joint: a part of the tree that only the base joins to others.
fn limbs(tree: &RobotTree) -> Vec<usize> {
    let (mut limbs, mut next) = (Vec::new(), 0);
    for joint in &tree.joints {
        let limb = joint.parent.checked_sub(1).map(|parent| limbs[parent]);
        limbs.push(limb.unwrap_or_else(|| {
            next += 1;
            next - 1
        }));
    }
    limbs
}

/// Returns the rows of a joint that are compared.
fn compared_rows(log: &JointLog, joint: usize, windows: &[Window]) -> Vec<(usize, usize)> {
    let mut rows = Vec::new();
    for (index, window) in windows.iter().enumerate() {
        let mut last = f64::NEG_INFINITY;
        for row in window.first_compared..window.rows.end {
            if log.joints[joint].q[row].is_finite() && log.t[row] - last > ROW_S - 1e-6 {
                rows.push((index, row - window.rows.start));
                last = log.t[row];
            }
        }
    }
    rows
}

/// Returns true if a law changes simulated positions.
pub fn is_simulated(law: &Law) -> bool {
    // Voltage and temperature are not simulated.
    !matches!(law.form.place, Place::Sensor | Place::Gyro) && law.effect.search.predictable
}
