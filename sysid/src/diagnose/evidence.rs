//! Logs as evidence: what a candidate model leaves of each channel, in two folds of alternating seconds. Every fifth second is
//! set aside.

use twinstep_logs::Log;
use twinstep_model::{NUM_JOINTS, Precision, RobotModel, Rollout};

use crate::experiment::{Experiment, ExperimentError, Quantity};
use crate::torque::MeasuredTorque;
use crate::window::Horizon;

/// Channels: positions, torques, and of the trunk position, orientation, velocity and rate.
pub const CHANNELS: usize = 2 * NUM_JOINTS + 12;
/// First channel of the torques.
pub const TORQUE: usize = NUM_JOINTS;
/// First channel of the trunk.
pub const TRUNK: usize = 2 * NUM_JOINTS;
/// Candidates that are simulated at once, which bounds memory.
const TOGETHER: usize = 64;
/// Errors of this size [noise of the channel stands beside it] are any simulator's: position [rad] and torque [N·m].
const MISFIT: [f64; 2] = [0.001, 0.02];
/// Length of a block [s]; blocks go to the two folds in turn.
const BLOCK_S: f64 = 1.0;
/// Rows this long apart [s] are independent: positions, torques, the trunk.
const INDEPENDENT_S: [f64; 3] = [0.2, 0.1, 0.5];

/// Sums of squares and counts by channel and fold, in units of noise and misfit.
#[derive(Clone, Debug)]
pub struct Leftover {
    /// Sums of squares.
    pub sums: [[f64; 2]; CHANNELS],
    /// Numbers of rows.
    pub counts: [[f64; 2]; CHANNELS],
}

/// Logs of one robot.
pub struct Evidence {
    logs: Vec<Log>,
    experiments: Vec<Experiment>,
    torques: Vec<MeasuredTorque>,
}

impl Evidence {
    /// `logs` of a robot with the gains and rates of `robot`.
    pub fn new(logs: Vec<Log>, robot: &RobotModel) -> Result<Self, ExperimentError> {
        let kept = |log: &Log| -> Result<Experiment, ExperimentError> {
            let whole = Experiment::new(log, robot, Horizon::IDENTIFICATION)?;
            Ok(whole.only(|row| fold_of(log, row).is_some()))
        };
        let experiments = logs.iter().map(kept).collect::<Result<_, _>>()?;
        let torques = logs.iter().map(|log| MeasuredTorque::new(log, robot)).collect::<Result<_, _>>()?;
        Ok(Self { logs, experiments, torques })
    }

    /// The logs.
    pub fn logs(&self) -> &[Log] {
        &self.logs
    }

    /// All rows but those that are set aside.
    pub fn experiments(&self) -> &[Experiment] {
        &self.experiments
    }

    /// Whether a trunk was free somewhere.
    pub fn has_free_parts(&self) -> bool {
        self.experiments.iter().any(Experiment::has_free_parts)
    }

    /// The rows of one fold alone.
    pub fn fold(&self, fold: usize) -> Vec<Experiment> {
        let pairs = self.logs.iter().zip(&self.experiments);
        pairs.map(|(log, experiment)| experiment.clone().only(|row| fold_of(log, row) == Some(fold))).collect()
    }

    /// What candidates leave; with `quick` only where the trunk was held, if it was: joints hardly disturb each other there.
    pub fn leftovers(&self, simulator: &mut dyn Rollout, robots: &[RobotModel], quick: bool) -> Vec<Leftover> {
        let empty = Leftover { sums: [[0.0; 2]; CHANNELS], counts: [[0.0; 2]; CHANNELS] };
        let mut leftovers = vec![empty; robots.len()];
        for ((log, experiment), torques) in self.logs.iter().zip(&self.experiments).zip(&self.torques) {
            let chosen = if quick { experiment.clone().held_first() } else { experiment.clone() };
            for (chunk, leftovers) in robots.chunks(TOGETHER).zip(leftovers.chunks_mut(TOGETHER)) {
                chosen.differences(simulator, chunk, |candidate, quantity, row, difference| {
                    let (channel, misfit) = match quantity {
                        Quantity::Position(joint) => (joint, MISFIT[0] / experiment.sigma(quantity)),
                        Quantity::Velocity(_) | Quantity::Torque(_) => return,
                        Quantity::BasePosition(axis) => (TRUNK + axis, 1.0),
                        Quantity::BaseOrientation(axis) => (TRUNK + 3 + axis, 1.0),
                        Quantity::BaseVelocity(axis) => (TRUNK + 6 + axis, 1.0),
                        Quantity::BaseRate(axis) => (TRUNK + 9 + axis, 1.0),
                    };
                    leftovers[candidate].add(channel, fold_of(log, row), difference / misfit.hypot(1.0));
                });
            }
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
        let kind = if channel < TORQUE { 0 } else { 1 + usize::from(channel >= TRUNK) };
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

    /// Power above noise and misfit, over the channels `of`.
    pub fn excess(&self, of: impl Fn(usize) -> bool) -> f64 {
        (0..CHANNELS).filter(|channel| of(*channel)).map(|channel| self.channel_excess(channel)).sum()
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
