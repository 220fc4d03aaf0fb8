//! Data sets for training and evaluation, from measured logs.

use std::ops::Range;

use sha2::{Digest, Sha256};
use twinstep_logs::replay::check_gains;
use twinstep_logs::{Log, TorqueSensor};

use crate::EnsembleError;
use crate::network_input::{NetworkInput, NetworkTarget};
use crate::smooth::smoothed;

/// Maximum length of a block [s]: long compared with an actuator's time constants, short compared with a motion.
const LONGEST_BLOCK_S: f64 = 2.0;
/// Minimum length of a block [rows].
const SHORTEST_BLOCK: usize = 60;
/// Of this many consecutive blocks, one is for validation and one for test.
const CYCLE: usize = 10;
/// Relative deviation of a time step from the log's rate above which it is a gap.
const JITTER: f64 = 0.25;

/// Data split. The split is by blocks of time, the same for all joints, because neighbouring rows are correlated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Training: eight of ten blocks.
    Training,
    /// Early stopping and variance scale: one of ten blocks.
    Validation,
    /// Evaluation: one of ten blocks.
    Test,
}

/// Contiguous rows of one joint within one block.
#[derive(Clone, Debug, PartialEq)]
pub struct Sequence {
    /// Index of the log.
    pub log: usize,
    /// Index into [`DataSet::joints`].
    pub joint: usize,
    /// True if the actuator was reset just before, so that no burn-in is needed.
    pub after_reset: bool,
    /// The numbers of [`DataSet::input`] of each row.
    pub inputs: Vec<[f64; 2]>,
    /// Torque of each row, the mean until the next row [N·m].
    pub torques: Vec<f64>,
}

/// Sequences of measured logs with their common properties.
///
/// By default channels are used as measured. U2E §IV-B smooths them by a cubic spline, which uses future samples that
/// an actuator in a simulator does not have. Smoothing is therefore optional and only for the training split. A
/// missing velocity is the central difference of the position over two rows, which also uses one future sample.
#[derive(Clone, Debug)]
pub struct DataSet {
    /// Time step [s].
    pub dt: f64,
    /// Names of the joints with measured torque.
    pub joints: Vec<String>,
    /// Location of the torque sensor.
    pub tau_sensor: TorqueSensor,
    /// kp [N·m/rad] and kd [N·m·s/rad] of each joint. Empty if the input is [`NetworkInput::Torque`].
    pub gains: Vec<[f64; 2]>,
    /// The input of the networks.
    pub input: NetworkInput,
    /// Whether the torque of the logs is what was measured, or what a model lacks.
    pub target: NetworkTarget,
    runs: Vec<(Split, Sequence)>,
}

/// What a [`DataSet`] contains.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DataOptions {
    /// Position, velocity and torque of the training split are smoothed: the amplitude at this frequency \[Hz] is halved.
    /// Each sequence is smoothed separately.
    pub smooth_hz: Option<f64>,
    /// The input of the networks.
    pub input: NetworkInput,
    /// Whether the torque of the logs is what was measured, or what a model lacks.
    pub target: NetworkTarget,
}

impl DataSet {
    /// Creates the data set of `logs` with default options, each with its name in errors.
    pub fn new(logs: &[(String, Log)]) -> Result<Self, EnsembleError> {
        Self::with_options(logs, DataOptions::default())
    }

    /// Creates the data set of `logs`, each with its name in errors.
    pub fn with_options(logs: &[(String, Log)], options: DataOptions) -> Result<Self, EnsembleError> {
        let DataOptions { smooth_hz: hz, input, target } = options;
        let (first, first_log) = logs.first().ok_or(EnsembleError::TooShort { rows: 0, blocks: 0 })?;
        let tau_sensor = first_log.meta().tau_sensor;
        if tau_sensor == TorqueSensor::None {
            return Err(EnsembleError::NoTorque { log: first.clone() });
        }
        let dt = 1.0 / first_log.meta().rate_hz;
        if let Some(given) = hz.filter(|hz| !(*hz > 0.0 && *hz < 0.5 / dt)) {
            return Err(EnsembleError::Smoothing { given, most: 0.5 / dt });
        }
        let mut set = Self { dt, joints: Vec::new(), tau_sensor, gains: Vec::new(), input, target, runs: Vec::new() };
        let rows: usize = logs.iter().map(|(_, log)| log.rows()).sum();
        let longest = ((LONGEST_BLOCK_S / dt) as usize).max(SHORTEST_BLOCK);
        let block_rows = (rows / (2 * CYCLE)).clamp(SHORTEST_BLOCK, longest);
        let mut blocks = 0;
        for (index, (name, log)) in logs.iter().enumerate() {
            set.check(name, log)?;
            let columns = set.columns(name, log)?;
            for (_, part) in log.segments() {
                for start in part.clone().step_by(block_rows) {
                    let block = start..part.end.min(start + block_rows);
                    set.add(
                        log,
                        &columns,
                        &block,
                        BlockContext { log: index, starts_part: start == part.start, number: blocks, hz },
                    );
                    blocks += 1;
                }
            }
        }
        let has = |expected| set.runs.iter().any(|(block, _)| *block == expected);
        if [Split::Training, Split::Validation, Split::Test].into_iter().all(has) {
            return Ok(set);
        }
        Err(EnsembleError::TooShort { rows: set.runs.iter().map(|(_, run)| run.torques.len()).sum(), blocks })
    }

    /// Returns the sequences of one split, in the order of logs, time and joints.
    pub fn runs(&self, expected: Split) -> impl Iterator<Item = &Sequence> + Clone {
        self.runs.iter().filter(move |(block, _)| *block == expected).map(|(_, run)| run)
    }

    /// Returns the sequences of all splits, in the order of logs, time and joints.
    pub fn all_runs(&self) -> impl Iterator<Item = &Sequence> + Clone {
        self.runs.iter().map(|(_, run)| run)
    }

    /// Returns a hash of the data in hexadecimal.
    pub fn hash(&self) -> String {
        let mut hash = Sha256::new();
        hash.update(self.dt.to_le_bytes());
        hash.update(self.joints.join("\n"));
        if (self.input, self.target) != Default::default() {
            hash.update([self.input as u8, self.target as u8]);
        }
        for (block, run) in &self.runs {
            hash.update([*block as u8, run.after_reset as u8, run.joint as u8]);
            for number in run.inputs.iter().flatten().chain(&run.torques) {
                hash.update(number.to_le_bytes());
            }
        }
        let digest = hash.finalize();
        let start = digest.iter().take(8).fold(0, |start: u64, byte| start << 8 | u64::from(*byte));
        format!("{start:016x}")
    }

    fn check(&self, name: &str, log: &Log) -> Result<(), EnsembleError> {
        let given = 1.0 / log.meta().rate_hz;
        if (given / self.dt - 1.0).abs() > 1e-6 {
            return Err(EnsembleError::TimeStepMismatch { what: name.to_owned(), given, expected: self.dt });
        }
        if log.meta().tau_sensor != self.tau_sensor {
            return Err(EnsembleError::SensorMismatch { log: name.to_owned() });
        }
        check_gains(log).map_err(|cause| EnsembleError::UnknownGain { log: name.to_owned(), cause })
    }

    /// Returns the channels of each joint with measured torque. Adds new joints to the data set.
    fn columns<'a>(&mut self, name: &str, log: &'a Log) -> Result<Vec<Columns<'a>>, EnsembleError> {
        let mut all = Vec::new();
        for joint in log.joints() {
            let (Some(torque), Some(q), Some(q_cmd)) = (log.tau_measured(joint), log.q(joint), log.q_cmd(joint)) else {
                continue;
            };
            let gains = |row| [log.kp(joint, row).unwrap_or(f64::NAN), log.kd(joint, row).unwrap_or(f64::NAN)];
            let index = self.joints.iter().position(|known| known == joint).unwrap_or_else(|| {
                self.joints.push(joint.clone());
                self.joints.len() - 1
            });
            let asked = match self.input {
                NetworkInput::Torque => {
                    Some(AskedTorque { gains: (0..log.rows()).map(gains).collect(), tau_ff: log.tau_ff(joint) })
                }
                NetworkInput::Errors => {
                    self.check_gains(name, log, joint, index)?;
                    None
                }
            };
            let (dq, dq_cmd) = (log.dq(joint), log.dq_cmd(joint));
            all.push(Columns { joint: index, q, q_cmd, dq, dq_cmd, torque, asked });
        }
        if all.is_empty() { Err(EnsembleError::NoTorque { log: name.to_owned() }) } else { Ok(all) }
    }

    /// Checks that a joint has the gains of its first row in every row, and no feed-forward torque.
    fn check_gains(&mut self, name: &str, log: &Log, joint: &str, index: usize) -> Result<(), EnsembleError> {
        let (name, joint_name) = (name.to_owned(), joint.to_owned());
        if let Some(row) = log.tau_ff(joint).and_then(|torque| torque.iter().position(|torque| *torque != 0.0)) {
            return Err(EnsembleError::FeedForward { log: name, joint: joint_name, row });
        }
        let gains = |row| [log.kp(joint, row).unwrap_or(f64::NAN), log.kd(joint, row).unwrap_or(f64::NAN)];
        if self.gains.len() == index {
            self.gains.push(gains(0));
        }
        match (0..log.rows()).find(|row| gains(*row) != self.gains[index]) {
            Some(row) => {
                let [kp, kd] = gains(row);
                Err(EnsembleError::GainsChange { log: name, joint: joint_name, row, kp, kd })
            }
            None => Ok(()),
        }
    }

    /// Adds the sequences of a block.
    fn add(&mut self, log: &Log, columns: &[Columns], block: &Range<usize>, place: BlockContext) {
        let role = match place.number % CYCLE {
            4 => Split::Validation,
            9 => Split::Test,
            _ => Split::Training,
        };
        let follows = |row: usize| ((log.t()[row] - log.t()[row - 1]) / self.dt - 1.0).abs() <= JITTER;
        for column in columns {
            let error = |row| column.error(row, block, self.dt);
            let usable = |row| {
                let input = column.input(error(row), row);
                error(row).iter().chain(&input).chain([&column.torque[row]]).all(|cell| cell.is_finite())
            };
            for rows in contiguous_ranges(block.clone().filter(|row| usable(*row)), follows) {
                let starts_part = place.starts_part && rows.start == block.start;
                let mut run = Sequence {
                    log: place.log,
                    joint: column.joint,
                    after_reset: starts_part,
                    inputs: rows.clone().map(error).collect(),
                    torques: column.torque[rows.clone()].to_vec(),
                };
                if let Some(hz) = place.hz.filter(|_| role == Split::Training) {
                    column.smooth(&mut run, rows.clone(), hz, self.dt);
                }
                run.inputs.iter_mut().zip(rows).for_each(|(input, row)| *input = column.input(*input, row));
                self.runs.push((role, run));
            }
        }
    }
}

/// Context of a block.
#[derive(Clone, Copy)]
struct BlockContext {
    /// Index of the log.
    log: usize,
    /// True if the block is the first of a log segment.
    starts_part: bool,
    /// Index among the blocks of all logs.
    number: usize,
    /// Frequency of smoothing in the training split [Hz]; `None` without smoothing.
    hz: Option<f64>,
}

/// Channels of a joint.
struct Columns<'a> {
    joint: usize,
    q: &'a [f64],
    q_cmd: &'a [f64],
    dq: Option<&'a [f64]>,
    dq_cmd: Option<&'a [f64]>,
    torque: &'a [f64],
    /// What the torque that was asked for consists of, if it is the input of the networks.
    asked: Option<AskedTorque<'a>>,
}

/// Gains and feed-forward torque of a joint, by row.
struct AskedTorque<'a> {
    gains: Vec<[f64; 2]>,
    tau_ff: Option<&'a [f64]>,
}

impl Columns<'_> {
    /// Returns the input of the networks in `row`, given ξ.
    fn input(&self, [q_error, dq_error]: [f64; 2], row: usize) -> [f64; 2] {
        let Some(AskedTorque { gains, tau_ff }) = &self.asked else { return [q_error, dq_error] };
        let [kp, kd] = gains[row];
        let tau_ff = tau_ff.map_or(0.0, |tau_ff| tau_ff[row]);
        [kp * q_error + kd * dq_error + tau_ff, self.dq_cmd.map_or(0.0, |dq_cmd| dq_cmd[row]) - dq_error]
    }

    /// Returns ξ at `row`. A missing velocity is the difference of positions within `block`.
    fn error(&self, row: usize, block: &Range<usize>, dt: f64) -> [f64; 2] {
        let dq = self.dq.map_or_else(
            || {
                let (before, after) = (row.saturating_sub(1).max(block.start), (row + 1).min(block.end - 1));
                (self.q[after] - self.q[before]) / ((after - before) as f64 * dt)
            },
            |dq| dq[row],
        );
        [self.q_cmd[row] - self.q[row], self.dq_cmd.map_or(0.0, |dq_cmd| dq_cmd[row]) - dq]
    }
}

impl Columns<'_> {
    /// Smooths the measured channels of a sequence. Commands do not change.
    fn smooth(&self, run: &mut Sequence, rows: Range<usize>, hz: f64, dt: f64) {
        for channel in 0..2 {
            let command = |row: usize| [Some(self.q_cmd), self.dq_cmd][channel].map_or(0.0, |cells| cells[row]);
            let state = |(error, row): (&[f64; 2], usize)| command(row) - error[channel];
            let states: Vec<f64> = run.inputs.iter().zip(rows.clone()).map(state).collect();
            for ((error, state), row) in run.inputs.iter_mut().zip(smoothed(&states, hz, dt)).zip(rows.clone()) {
                error[channel] = command(row) - state;
            }
        }
        run.torques = smoothed(&run.torques, hz, dt);
    }
}

/// Returns the ranges of consecutive `rows`, in each of which every row `follows` the previous one.
fn contiguous_ranges(rows: impl Iterator<Item = usize>, follows: impl Fn(usize) -> bool) -> Vec<Range<usize>> {
    let mut found: Vec<Range<usize>> = Vec::new();
    for row in rows {
        match found.last_mut() {
            Some(last) if last.end == row && follows(row) => last.end += 1,
            _ => found.push(row..row + 1),
        }
    }
    found
}

#[cfg(test)]
pub mod tests {
    use twinstep_logs::{Gain, Meta, Segment};
    use twinstep_model::BaseMount;
    use twinstep_model::{standard_normal, stream};

    use super::*;

    /// Standard deviation of the torque noise in [`log`] [N·m].
    pub const NOISE: f64 = 0.1;

    /// Returns ξ in a row of [`log`].
    fn error(row: usize) -> [f64; 2] {
        let time = row as f64 * 0.005;
        [0.1 * (7.0 * time).sin() + 0.05 * (23.0 * time).sin(), 0.3 * (11.0 * time).cos()]
    }

    /// Returns the log of one joint in sinusoidal motion, whose actuator has a delay of one row.
    pub fn log(rows: usize, change: impl Fn(&mut Meta, &mut Vec<(String, Vec<f64>)>)) -> Log {
        let mut random = stream(3, "noise", 0);
        let torque = |row: usize| {
            let [dq, ddq] = error(row.saturating_sub(1));
            20.0 * dq + 0.5 * ddq
        };
        let mut columns: Vec<(String, Vec<f64>)> = vec![
            ("t".to_owned(), (0..rows).map(|row| row as f64 * 0.005).collect()),
            ("q_knee".to_owned(), (0..rows).map(|row| -error(row)[0]).collect()),
            ("dq_knee".to_owned(), (0..rows).map(|row| -error(row)[1]).collect()),
            ("q_cmd_knee".to_owned(), vec![0.0; rows]),
            (
                "tau_measured_knee".to_owned(),
                (0..rows).map(|row| torque(row) + NOISE * standard_normal(&mut random)).collect(),
            ),
        ];
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let mut meta = Meta::new(200.0, TorqueSensor::MotorCurrent, segments);
        (meta.kp, meta.kd) = (Some(Gain::Uniform(20.0)), Some(Gain::Uniform(0.5)));
        change(&mut meta, &mut columns);
        Log::new(meta, columns).expect("a log")
    }

    type Change = dyn Fn(&mut Meta, &mut Vec<(String, Vec<f64>)>);

    /// Returns a channel that is `at` in row 7 and zero elsewhere.
    fn column(name: &str, at: f64) -> (String, Vec<f64>) {
        (name.to_owned(), (0..2000).map(|row| if row == 7 { at } else { 0.0 }).collect())
    }

    fn set(log: Log) -> Result<DataSet, EnsembleError> {
        DataSet::new(&[("here".to_owned(), log)])
    }

    fn smoothed_set(log: Log, hz: f64) -> Result<DataSet, EnsembleError> {
        let options = DataOptions { smooth_hz: Some(hz), ..DataOptions::default() };
        DataSet::with_options(&[("here".to_owned(), log)], options)
    }

    fn torque_set(log: Log) -> Result<DataSet, EnsembleError> {
        let options = DataOptions { input: NetworkInput::Torque, ..DataOptions::default() };
        DataSet::with_options(&[("here".to_owned(), log)], options)
    }

    #[test]
    fn asked_torque_and_velocity_are_the_input_for_all_gains() {
        let set = torque_set(log(2000, |meta, columns| {
            meta.kp = None;
            columns.push(("kp".to_owned(), (0..2000).map(|row| if row < 1000 { 20.0 } else { 40.0 }).collect()));
            columns.push(("tau_ff_knee".to_owned(), vec![1.5; 2000]));
        }))
        .expect("a set");
        let run = set.runs(Split::Training).last().expect("a sequence");
        let (errors, torque) = (error(1890), run.inputs[90][0]);
        assert!((torque - (40.0 * errors[0] + 0.5 * errors[1] + 1.5)).abs() < 1e-9, "{torque}");
        assert_eq!(run.inputs[90][1], -errors[1], "the velocity of the joint");
        assert!(set.gains.is_empty());
    }

    fn rows(set: &DataSet, block: Split) -> usize {
        set.runs(block).map(|run| run.torques.len()).sum()
    }

    #[test]
    fn a_tenth_of_the_rows_is_for_validation_and_a_tenth_for_test() {
        let set = set(log(4000, |_, _| {})).expect("a set");
        assert_eq!([Split::Training, Split::Validation, Split::Test].map(|block| rows(&set, block)), [3200, 400, 400]);
        assert_eq!(set.runs(Split::Training).filter(|run| run.after_reset).count(), 1);
    }

    #[test]
    fn gaps_and_missing_cells_separate_sequences() {
        let whole = set(log(2000, |_, _| {})).expect("a set");
        let holed = set(log(2000, |_, columns| {
            columns[4].1[10] = f64::NAN;
            columns[0].1[30..].iter_mut().for_each(|t| *t += 0.1);
        }))
        .expect("a set");
        let lengths =
            |set: &DataSet| set.runs(Split::Training).map(|run| run.torques.len()).take(3).collect::<Vec<_>>();
        assert_eq!(lengths(&whole)[0], 100);
        assert_eq!(lengths(&holed), [10, 19, 70]);
        assert_ne!(whole.hash(), holed.hash());
    }

    #[test]
    fn missing_velocity_is_the_derivative_of_position() {
        let with = set(log(2000, |_, _| {})).expect("a set");
        let without = set(log(2000, |_, columns| {
            columns.remove(2);
            // The integral of the removed velocity.
            columns[1].1 = (0..2000).map(|row| -0.3 / 11.0 * (11.0 * row as f64 * 0.005).sin()).collect();
        }))
        .expect("a set");
        let [one, other] = [&with, &without].map(|set| set.runs(Split::Training).next().expect("a run").clone());
        for row in 1..99 {
            assert!((one.inputs[row][1] - other.inputs[row][1]).abs() < 2e-4, "row {row}");
        }
    }

    #[test]
    fn only_measured_channels_of_the_training_split_are_smoothed() {
        let stepping = || {
            log(4000, |_, columns| {
                columns[3].1 = (0..4000).map(|row| if row < 10 { 0.0 } else { 0.3 }).collect();
            })
        };
        let raw = set(stepping()).expect("a set");
        let smooth = smoothed_set(stepping(), 20.0).expect("a set");
        for block in [Split::Validation, Split::Test] {
            assert!(raw.runs(block).eq(smooth.runs(block)));
        }
        let noise = |set: &DataSet| {
            let run = set.runs(Split::Training).nth(1).expect("a run").clone();
            let second = run.torques.windows(3).map(|rows| (rows[0] - 2.0 * rows[1] + rows[2]).powi(2));
            second.sum::<f64>().sqrt()
        };
        assert!(noise(&smooth) < 0.2 * noise(&raw), "{} of {}", noise(&smooth), noise(&raw));
        let step = |set: &DataSet| {
            let run = set.runs(Split::Training).next().expect("a run").clone();
            run.inputs[10][0] - run.inputs[9][0]
        };
        assert!((step(&smooth) - step(&raw)).abs() < 0.01, "{} of {}", step(&smooth), step(&raw));
        let error = smoothed_set(stepping(), 120.0).expect_err("too high");
        assert!(error.to_string().contains("120"), "{error}");
    }

    #[test]
    fn logs_without_the_required_channels_are_rejected() {
        let error = |change: &Change| set(log(2000, change)).expect_err("rejected").to_string();
        assert!(error(&|_, columns| columns.push(column("tau_ff_knee", 2.0))).contains("`tau_ff_knee` at row 7"));
        assert!(error(&|_, columns| columns.push(column("kp", 5.0))).contains("kp 5, kd 0.5 at row 7"));
        assert!(error(&|meta, _| meta.tau_sensor = TorqueSensor::None).contains("no measured torque"));
        assert!(error(&|_, columns| columns.iter_mut().for_each(|(_, cells)| cells.truncate(400))).contains("too few"));
        let slow = log(2000, |meta, _| meta.rate_hz = 100.0);
        let logs = [("one".to_owned(), log(2000, |_, _| {})), ("two".to_owned(), slow)];
        let error = DataSet::new(&logs).expect_err("rejected").to_string();
        assert!(error.starts_with("two has a time step of 0.01 s, the model one of 0.005 s"), "{error}");
    }
}
