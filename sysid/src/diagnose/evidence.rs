//! Logs as evidence: what a candidate model leaves of each channel, in two folds of alternating seconds. Every fifth second is
//! set aside.

use twinstep_logs::Log;
use twinstep_model::{NUM_JOINTS, Precision, RobotModel, Rollout};

use crate::experiment::{Experiment, ExperimentError, Quantity};
use crate::tolerance::{self, Tolerances};
use crate::torque::MeasuredTorque;
use crate::window::Horizon;

/// Channels: positions, torques, and of the trunk position, orientation, velocity and rate.
pub const CHANNELS: usize = 2 * NUM_JOINTS + 12;
/// First channel of the torques.
pub const TORQUE: usize = NUM_JOINTS;
/// First channel of the trunk.
pub const TRUNK: usize = 2 * NUM_JOINTS;
/// First channel of its gyroscope.
const GYRO: usize = TRUNK + 9;
/// Candidates that are simulated at once, which bounds memory.
const TOGETHER: usize = 64;
/// Errors of this size [noise of the channel stands beside it] are any simulator's: position [rad] and torque [N·m].
const MISFIT: [f64; 2] = [0.001, 0.02];
/// Length of a block [s]; blocks go to the two folds in turn.
const BLOCK_S: f64 = 1.0;
/// Rows this long apart [s] are independent: positions, torques, the trunk, and its gyroscope, which has more noise than error.
const INDEPENDENT_S: [f64; 4] = [0.2, 0.1, 0.5, 0.05];

/// Sums of squares and counts by channel and fold, in units of noise and misfit.
#[derive(Clone, Debug)]
pub struct Leftover {
    /// Sums of squares.
    pub sums: [[f64; 2]; CHANNELS],
    /// Numbers of rows.
    pub counts: [[f64; 2]; CHANNELS],
    /// What tolerated errors cost that explain a part of the rest, of starts and of the robot [nats].
    pub tolerated: [f64; 2],
}

/// Rows of all logs.
pub struct Rows {
    /// The logs, each with these rows alone.
    pub experiments: Vec<Experiment>,
    /// Errors of any robot, in these rows; none where every trunk was held.
    pub tolerances: Option<Tolerances>,
    /// For every residual its channel, its fold, and what it is multiplied by.
    cells: Vec<(usize, Option<usize>, f64)>,
}

/// Logs of one robot.
pub struct Evidence {
    logs: Vec<Log>,
    /// All rows but those that are set aside.
    pub whole: Rows,
    /// One half of them and the other.
    pub folds: [Rows; 2],
    /// Of all of them those with the trunk held, if there are any: joints hardly disturb each other there.
    quick: Rows,
    torques: Vec<MeasuredTorque>,
}

impl Rows {
    fn new(logs: &[Log], experiments: Vec<Experiment>) -> Self {
        let mut cells = Vec::new();
        for (log, experiment) in logs.iter().zip(&experiments) {
            cells.extend(experiment.cells().map(|(quantity, row)| {
                // A velocity says what the position does, with more noise; torques are judged without a simulation.
                let (channel, weight) = match quantity {
                    Quantity::Position(joint) => (joint, 1.0 / (MISFIT[0] / experiment.sigma(quantity)).hypot(1.0)),
                    Quantity::Velocity(_) | Quantity::Torque(_) => (0, 0.0),
                    Quantity::BasePosition(axis) => (TRUNK + axis, std::f64::consts::FRAC_1_SQRT_2),
                    Quantity::BaseOrientation(axis) => (TRUNK + 3 + axis, std::f64::consts::FRAC_1_SQRT_2),
                    Quantity::BaseVelocity(axis) => (TRUNK + 6 + axis, std::f64::consts::FRAC_1_SQRT_2),
                    Quantity::BaseRate(axis) => (GYRO + axis, 0.95),
                };
                (channel, if weight > 0.0 { fold_of(log, row) } else { None }, weight)
            }));
        }
        Self { experiments, tolerances: None, cells }
    }

    /// What candidates leave of the motion.
    fn leftovers(&self, simulator: &mut dyn Rollout, robots: &[RobotModel]) -> Vec<Leftover> {
        let mut whole = vec![Vec::new(); robots.len()];
        for experiment in &self.experiments {
            for (robots, whole) in robots.chunks(TOGETHER).zip(whole.chunks_mut(TOGETHER)) {
                let residuals = experiment.residuals(simulator, robots, PRECISION);
                whole.iter_mut().zip(residuals).for_each(|(whole, residuals)| whole.extend(residuals));
            }
        }
        whole.into_iter().map(|residuals| self.leftover(residuals)).collect()
    }

    /// Residuals of a candidate less what tolerated errors explain.
    pub fn corrected(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> Vec<f64> {
        let one = std::slice::from_ref(robot);
        let parts = self.experiments.iter().flat_map(|experiment| experiment.residuals(simulator, one, PRECISION));
        let mut residuals: Vec<f64> = parts.flatten().collect();
        if let Some(tolerances) = &self.tolerances {
            tolerances.take(&mut residuals);
        }
        residuals
    }

    fn leftover(&self, mut residuals: Vec<f64>) -> Leftover {
        if let Some(tolerances) = &self.tolerances {
            tolerances.take(&mut residuals);
        }
        let mut left = Leftover {
            sums: [[0.0; 2]; CHANNELS],
            counts: [[0.0; 2]; CHANNELS],
            tolerated: Tolerances::nats(&residuals[self.cells.len()..]),
        };
        for (residual, (channel, fold, weight)) in residuals.iter().zip(&self.cells) {
            left.add(*channel, *fold, residual * weight);
        }
        left
    }
}

impl Evidence {
    /// `logs` of a robot with the gains and rates of `robot`.
    pub fn new(logs: Vec<Log>, robot: &RobotModel) -> Result<Self, ExperimentError> {
        let experiments: Vec<Experiment> =
            logs.iter().map(|log| Experiment::new(log, robot, Horizon::DIAGNOSIS)).collect::<Result<_, _>>()?;
        let only = |keep: &dyn Fn(Option<usize>) -> bool| -> Vec<Experiment> {
            let pairs = logs.iter().zip(&experiments);
            pairs.map(|(log, experiment)| experiment.clone().only(|row| keep(fold_of(log, row)))).collect()
        };
        let whole = only(&|fold| fold.is_some());
        let quick = whole.iter().cloned().map(Experiment::held_first).collect();
        Ok(Self {
            torques: logs.iter().map(|log| MeasuredTorque::new(log, robot)).collect::<Result<_, _>>()?,
            folds: [0, 1].map(|fold| Rows::new(&logs, only(&|of| of == Some(fold)))),
            whole: Rows::new(&logs, whole),
            quick: Rows::new(&logs, quick),
            logs,
        })
    }

    /// From here on, errors that any robot has are not evidence; `robot` is the model.
    pub fn tolerate(&mut self, robot: &RobotModel, simulator: &mut dyn Rollout) {
        if self.has_free_parts() {
            for rows in [&mut self.whole].into_iter().chain(&mut self.folds) {
                rows.tolerances = Tolerances::new(&rows.experiments, robot, simulator);
            }
            if self.quick.experiments.iter().any(Experiment::has_free_parts) {
                self.quick.tolerances.clone_from(&self.whole.tolerances);
            }
        }
    }

    /// The logs.
    pub fn logs(&self) -> &[Log] {
        &self.logs
    }

    /// Whether a trunk was free somewhere.
    pub fn has_free_parts(&self) -> bool {
        self.whole.experiments.iter().any(Experiment::has_free_parts)
    }

    /// What candidates leave; with `quick` only where the trunk was held, if it was.
    pub fn leftovers(&self, simulator: &mut dyn Rollout, robots: &[RobotModel], quick: bool) -> Vec<Leftover> {
        let rows = if quick { &self.quick } else { &self.whole };
        let mut leftovers = rows.leftovers(simulator, robots);
        for (log, torques) in self.logs.iter().zip(&self.torques) {
            for index in 0..robots.len() {
                // Most effects are behind the torque's sensor: what it shows is as before.
                let alike = index > 0 && torques.are_alike(&robots[index], &robots[index - 1]);
                if alike {
                    let (done, rest) = leftovers.split_at_mut(index);
                    rest[0].sums[TORQUE..TRUNK].copy_from_slice(&done[index - 1].sums[TORQUE..TRUNK]);
                    rest[0].counts[TORQUE..TRUNK].copy_from_slice(&done[index - 1].counts[TORQUE..TRUNK]);
                    continue;
                }
                let sigma = torque_sigma(log, &robots[index]);
                torques.differences(&robots[index], |joint, row, difference| {
                    leftovers[index].add(TORQUE + joint, fold_of(log, row), difference / sigma[joint]);
                });
            }
        }
        leftovers
    }

    /// What one candidate leaves of everything.
    pub fn leftover(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> Leftover {
        self.leftovers(simulator, std::slice::from_ref(robot), false).remove(0)
    }

    /// Rows of a channel that count as one.
    pub fn rows_in_one(&self, channel: usize) -> f64 {
        let kind = [TORQUE, TRUNK, GYRO].into_iter().filter(|first| channel >= *first).count();
        (INDEPENDENT_S[kind] * self.logs[0].meta().rate_hz).max(1.0)
    }

    /// Measured torques of the first log.
    pub fn torques(&self) -> &MeasuredTorque {
        &self.torques[0]
    }
}

/// What evidence is simulated in.
pub const PRECISION: Precision = Precision::Single;

impl Leftover {
    /// How much less tolerated errors cost than `before` [nats].
    pub fn tolerated_gain(&self, before: &Self) -> f64 {
        before.tolerated.iter().sum::<f64>() - self.tolerated.iter().sum::<f64>()
    }

    fn add(&mut self, channel: usize, fold: Option<usize>, difference: f64) {
        let Some(fold) = fold else { return };
        self.sums[channel][fold] += difference * difference;
        self.counts[channel][fold] += 1.0;
    }

    /// True if the candidate diverged.
    pub fn diverged(&self) -> bool {
        self.sums.iter().flatten().any(|sum| !sum.is_finite())
    }

    /// Evidence for this model against `before` in a channel and fold [nats], with `rows` counting as one.
    pub fn gain(&self, before: &Self, channel: usize, fold: usize, rows: f64) -> f64 {
        let (now, then, count) = (self.sums[channel][fold], before.sums[channel][fold], before.counts[channel][fold]);
        if count == 0.0 {
            return 0.0;
        }
        if !now.is_finite() {
            return f64::NEG_INFINITY;
        }
        0.5 * count / rows * ((then + 1e-9) / (now + 1e-9)).ln()
    }

    /// Power above noise and misfit, everywhere.
    pub fn excess(&self) -> f64 {
        (0..CHANNELS).map(|channel| self.channel_excess(channel)).sum::<f64>() + self.tolerated_excess()
    }

    /// Power that errors of the robot would have to explain beyond what any robot has.
    pub fn tolerated_excess(&self) -> f64 {
        tolerance::excess(self.tolerated[1])
    }

    /// Power above noise and misfit of a channel.
    pub fn channel_excess(&self, channel: usize) -> f64 {
        let sum: f64 = self.sums[channel].iter().sum();
        (sum - self.counts[channel].iter().sum::<f64>()).max(0.0)
    }
}

/// The fold of a row; none where it is set aside: every fifth block takes no part in any choice or fit, and tells the gain.
pub fn fold_of(log: &Log, row: usize) -> Option<usize> {
    let block = (row as f64 / (BLOCK_S * log.meta().rate_hz)) as usize % 5;
    (block < 4).then_some(block % 2)
}

/// Noise of the torques that measured states make, beside the sensor's own and any simulator's misfit [N·m].
fn torque_sigma(log: &Log, robot: &RobotModel) -> [f64; NUM_JOINTS] {
    twinstep_model::JOINT_NAMES.map(|name| {
        let noise = |channel: &str, assumed: f64| {
            log.noise(&format!("{channel}_{name}")).filter(|sigma| *sigma > 0.0).unwrap_or(assumed)
        };
        let known = log.joints().iter().any(|joint| joint == name);
        let gain = |gain: Option<f64>, nominal: f64| gain.filter(|_| known).unwrap_or(nominal);
        let kp = gain(log.kp(name, 0), robot.control.kp);
        let kd = gain(log.kd(name, 0), robot.control.kd);
        let measured = noise("tau_measured", 0.2).hypot(MISFIT[1]);
        measured.hypot(kp * noise("q", 0.002)).hypot(kd * noise("dq", 0.05))
    })
}

#[cfg(test)]
mod tests {
    use twinstep_logs::{Base, Meta, Segment, TauSensor};

    use super::*;

    #[test]
    fn every_fifth_second_takes_no_part_in_choice_or_fit() {
        let segments = vec![Segment { name: "air".to_owned(), base: Base::Fixed }];
        let column = |name: &str, value: fn(usize) -> f64| (name.to_owned(), (0..100).map(value).collect());
        let columns = [
            column("t", |row| row as f64 / 10.0),
            column("q_FL_hip", |_| 0.0),
            column("q_cmd_FL_hip", |_| 0.0),
            column("kp", |_| 20.0),
            column("kd", |_| 0.5),
        ];
        let log = Log::new(Meta::new(10.0, TauSensor::None, segments), columns).expect("a log");
        let folds: Vec<_> = (0..100).step_by(10).map(|row| fold_of(&log, row)).collect();
        let five = [Some(0), Some(1), Some(0), Some(1), None];
        assert_eq!(folds, [five, five].concat());
    }
}
