//! The joint columns of a log at a lower rate.

use std::collections::BTreeMap;
use std::ops::Range;

use crate::columns::{Column, ColumnOwner};
use crate::{Log, TorqueSensor};

/// Length of a time step, divided by the log's period, above which it is a gap.
const GAP: f64 = 1.5;

/// The rate is not possible.
#[derive(Debug, thiserror::Error)]
#[error("{hz} Hz is not possible: the log has {rate_hz} Hz; use a rate above 0 and at most that")]
pub struct ResampleError {
    /// The rate [Hz].
    pub hz: f64,
    /// The rate of the log [Hz].
    pub rate_hz: f64,
}

impl Log {
    /// Returns the columns of the joints at `hz` [Hz], not above the log's rate. Columns of the base are left out.
    ///
    /// Positions and velocities are interpolated linearly. Commands are those in force. Torque is the mean until the next
    /// new row. Nothing is interpolated over a gap.
    pub fn resampled(&self, hz: f64) -> Result<Log, ResampleError> {
        let rate_hz = self.meta.rate_hz;
        if !(hz > 0.0 && hz <= rate_hz) {
            return Err(ResampleError { hz, rate_hz });
        }
        let mut samples = Vec::new();
        for (_, rows) in self.segments() {
            self.add_samples(rows, 1.0 / hz, &mut samples);
        }
        let mut log = self.clone();
        log.meta.rate_hz = hz;
        log.t = samples.iter().map(|sample| sample.t).collect();
        log.segment = samples.iter().map(|sample| self.segment[sample.row]).collect();
        log.episode = samples.iter().map(|sample| self.episode[sample.row]).collect();
        log.channels = BTreeMap::new();
        for (name, cells) in &self.channels {
            let Some(column) = Column::parse(name) else { continue };
            if !matches!(column.quantity.of, ColumnOwner::Joint | ColumnOwner::RobotOrJoint) {
                continue;
            }
            let value = |sample: &Sample| match column.quantity.name {
                "q" | "dq" | "temp" => sample.interpolated(&self.t, cells),
                "tau_measured" => sample.mean(&self.t, cells),
                _ => cells[sample.row],
            };
            log.channels.insert(name.clone(), samples.iter().map(value).collect());
        }
        Ok(log)
    }

    /// Returns this log with other measured torques at `sensor`, by joint [N·m]. Joints without an entry have none.
    pub fn with_torques(&self, sensor: TorqueSensor, torques: &[(String, Vec<f64>)]) -> Log {
        let mut log = self.clone();
        log.meta.tau_sensor = sensor;
        log.channels.retain(|name, _| !name.starts_with("tau_measured_"));
        log.channels.extend(torques.iter().map(|(joint, cells)| (format!("tau_measured_{joint}"), cells.clone())));
        log
    }

    /// Adds the samples of a contiguous range of rows, every `dt` [s].
    fn add_samples(&self, rows: Range<usize>, dt: f64, samples: &mut Vec<Sample>) {
        let (start, end) = (self.t[rows.start], self.t[rows.end - 1]);
        let longest = GAP / self.meta.rate_hz;
        let mut row = rows.start;
        for index in 0.. {
            // A rounding error must not lose the last row.
            let t = start + f64::from(index) * dt;
            if t > end + 1e-9 {
                return;
            }
            while row + 1 < rows.end && self.t[row + 1] <= t + 1e-9 {
                row += 1;
            }
            let last = (row..rows.end - 1).find(|row| self.t[row + 1] >= t + dt - 1e-9).unwrap_or(rows.end - 1);
            let is_gap = |row: usize| row + 1 < rows.end && self.t[row + 1] - self.t[row] > longest;
            let is_between_rows = t > self.t[row] + 1e-9;
            let has_gap = (row..last).any(is_gap) || (is_between_rows && is_gap(row));
            if !has_gap {
                samples.push(Sample { t, dt, row, last, next: (row + 1).min(rows.end - 1) });
            }
        }
    }
}

/// A new row.
struct Sample {
    t: f64,
    dt: f64,
    /// Last row at or before `t`.
    row: usize,
    /// Last row before the next sample.
    last: usize,
    /// The row after `row`, if there is one in the range.
    next: usize,
}

impl Sample {
    /// Returns the value at `t`.
    fn interpolated(&self, t: &[f64], cells: &[f64]) -> f64 {
        let span = t[self.next] - t[self.row];
        let share = if span > 0.0 { (self.t - t[self.row]) / span } else { 0.0 };
        if share <= 1e-9 { cells[self.row] } else { cells[self.row] + share * (cells[self.next] - cells[self.row]) }
    }

    /// Returns the mean from `t` to the next sample. Each row holds until the next.
    fn mean(&self, t: &[f64], cells: &[f64]) -> f64 {
        let (mut sum, mut time) = (0.0, 0.0);
        for row in self.row..=self.last {
            let from = t[row].max(self.t);
            let until = if row < self.last { t[row + 1] } else { self.t + self.dt };
            let held = (until - from).max(0.0);
            sum += held * cells[row];
            time += held;
        }
        sum / time
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::BaseMount;

    use super::*;
    use crate::{Gain, Meta, Segment};

    /// Returns a log of one joint that turns with 2 rad/s, with a torque that is its row's number.
    fn log(rate_hz: f64, t: impl Fn(usize) -> f64) -> Log {
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let mut meta = Meta::new(rate_hz, TorqueSensor::MotorCurrent, segments);
        (meta.kp, meta.kd) = (Some(Gain::Uniform(20.0)), Some(Gain::Uniform(0.5)));
        let of = |value: &dyn Fn(usize) -> f64| (0..100).map(value).collect::<Vec<_>>();
        let columns = [
            ("t".to_owned(), of(&t)),
            ("q_knee".to_owned(), of(&|row| 2.0 * t(row))),
            ("q_cmd_knee".to_owned(), of(&|row| row as f64)),
            ("tau_measured_knee".to_owned(), of(&|row| row as f64)),
            ("gyro_x".to_owned(), of(&|_| 0.0)),
        ];
        Log::new(meta, columns).expect("a log")
    }

    #[test]
    fn positions_are_interpolated_commands_held_and_torques_averaged() {
        let slow = log(500.0, |row| 0.002 * row as f64).resampled(200.0).expect("a log");
        assert_eq!(slow.meta().rate_hz, 200.0);
        assert!(slow.channel("gyro_x").is_none());
        for row in 0..slow.rows() - 1 {
            let t = 0.005 * row as f64;
            assert!((slow.t()[row] - t).abs() < 1e-9);
            assert!((slow.q("knee").expect("q")[row] - 2.0 * t).abs() < 1e-9);
            let earlier = (2.5 * row as f64 + 1e-6).floor();
            assert_eq!(slow.q_cmd("knee").expect("q_cmd")[row], earlier);
            // 2.5 rows: the mean of a staircase.
            let staircase =
                |from: f64| (0..50).map(|step| (from + (f64::from(step) + 0.5) / 20.0).floor()).sum::<f64>();
            let mean = slow.tau_measured("knee").expect("torque")[row];
            assert!((mean - staircase(2.5 * row as f64) / 50.0).abs() < 1e-9, "row {row}: {mean}");
        }
    }

    #[test]
    fn gaps_stay_and_the_own_rate_changes_nothing() {
        let own = log(200.0, |row| 0.005 * row as f64);
        let same = own.resampled(200.0).expect("a log");
        let near = |one: &[f64], other: &[f64]| one.iter().zip(other).all(|(one, other)| (one - other).abs() < 1e-9);
        assert_eq!(same.rows(), own.rows());
        assert!(near(same.q("knee").expect("q"), own.q("knee").expect("q")));
        assert!(near(same.tau_measured("knee").expect("q"), own.tau_measured("knee").expect("q")));
        let gap =
            log(500.0, |row| 0.002 * row as f64 + if row < 50 { 0.0 } else { 0.3 }).resampled(100.0).expect("a log");
        assert!(gap.t().iter().all(|t| *t < 0.1 || *t > 0.39), "{:?}", gap.t());
        assert!(own.resampled(400.0).is_err() && own.resampled(0.0).is_err() && own.resampled(f64::NAN).is_err());
    }
}
