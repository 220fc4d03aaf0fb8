//! Rows in which the sensors repeat: a source that is slower than the recorder.
//!
//! A joint that moves never has the same position twice, but for the step of its encoder. Where all positions repeat although the
//! robot moves, a row has no new measurement. Taken as one, it looks like a delay.

use std::ops::Range;

use thiserror::Error;
use twinstep_effects::{DataRequirement, Effect};
use twinstep_model::Joint;

use crate::statistics::{quantile, quantum};
use crate::{Log, Meta};

/// Rows on each side within which the robot must move.
const AROUND: usize = 25;
/// Smallest share of the rows in motion that must repeat.
const MIN_SHARE: f64 = 0.05;
/// Number of steps of an encoder that a slow joint does not turn from one row to the next.
const MIN_STEPS: f64 = 3.0;

/// Fewest measurements in a period of the motion, on average over its frequencies. Between fewer, accelerations and torques change so much
/// that neither an integral over the time between two measurements nor a simulation with mean commands is right.
const MIN_PER_PERIOD: f64 = 12.0;

/// Sensors that were read too slowly for the motion.
#[derive(Clone, Debug, PartialEq, Error)]
#[error(
    "the sensors were measured at {rate_hz:.1} Hz, {per_period:.1} times in a period of the motion of {joint}; below {MIN_PER_PERIOD} times \
     the forces between two measurements are unknown: record the sensors at their own rate, or move more slowly"
)]
pub struct TooSlowForMotion {
    /// Joint that moves most.
    pub joint: String,
    /// Rate of the measurements [Hz].
    pub rate_hz: f64,
    /// Measurements in a period of the motion.
    pub per_period: f64,
}

/// Rows without a new measurement.
#[derive(Clone, Debug, PartialEq)]
pub struct Repeats {
    /// For each row whether all positions are those of the row before.
    pub is_repeated: Vec<bool>,
    /// Share of the rows in motion.
    pub share: f64,
    /// Rate of the measurements [Hz].
    pub rate_hz: f64,
}

impl Log {
    /// Returns the rows in which the sensors repeat; `None` if every row is a measurement.
    pub fn repeats(&self) -> Option<Repeats> {
        let q: Vec<&[f64]> = self.joints().iter().filter_map(|joint| self.q(joint)).collect();
        let steps: Vec<Option<f64>> = q.iter().map(|cells| quantum(cells)).collect();
        let ranges: Vec<Range<usize>> = self.segments().map(|(_, rows)| rows).collect();
        let is_same = |cells: &[f64], row: usize| cells[row] == cells[row - 1];
        let (mut is_repeated, mut in_motion, mut jumps) = (vec![false; self.rows()], 0usize, Vec::new());
        for rows in &ranges {
            for row in rows.clone().skip(1) {
                let around = row.saturating_sub(AROUND).max(rows.start)..(row + AROUND).min(rows.end - 1);
                let moves = |(cells, step): (&&[f64], &Option<f64>)| {
                    let [first, here, last] = [around.start, row, around.end].map(|row| cells[row]);
                    (first - here).abs().max((last - here).abs()) > step.unwrap_or(0.0) * MIN_STEPS
                };
                if !q.iter().zip(&steps).any(moves) {
                    continue;
                }
                in_motion += 1;
                is_repeated[row] = q.iter().all(|cells| is_same(cells, row));
                if !is_repeated[row] && is_repeated[row - 1] {
                    jumps.extend(q.iter().zip(&steps).filter_map(|(cells, step)| {
                        let jump = (cells[row] - cells[row - 1]).abs();
                        step.map_or(Some(f64::INFINITY), |step| (jump > 0.5 * step).then_some(jump / step))
                    }));
                }
            }
        }
        let repeated = is_repeated.iter().filter(|repeated| **repeated).count();
        let share = repeated as f64 / in_motion.max(1) as f64;
        jumps.sort_by(f64::total_cmp);
        if share < MIN_SHARE || quantile(&jumps, 0.75).is_none_or(|jump| jump < MIN_STEPS) {
            return None;
        }
        let rate_hz = self.median_rate().unwrap_or(self.meta().rate_hz) * (1.0 - share);
        Some(Repeats { is_repeated, share, rate_hz })
    }

    /// Returns the log without the rows that repeat. Commands and torques of a row are the means until the next one.
    pub fn without_repeats(&self, repeats: &Repeats) -> Self {
        let kept: Vec<usize> = (0..self.rows()).filter(|row| !repeats.is_repeated[*row]).collect();
        let end = |index: usize| {
            let row = kept[index];
            let next = kept.get(index + 1).copied().unwrap_or(self.rows());
            // The mean ends with the contiguous range.
            let same =
                |other: &usize| self.segment[*other] == self.segment[row] && self.episode[*other] == self.episode[row];
            (row..next).take_while(same).last().map_or(row + 1, |last| last + 1)
        };
        let mean = |cells: &[f64], index: usize| {
            let part = &cells[kept[index]..end(index)];
            let known: Vec<f64> = part.iter().copied().filter(|cell| !cell.is_nan()).collect();
            if known.is_empty() { f64::NAN } else { known.iter().sum::<f64>() / known.len() as f64 }
        };
        // A torque that repeats, too, is known at two times, between which it has changed.
        let torque = |cells: &[f64], index: usize| {
            let (first, rows) = (kept[index], kept[index]..end(index));
            let next = kept
                .get(index + 1)
                .filter(|next| **next == rows.end && cells[rows.clone()].iter().all(|cell| *cell == cells[first]));
            next.map_or_else(|| mean(cells, index), |next| 0.5 * (cells[first] + cells[*next]))
        };
        let channels = self.channels.iter().map(|(name, cells)| {
            let is_torque = name.starts_with("tau_measured_");
            let is_mean = ["q_cmd_", "dq_cmd_", "tau_ff_"].iter().any(|start| name.starts_with(start));
            let value = |index: usize| match (is_torque, is_mean) {
                (true, _) => torque(cells, index),
                (_, true) => mean(cells, index),
                _ => cells[kept[index]],
            };
            (name.clone(), (0..kept.len()).map(value).collect())
        });
        let pick = |all: &[u32]| kept.iter().map(|row| all[*row]).collect::<Vec<_>>();
        let rate_hz = (10.0 * repeats.rate_hz).round() / 10.0;
        Self {
            meta: Meta { rate_hz, ..self.meta.clone() },
            t: kept.iter().map(|row| self.t[*row]).collect(),
            segment: pick(&self.segment),
            episode: pick(&self.episode),
            joints: self.joints.clone(),
            channels: channels.collect(),
            ignored: self.ignored.clone(),
            notes: self.notes.clone(),
            measured_hz: Some(rate_hz),
        }
    }

    /// Returns the rate of the measurements, if repeats were left out of the log [Hz].
    pub fn measured_hz(&self) -> Option<f64> {
        self.measured_hz
    }

    /// Fails if repeats were left out of the log, and its joints move too fast for the rate of the measurements that are left.
    pub fn check_measurements_per_period(&self) -> Result<(), TooSlowForMotion> {
        let Some(rate_hz) = self.measured_hz else { return Ok(()) };
        let differences = |of: &[f64]| of.windows(2).map(|pair| pair[1] - pair[0]).collect::<Vec<_>>();
        let power = |of: &[f64]| of.iter().map(|one| one * one).sum::<f64>();
        let power_of = |joint: usize| {
            let q = self.q(&self.joints()[joint])?;
            let parts = self.segments().map(|(_, rows)| {
                let steps = differences(&q[rows]);
                [power(&steps), power(&differences(&steps))]
            });
            let [first, second] = parts.fold([0.0; 2], |sum, part| [sum[0] + part[0], sum[1] + part[1]]);
            Some((joint, first, second))
        };
        let most = (0..self.joints().len()).filter_map(power_of).max_by(|a, b| a.1.total_cmp(&b.1));
        let Some((joint, first, second)) = most.filter(|(_, first, _)| *first > 0.0) else { return Ok(()) };
        // A step of a sine of n measurements in a period changes by 2 sin(π / n) of its size.
        let per_period = std::f64::consts::PI / (0.5 * (second / first).sqrt()).min(1.0).asin();
        if per_period >= MIN_PER_PERIOD {
            return Ok(());
        }
        Err(TooSlowForMotion { joint: self.joints()[joint].clone(), rate_hz, per_period })
    }

    /// Returns true if repeats were left out of the log, and the rate of its measurements is too low for an effect: a held reading
    /// looks like its delay or lag.
    pub fn is_too_slow_for(&self, effect: &Effect) -> bool {
        let needed = |need: &DataRequirement| if let DataRequirement::Rate(hz) = need { Some(*hz) } else { None };
        self.measured_hz.is_some_and(|rate| effect.needs.iter().filter_map(needed).any(|hz| rate < 0.98 * hz))
    }

    /// Returns the reciprocal of the median time step [Hz]; `None` if no two rows are consecutive.
    pub(crate) fn median_rate(&self) -> Option<f64> {
        let t = self.t();
        let mut steps: Vec<f64> =
            self.segments().flat_map(|(_, rows)| t[rows].windows(2).map(|pair| pair[1] - pair[0])).collect();
        steps.sort_by(f64::total_cmp);
        quantile(&steps, 0.5).map(f64::recip)
    }

    /// Returns the range of positions of a joint of the Go2 [rad].
    pub(crate) fn go2_range(joint: &str) -> Option<[f64; 2]> {
        let joint: Joint = joint.parse().ok()?;
        Some(twinstep_model::go2().joints[joint.index()].range)
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::BaseMount;

    use super::*;
    use crate::{Segment, TorqueSensor};

    /// A joint that swings by 0.3 rad at `hz`, read at 500 Hz by an encoder with this step, and held for `hold` rows.
    fn log(hz: f64, step: f64, hold: usize) -> Log {
        let position = |row: usize| {
            let q = 0.3 * (std::f64::consts::TAU * hz * (row / hold * hold) as f64 / 500.0).sin();
            if step > 0.0 { (q / step).round() * step } else { q }
        };
        let meta = Meta::new(
            500.0,
            TorqueSensor::MotorCurrent,
            vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }],
        );
        let column = |of: &dyn Fn(usize) -> f64| (0..2000).map(of).collect::<Vec<_>>();
        Log::new(
            meta,
            [
                ("t".to_owned(), column(&|row| row as f64 / 500.0)),
                ("q_FL_hip".to_owned(), column(&position)),
                ("tau_measured_FL_hip".to_owned(), column(&|row| 2.0 + (row / hold) as f64)),
                ("q_cmd_FL_hip".to_owned(), column(&|row| row as f64)),
            ],
        )
        .expect("a log")
    }

    #[test]
    fn held_readings_are_found_and_left_out() {
        for step in [0.0, 0.0004] {
            let log = log(0.7, step, 10);
            let repeats = log.repeats().expect("held readings");
            assert!((repeats.rate_hz - 50.0).abs() < 2.0, "{}", repeats.rate_hz);
            let thin = log.without_repeats(&repeats);
            assert!(thin.rows().abs_diff(200) <= 5, "{}", thin.rows());
            let row = thin.rows() / 2;
            assert!((thin.t()[row + 1] - thin.t()[row] - 0.02).abs() < 1e-9);
            // The mean of ten commands that rise by 1 each.
            let first = (thin.t()[row] * 500.0).round();
            assert!((thin.q_cmd("FL_hip").expect("commands")[row] - (first + 4.5)).abs() < 1e-9);
            // Half of what it is at both ends.
            let torque = thin.channel("tau_measured_FL_hip").expect("torques")[row];
            assert!((torque - (2.5 + first / 10.0)).abs() < 1e-9, "{torque}");
        }
    }

    #[test]
    fn motion_faster_than_the_sensors_is_refused() {
        let checked = |hz: f64, hold: usize| {
            let log = log(hz, 0.0, hold);
            let thin = log.repeats().map_or_else(|| log.clone(), |repeats| log.without_repeats(&repeats));
            thin.check_measurements_per_period()
        };
        // 71 and 20 measurements in a period, 8 of a sensor at 50 Hz, and 8 of one that does not repeat.
        assert_eq!(checked(0.7, 10), Ok(()));
        assert_eq!(checked(2.5, 10), Ok(()));
        let refused = checked(6.1, 10).expect_err("aliased");
        assert_eq!(refused.joint, "FL_hip");
        assert!((refused.per_period - 50.0 / 6.1).abs() < 0.3, "{}", refused.per_period);
        assert_eq!(checked(61.0, 1), Ok(()));
    }

    #[test]
    fn slow_motion_of_a_coarse_encoder_repeats_nothing() {
        assert_eq!(log(0.05, 0.0015, 1).repeats(), None);
        assert_eq!(log(0.7, 0.0, 1).repeats(), None);
        assert_eq!(log(0.0, 0.0, 1).repeats(), None, "at rest");
    }
}
