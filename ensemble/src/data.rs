//! Measured logs as what networks learn from.

use std::ops::Range;

use sha2::{Digest, Sha256};
use twinstep_logs::{Log, TorqueSensor};

use crate::EnsembleError;
use crate::smooth::smoothed;

/// Longest block [s]: long beside a drive's memory, short beside a motion.
const LONGEST_BLOCK_S: f64 = 2.0;
/// Shortest block [rows].
const SHORTEST_BLOCK: usize = 60;
/// Of this many blocks that follow one another, one is to stop by and one to judge by.
const CYCLE: usize = 10;
/// A step that differs from the log's rate by more than this share is a gap.
const JITTER: f64 = 0.25;

/// What the rows of a block are for. Blocks are whole stretches of time, the same for all joints, because neighbouring rows
/// know each other's noise and each other's motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// To learn from: eight of ten.
    Training,
    /// To stop by, and to scale variances by: one of ten.
    Validation,
    /// To judge by: one of ten.
    Test,
}

/// Rows of one joint that follow one another without a gap, within one block.
#[derive(Clone, Debug, PartialEq)]
pub struct Sequence {
    /// Index into [`DataSet::joints`].
    pub joint: usize,
    /// Whether the drive was put down anew just before: no row of it has an unseen past.
    pub after_reset: bool,
    /// ξ = [q_cmd − q, dq_cmd − dq] of each row [rad, rad/s].
    pub errors: Vec<[f64; 2]>,
    /// Measured torque of each row, its mean to the next row [N·m].
    pub torques: Vec<f64>,
}

/// Runs of rows with what they have in common.
///
/// Channels are taken as measured. U2E §IV-B smooths them by a cubic spline first, which no drive in a simulator could do
/// with what is yet to come: that is an option, for what is learnt from alone. Where a log has no velocity, it is the central
/// difference of position over two rows, which looks one row ahead too.
#[derive(Clone, Debug)]
pub struct DataSet {
    /// Time from a row to the next [s].
    pub dt: f64,
    /// Joints with measured torque.
    pub joints: Vec<String>,
    /// Where torque was measured.
    pub tau_sensor: TorqueSensor,
    /// kp [N·m/rad] and kd [N·m·s/rad] of each joint.
    pub gains: Vec<[f64; 2]>,
    runs: Vec<(Split, Sequence)>,
}

impl DataSet {
    /// The runs of `logs`, each with the name that errors give it.
    pub fn new(logs: &[(String, Log)]) -> Result<Self, EnsembleError> {
        Self::smoothed(logs, None)
    }

    /// As [`DataSet::new`], with position, velocity and torque of what is learnt from smoothed, stretch by stretch: waves of
    /// this frequency \[Hz] have half their amplitude.
    pub fn smoothed(logs: &[(String, Log)], hz: Option<f64>) -> Result<Self, EnsembleError> {
        let (first, first_log) = logs.first().ok_or(EnsembleError::TooShort { rows: 0, blocks: 0 })?;
        let tau_sensor = first_log.meta().tau_sensor;
        if tau_sensor == TorqueSensor::None {
            return Err(EnsembleError::NoTorque { log: first.clone() });
        }
        let dt = 1.0 / first_log.meta().rate_hz;
        if let Some(given) = hz.filter(|hz| !(*hz > 0.0 && *hz < 0.5 / dt)) {
            return Err(EnsembleError::Smoothing { given, most: 0.5 / dt });
        }
        let mut set = Self { dt, joints: Vec::new(), tau_sensor, gains: Vec::new(), runs: Vec::new() };
        let rows: usize = logs.iter().map(|(_, log)| log.rows()).sum();
        let longest = ((LONGEST_BLOCK_S / dt) as usize).max(SHORTEST_BLOCK);
        let block_rows = (rows / (2 * CYCLE)).clamp(SHORTEST_BLOCK, longest);
        let mut blocks = 0;
        for (name, log) in logs {
            set.check(name, log)?;
            let columns = set.columns(name, log)?;
            for (_, part) in log.segments() {
                for start in part.clone().step_by(block_rows) {
                    let block = start..part.end.min(start + block_rows);
                    set.add(log, &columns, &block, BlockContext { starts_part: start == part.start, number: blocks, hz });
                    blocks += 1;
                }
            }
        }
        let has = |wanted| set.runs.iter().any(|(block, _)| *block == wanted);
        if [Split::Training, Split::Validation, Split::Test].into_iter().all(has) {
            return Ok(set);
        }
        Err(EnsembleError::TooShort { rows: set.runs.iter().map(|(_, run)| run.torques.len()).sum(), blocks })
    }

    /// The runs of one role, in the order of logs, time and joints.
    pub fn runs(&self, wanted: Split) -> impl Iterator<Item = &Sequence> + Clone {
        self.runs.iter().filter(move |(block, _)| *block == wanted).map(|(_, run)| run)
    }

    /// A fingerprint of all of it, in hexadecimal.
    pub fn hash(&self) -> String {
        let mut hash = Sha256::new();
        hash.update(self.dt.to_le_bytes());
        hash.update(self.joints.join("\n"));
        for (block, run) in &self.runs {
            hash.update([*block as u8, run.after_reset as u8, run.joint as u8]);
            for number in run.errors.iter().flatten().chain(&run.torques) {
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
            return Err(EnsembleError::TimeStepMismatch { what: name.to_owned(), given, wanted: self.dt });
        }
        if log.meta().tau_sensor != self.tau_sensor {
            return Err(EnsembleError::SensorMismatch { log: name.to_owned() });
        }
        Ok(())
    }

    /// The channels of each joint with torque, which becomes a joint of the set if it is none yet.
    fn columns<'a>(&mut self, name: &str, log: &'a Log) -> Result<Vec<Columns<'a>>, EnsembleError> {
        let mut all = Vec::new();
        for joint in log.joints() {
            let (Some(torque), Some(q), Some(q_cmd)) = (log.tau_measured(joint), log.q(joint), log.q_cmd(joint)) else {
                continue;
            };
            if let Some(row) = log.tau_ff(joint).and_then(|torque| torque.iter().position(|torque| *torque != 0.0)) {
                return Err(EnsembleError::FeedForward { log: name.to_owned(), joint: joint.clone(), row });
            }
            let gains = |row| [log.kp(joint, row).unwrap_or(f64::NAN), log.kd(joint, row).unwrap_or(f64::NAN)];
            let index = self.joints.iter().position(|known| known == joint).unwrap_or_else(|| {
                self.joints.push(joint.clone());
                self.gains.push(gains(0));
                self.joints.len() - 1
            });
            if let Some(row) = (0..log.rows()).find(|row| gains(*row) != self.gains[index]) {
                let [kp, kd] = gains(row);
                return Err(EnsembleError::GainsChange { log: name.to_owned(), joint: joint.clone(), row, kp, kd });
            }
            all.push(Columns { joint: index, q, q_cmd, dq: log.dq(joint), dq_cmd: log.dq_cmd(joint), torque });
        }
        if all.is_empty() { Err(EnsembleError::NoTorque { log: name.to_owned() }) } else { Ok(all) }
    }

    /// Adds the runs of a block.
    fn add(&mut self, log: &Log, columns: &[Columns], block: &Range<usize>, place: BlockContext) {
        let role = match place.number % CYCLE {
            4 => Split::Validation,
            9 => Split::Test,
            _ => Split::Training,
        };
        let follows = |row: usize| ((log.t()[row] - log.t()[row - 1]) / self.dt - 1.0).abs() <= JITTER;
        for column in columns {
            let error = |row| column.error(row, block, self.dt);
            let usable = |row| error(row).iter().chain([&column.torque[row]]).all(|cell| cell.is_finite());
            for rows in contiguous_ranges(block.clone().filter(|row| usable(*row)), follows) {
                let starts_part = place.starts_part && rows.start == block.start;
                let mut run = Sequence {
                    joint: column.joint,
                    after_reset: starts_part,
                    errors: rows.clone().map(error).collect(),
                    torques: column.torque[rows.clone()].to_vec(),
                };
                if let Some(hz) = place.hz.filter(|_| role == Split::Training) {
                    column.smooth(&mut run, rows, hz, self.dt);
                }
                self.runs.push((role, run));
            }
        }
    }
}

/// Where a block stands.
#[derive(Clone, Copy)]
struct BlockContext {
    /// Whether it begins a part of a log.
    starts_part: bool,
    /// Among the blocks of all logs.
    number: usize,
    /// To what it is smoothed, if it is learnt from [Hz].
    hz: Option<f64>,
}

/// The channels of a joint.
struct Columns<'a> {
    joint: usize,
    q: &'a [f64],
    q_cmd: &'a [f64],
    dq: Option<&'a [f64]>,
    dq_cmd: Option<&'a [f64]>,
    torque: &'a [f64],
}

impl Columns<'_> {
    /// ξ at `row`; a velocity that was not measured is a difference of positions within `block`.
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
    /// Smooths what was measured of a run; commands stay as sharp as they were.
    fn smooth(&self, run: &mut Sequence, rows: Range<usize>, hz: f64, dt: f64) {
        for channel in 0..2 {
            let command = |row: usize| [Some(self.q_cmd), self.dq_cmd][channel].map_or(0.0, |cells| cells[row]);
            let state = |(error, row): (&[f64; 2], usize)| command(row) - error[channel];
            let states: Vec<f64> = run.errors.iter().zip(rows.clone()).map(state).collect();
            for ((error, state), row) in run.errors.iter_mut().zip(smoothed(&states, hz, dt)).zip(rows.clone()) {
                error[channel] = command(row) - state;
            }
        }
        run.torques = smoothed(&run.torques, hz, dt);
    }
}

/// Ranges of `rows` that come one after another, each of which `follows` the one before it.
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
    use twinstep_logs::{BaseMount, Gain, Meta, Segment};
    use twinstep_model::{standard_normal, stream};

    use super::*;

    /// Torque's noise in [`log`] [N·m].
    pub const NOISE: f64 = 0.1;

    /// One joint in waves, whose drive acts one row late.
    pub fn log(rows: usize, change: impl Fn(&mut Meta, &mut Vec<(String, Vec<f64>)>)) -> Log {
        let mut random = stream(3, "noise", 0);
        let error = |row: usize| {
            let time = row as f64 * 0.005;
            [0.1 * (7.0 * time).sin() + 0.05 * (23.0 * time).sin(), 0.3 * (11.0 * time).cos()]
        };
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

    /// A channel that is `at` in row 7, and zero else.
    fn column(name: &str, at: f64) -> (String, Vec<f64>) {
        (name.to_owned(), (0..2000).map(|row| if row == 7 { at } else { 0.0 }).collect())
    }

    fn set(log: Log) -> Result<DataSet, EnsembleError> {
        DataSet::new(&[("here".to_owned(), log)])
    }

    fn rows(set: &DataSet, block: Split) -> usize {
        set.runs(block).map(|run| run.torques.len()).sum()
    }

    #[test]
    fn every_row_is_in_one_block_and_a_tenth_each_stops_and_judges() {
        let set = set(log(4000, |_, _| {})).expect("a set");
        assert_eq!([Split::Training, Split::Validation, Split::Test].map(|block| rows(&set, block)), [3200, 400, 400]);
        assert_eq!(set.runs(Split::Training).filter(|run| run.after_reset).count(), 1);
    }

    #[test]
    fn gaps_and_missing_cells_part_runs() {
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
    fn velocity_that_was_not_measured_is_the_slope_of_position() {
        let with = set(log(2000, |_, _| {})).expect("a set");
        let without = set(log(2000, |_, columns| {
            columns.remove(2);
            // The position whose slope the velocity was.
            columns[1].1 = (0..2000).map(|row| -0.3 / 11.0 * (11.0 * row as f64 * 0.005).sin()).collect();
        }))
        .expect("a set");
        let [one, other] = [&with, &without].map(|set| set.runs(Split::Training).next().expect("a run").clone());
        for row in 1..99 {
            assert!((one.errors[row][1] - other.errors[row][1]).abs() < 2e-4, "row {row}");
        }
    }

    #[test]
    fn only_what_is_learnt_from_is_smoothed_and_commands_are_not() {
        let stepping = || {
            log(4000, |_, columns| {
                columns[3].1 = (0..4000).map(|row| if row < 10 { 0.0 } else { 0.3 }).collect();
            })
        };
        let raw = set(stepping()).expect("a set");
        let smooth = DataSet::smoothed(&[("here".to_owned(), stepping())], Some(20.0)).expect("a set");
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
            run.errors[10][0] - run.errors[9][0]
        };
        assert!((step(&smooth) - step(&raw)).abs() < 0.01, "{} of {}", step(&smooth), step(&raw));
        let refused = DataSet::smoothed(&[("here".to_owned(), stepping())], Some(120.0)).expect_err("too fast");
        assert!(refused.to_string().contains("120"), "{refused}");
    }

    #[test]
    fn what_a_network_could_not_know_is_refused() {
        let refused = |change: &Change| set(log(2000, change)).expect_err("refused").to_string();
        assert!(refused(&|_, columns| columns.push(column("tau_ff_knee", 2.0))).contains("`tau_ff_knee` at row 7"));
        assert!(refused(&|_, columns| columns.push(column("kp", 5.0))).contains("kp 5, kd 0.5 at row 7"));
        assert!(refused(&|meta, _| meta.tau_sensor = TorqueSensor::None).contains("no measured torque"));
        assert!(
            refused(&|_, columns| columns.iter_mut().for_each(|(_, cells)| cells.truncate(400))).contains("too few")
        );
        let slow = log(2000, |meta, _| meta.rate_hz = 100.0);
        let logs = [("one".to_owned(), log(2000, |_, _| {})), ("two".to_owned(), slow)];
        let error = DataSet::new(&logs).expect_err("refused").to_string();
        assert!(error.starts_with("two has a step of 0.01 s, the model one of 0.005 s"), "{error}");
    }
}
