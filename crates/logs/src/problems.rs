//! What is wrong with the measurements of a log: units, columns, sensors.
//!
//! Each judgement compares two things that must agree: positions with the range of the joint, velocities with the change of
//! positions, angular velocity with the change of orientation, gravity at rest with 9.81 m/s², the motion of a joint with its command.

use serde::Serialize;

use crate::Log;
use crate::statistics::{largest, quantile};

/// Position beyond which a joint of a robot does not turn [rad].
const MAX_TURN: f64 = 12.6;
/// Tolerance at the end of a joint's range [rad].
const RANGE_TOLERANCE: f64 = 0.05;
/// Smallest range of a motion [rad].
const MOTION: f64 = 0.05;
/// Smallest share of the variance that counts as agreement.
const AGREEMENT: f64 = 0.8;
/// Largest number of rows that are compared.
const MAX_ROWS: usize = 20_000;
const DEGREES: f64 = 180.0 / std::f64::consts::PI;
const RPM: f64 = 30.0 / std::f64::consts::PI;

/// Something wrong with a log.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// What is wrong, and how it is mended.
    pub text: String,
    /// True if no result of the log can be right.
    pub is_fatal: bool,
}

impl Log {
    /// Returns what is wrong with the measurements.
    pub fn problems(&self) -> Vec<Problem> {
        let fatal = [self.unit_of_time(), self.unit_of_positions()].into_iter().flatten();
        let mut problems: Vec<Problem> = fatal.map(|text| Problem { text, is_fatal: true }).collect();
        // Every other comparison needs right units.
        if problems.is_empty() {
            let texts = [
                self.velocities(),
                self.gyroscope(),
                self.gravity(),
                self.columns_of_joints(),
                self.ranges(),
                self.clipped(),
            ];
            problems.extend(texts.into_iter().flatten().map(|text| Problem { text, is_fatal: false }));
        }
        if let Some(repeats) = self.repeats() {
            let text = format!(
                "the positions repeat in {:.0} % of the rows in motion: they were measured at {:.1} Hz, and delays and lags are \
                 not identifiable; these rows are left out where the log is simulated or fitted",
                100.0 * repeats.share,
                repeats.rate_hz
            );
            problems.push(Problem { text, is_fatal: false });
        }
        problems
    }

    fn unit_of_time(&self) -> Option<String> {
        let rate = self.median_rate()?;
        let stated = self.meta().rate_hz;
        let units = [("ms", 1e3), ("µs", 1e6), ("ns", 1e9)];
        let (unit, factor) = units.into_iter().find(|(_, factor)| (rate * factor / stated - 1.0).abs() < 0.05)?;
        let key = if unit == "µs" { "us" } else { unit };
        Some(format!(
            "`t` advances by {:.4} from row to row, {factor:.0} times as much as `rate_hz` = {stated} says: it is in {unit}, not in \
             s; {}",
            1.0 / rate,
            mend(&format!("t = {{ unit = \"{key}\" }}"))
        ))
    }

    fn unit_of_positions(&self) -> Option<String> {
        let (mut beyond, mut example, mut fits, mut is_known) = (0usize, None, true, false);
        for joint in self.joints() {
            for quantity in ["q", "q_cmd"] {
                let Some(cells) = self.channel(&format!("{quantity}_{joint}")) else { continue };
                let range = Self::go2_range(joint);
                let [low, high] = range.unwrap_or([-MAX_TURN, MAX_TURN]);
                is_known |= range.is_some();
                // A joint without known limits may turn several times.
                let is_beyond = |cell: &&f64| **cell < low - MAX_TURN || **cell > high + MAX_TURN;
                let count = cells.iter().filter(is_beyond).count();
                if count > 0 {
                    beyond += count;
                    let worst = cells.iter().copied().max_by(|a, b| a.abs().total_cmp(&b.abs()));
                    example = example.or_else(|| Some((format!("{quantity}_{joint}"), worst.unwrap_or_default())));
                }
                let in_degrees = |cell: &&f64| (low - 0.3..=high + 0.3).contains(&(**cell / DEGREES));
                let known: Vec<&f64> = cells.iter().filter(|cell| !cell.is_nan()).collect();
                fits &= known.iter().filter(|cell| in_degrees(cell)).count() * 20 >= known.len() * 19;
            }
        }
        let (column, worst) = example.filter(|_| is_known || fits)?;
        let hint = if fits {
            format!(
                "they are in degrees, not in rad; {}",
                mend("\"q_*\" = { unit = \"deg\" }` and `\"q_cmd_*\" = { unit = \"deg\" }")
            )
        } else {
            "positions are in rad".to_owned()
        };
        Some(format!(
            "positions are beyond what a joint can turn {beyond} times, such as `{column}` = {worst:.2}: {hint}"
        ))
    }

    /// Compares `dq` with the change of `q`.
    fn velocities(&self) -> Option<String> {
        let slopes: Vec<(&String, f64)> =
            self.joints().iter().filter_map(|joint| Some((joint, self.velocity_slope(joint)?))).collect();
        let zero = self.joints().iter().find(|joint| {
            let moves = self.q(joint).and_then(span).is_some_and(|span| span > MOTION);
            moves && self.dq(joint).is_some_and(|dq| dq.iter().all(|cell| *cell == 0.0))
        });
        if let Some(joint) = zero {
            return Some(format!("`dq_{joint}` is 0 in every row, although `q_{joint}` changes: leave the column out"));
        }
        let mut sorted: Vec<f64> = slopes.iter().map(|(_, slope)| *slope).collect();
        sorted.sort_by(f64::total_cmp);
        let median = quantile(&sorted, 0.5)?;
        let near = |slope: f64, factor: f64| (slope / factor - 1.0).abs() < 0.2;
        let units = [("deg/s", DEGREES), ("rpm", RPM)];
        if let Some((unit, _)) = units.into_iter().find(|(_, factor)| near(median, *factor)) {
            let line = format!("\"dq_*\" = {{ unit = \"{unit}\" }}");
            return Some(format!(
                "velocities are {median:.1} times the change of the positions: they are in {unit}, not in rad/s; {}",
                mend(&line)
            ));
        }
        let reversed = slopes.iter().find(|(_, slope)| near(*slope, -1.0)).map(|(joint, _)| {
            format!(
                "`dq_{joint}` has the opposite sign of the change of `q_{joint}`; {}",
                mend(&format!("dq_{joint} = {{ scale = -1 }}"))
            )
        });
        let odd = || {
            let (joint, slope) = slopes.iter().find(|(_, slope)| !(0.6..1.6).contains(slope))?;
            Some(format!(
                "`dq_{joint}` is {slope:.2} times the change of `q_{joint}`: one of them has another unit or belongs to another joint"
            ))
        };
        reversed.or_else(odd)
    }

    /// Returns the factor from the change of `q` to `dq`, if one explains the other.
    fn velocity_slope(&self, joint: &str) -> Option<f64> {
        let (q, dq, t) = (self.q(joint)?, self.dq(joint)?, self.t());
        let mut pairs = Vec::new();
        for (_, rows) in self.segments() {
            // Over several rows, so that the noise of the encoder does not count.
            let width = ((rows.len() / 50).clamp(1, 10)).min(rows.len() / 2);
            for row in (rows.start + width..rows.end.saturating_sub(width)).step_by(1 + self.rows() / MAX_ROWS) {
                let rate = (q[row + width] - q[row - width]) / (t[row + width] - t[row - width]);
                let mean = dq[row - width..=row + width].iter().sum::<f64>() / (2 * width + 1) as f64;
                pairs.push((rate, mean));
            }
        }
        slope(&pairs)
    }

    /// Compares the gyroscope with the change of the orientation.
    fn gyroscope(&self) -> Option<String> {
        let quat = ["w", "x", "y", "z"].map(|part| self.channel(&format!("quat_{part}")));
        let gyro = ["x", "y", "z"].map(|axis| self.channel(&format!("gyro_{axis}")));
        let ([Some(w), Some(x), Some(y), Some(z)], [Some(gx), Some(gy), Some(gz)]) = (quat, gyro) else { return None };
        let t = self.t();
        let mut pairs = Vec::new();
        for (_, rows) in self.segments() {
            let width = ((rows.len() / 50).clamp(1, 10)).min(rows.len() / 2);
            for row in (rows.start + width..rows.end.saturating_sub(width)).step_by(1 + self.rows() / MAX_ROWS) {
                let at = |row: usize| glam::DQuat::from_xyzw(x[row], y[row], z[row], w[row]);
                let (before, after) = (at(row - width), at(row + width));
                let turn = (before.inverse() * after).normalize().to_scaled_axis() / (t[row + width] - t[row - width]);
                let mean = |axis: &[f64]| axis[row - width..=row + width].iter().sum::<f64>() / (2 * width + 1) as f64;
                pairs.extend(turn.to_array().into_iter().zip([gx, gy, gz].map(mean)));
            }
        }
        let slope = slope(&pairs)?;
        let near = |factor: f64| (slope / factor - 1.0).abs() < 0.2;
        if near(DEGREES) {
            return Some(format!(
                "the gyroscope is {slope:.1} times the change of the orientation: it is in deg/s, not in rad/s; {}",
                mend("\"gyro_*\" = { unit = \"deg/s\" }")
            ));
        }
        near(-1.0).then(|| {
            "the gyroscope has the opposite sign of the change of the orientation: `quat` is the rotation from the base to the world".to_owned()
        })
    }

    /// Compares the specific force with gravity.
    fn gravity(&self) -> Option<String> {
        let acc = ["x", "y", "z"].map(|axis| self.channel(&format!("acc_{axis}")));
        let [Some(x), Some(y), Some(z)] = acc else { return None };
        let mut norms: Vec<f64> =
            (0..self.rows()).map(|row| (x[row].powi(2) + y[row].powi(2) + z[row].powi(2)).sqrt()).collect();
        norms.retain(|norm| norm.is_finite());
        norms.sort_by(f64::total_cmp);
        let median = quantile(&norms, 0.5)?;
        if (median - 1.0).abs() < 0.2 {
            return Some(format!(
                "the median of the specific force is {median:.2}: it is in g, not in m/s²; {}",
                mend("\"acc_*\" = { unit = \"g\" }")
            ));
        }
        (median < 0.5).then(|| {
            format!("the median of the specific force is {median:.2} m/s²: gravity was taken out; leave `acc` out")
        })
    }

    /// Looks for positions that do not follow their own command.
    fn columns_of_joints(&self) -> Option<String> {
        let joints: Vec<&String> =
            self.joints().iter().filter(|joint| self.q(joint).is_some() && self.q_cmd(joint).is_some()).collect();
        if joints.is_empty() {
            return None;
        }
        let moves = |cells: &[f64]| span(cells).is_some_and(|span| span > MOTION);
        let [q, q_cmd] =
            [Self::q, Self::q_cmd].map(|of| joints.iter().filter_map(|joint| of(self, joint)).collect::<Vec<_>>());
        if q.iter().any(|cells| moves(cells)) && q_cmd.iter().all(|cells| span(cells).is_none_or(|span| span == 0.0)) {
            return Some("the commands never change although the joints move: were they recorded?".to_owned());
        }
        let has_no_gain = |joint: &&String| {
            let [kp, kd] = self.gains(joint);
            let is_zero = |gains: Option<Vec<f64>>| gains.is_some_and(|gains| gains.iter().all(|gain| *gain == 0.0));
            is_zero(kp) && is_zero(kd)
        };
        if q_cmd.iter().any(|cells| moves(cells)) && joints.iter().all(has_no_gain) {
            return Some("kp and kd are 0 in every row: no command acts".to_owned());
        }
        let constant =
            (0..joints.len()).find(|index| moves(q_cmd[*index]) && span(q[*index]).is_some_and(|span| span == 0.0));
        if let Some(index) = constant {
            return Some(format!(
                "`q_{}` never changes, although its command does: the column is constant",
                joints[index]
            ));
        }
        self.assignment(&joints, &q, &q_cmd)
    }

    /// Looks for pairs of joints that follow the command of each other, and for reversed signs.
    fn assignment(&self, joints: &[&String], q: &[&[f64]], q_cmd: &[&[f64]]) -> Option<String> {
        let step = 1 + self.rows() / MAX_ROWS;
        let moving: Vec<usize> =
            (0..joints.len()).filter(|index| span(q_cmd[*index]).is_some_and(|span| span > MOTION)).collect();
        let correlation = |one: usize, other: usize| {
            let pairs: Vec<(f64, f64)> = q_cmd[other].iter().zip(q[one]).step_by(step).map(|(a, b)| (*a, *b)).collect();
            correlation(&pairs)
        };
        let own: Vec<f64> = (0..joints.len())
            .map(|index| if moving.contains(&index) { correlation(index, index) } else { 1.0 })
            .collect();
        if let Some(index) = moving.iter().find(|index| own[**index] < -AGREEMENT) {
            let joint = joints[*index];
            return Some(format!(
                "`q_{joint}` moves against its command; {}",
                mend(&format!("\"*q_{joint}\" = {{ scale = -1 }}"))
            ));
        }
        let mut swapped = Vec::new();
        for (place, one) in moving.iter().enumerate() {
            for other in &moving[place + 1..] {
                let is_bad = own[*one] < 0.5 && own[*other] < 0.5;
                if is_bad && correlation(*one, *other) > AGREEMENT && correlation(*other, *one) > AGREEMENT {
                    swapped.push((joints[*one], joints[*other]));
                }
            }
        }
        let _ = swapped.first()?;
        let all = swapped.iter().map(|(one, other)| format!("{one} and {other}")).collect::<Vec<_>>().join(", ");
        let is_mirror = |(one, other): &(&String, &String)| {
            one.replacen("L_", "R_", 1) == **other || one.replacen("R_", "L_", 1) == **other
        };
        let mirrored =
            if swapped.len() > 2 && swapped.iter().all(is_mirror) { ": left and right are mirrored" } else { "" };
        Some(format!("the positions of {all} follow the command of each other: the columns are swapped{mirrored}"))
    }

    fn ranges(&self) -> Option<String> {
        let beyond = |joint: &&String| {
            let ([low, high], cells) = (Self::go2_range(joint)?, self.q(joint)?);
            let count =
                cells.iter().filter(|cell| **cell < low - RANGE_TOLERANCE || **cell > high + RANGE_TOLERANCE).count();
            (count > 0).then_some((count, low, high))
        };
        let (joint, (count, low, high)) = self.joints().iter().find_map(|joint| Some((joint, beyond(&joint)?)))?;
        Some(format!(
            "`q_{joint}` is beyond the range of the joint, {low:.2} to {high:.2} rad, in {count} rows: is its zero or its sign another one?"
        ))
    }

    /// Looks for values at which a sensor ends.
    fn clipped(&self) -> Option<String> {
        let is_sensor = |name: &&str| {
            ["q_", "dq_", "gyro_", "acc_"].iter().any(|start| name.starts_with(start)) && !name.contains("_cmd_")
        };
        let found = self.channels().filter(|(name, _)| is_sensor(name)).find_map(|(name, cells)| {
            let high = largest(cells.iter().copied())?;
            let low = -largest(cells.iter().map(|cell| -cell))?;
            let count = |value: f64| cells.iter().filter(|cell| **cell == value).count();
            let mut sorted: Vec<f64> = cells.iter().copied().filter(|cell| !cell.is_nan()).collect();
            sorted.sort_by(f64::total_cmp);
            let mut repeats: Vec<f64> = sorted.chunk_by(|a, b| a == b).map(|part| part.len() as f64).collect();
            repeats.sort_by(f64::total_cmp);
            let usual = quantile(&repeats, 0.9)?;
            let is_clip =
                |value: &f64| high > low && count(*value) as f64 > (10.0 * usual).max(0.01 * cells.len() as f64);
            let is_clip = |value: &f64| is_clip(value) && is_cut_off(cells, *value);
            let clip = [high, low].into_iter().filter(|value| *value != 0.0).find(is_clip)?;
            Some((name.to_owned(), clip, count(clip)))
        });
        let (name, clip, count) = found?;
        Some(format!("`{name}` is {clip:.4} in {count} rows and never beyond: the sensor or the recorder clips it"))
    }
}

/// Returns true if a signal comes to a value at full speed, again and again. What comes to rest there slows down.
fn is_cut_off(cells: &[f64], value: f64) -> bool {
    let steps = cells.windows(2).map(|pair| (pair[1] - pair[0]).abs()).filter(|step| *step > 0.0);
    let (sum, count) = steps.fold((0.0, 0usize), |(sum, count), step| (sum + step, count + 1));
    let usual = sum / count.max(1) as f64;
    let entries: Vec<f64> = (cells.windows(4))
        .filter(|rows| rows[1] != value && rows[2] == value && rows[3] == value)
        .map(|rows| (rows[1] - rows[0]).abs())
        .collect();
    let fast = entries.iter().filter(|step| **step > 0.5 * usual).count();
    entries.len() >= 3 && 2 * fast >= entries.len()
}

/// Says how a column is converted.
fn mend(line: &str) -> String {
    format!("`twinstep log FILE --map MAP --convert NEW` reads it right if MAP has the line `{line}`")
}

fn span(cells: &[f64]) -> Option<f64> {
    Some(largest(cells.iter().copied())? + largest(cells.iter().map(|cell| -cell))?)
}

/// Returns the factor from the first to the second numbers by least squares, if it explains them.
fn slope(pairs: &[(f64, f64)]) -> Option<f64> {
    let known = || pairs.iter().filter(|(a, b)| a.is_finite() && b.is_finite());
    let sum = |of: fn(&(f64, f64)) -> f64| known().map(of).sum::<f64>();
    let (xx, xy, yy) = (sum(|(a, _)| a * a), sum(|(a, b)| a * b), sum(|(_, b)| b * b));
    (xx > 0.0 && yy > 0.0 && xy * xy > AGREEMENT * xx * yy).then(|| xy / xx)
}

fn correlation(pairs: &[(f64, f64)]) -> f64 {
    let known: Vec<(f64, f64)> = pairs.iter().copied().filter(|(a, b)| a.is_finite() && b.is_finite()).collect();
    let count = known.len().max(1) as f64;
    let [mean_a, mean_b] =
        [known.iter().map(|(a, _)| a).sum::<f64>() / count, known.iter().map(|(_, b)| b).sum::<f64>() / count];
    let sum = |of: &dyn Fn(f64, f64) -> f64| known.iter().map(|(a, b)| of(a - mean_a, b - mean_b)).sum::<f64>();
    let (aa, ab, bb) = (sum(&|a, _| a * a), sum(&|a, b| a * b), sum(&|_, b| b * b));
    if aa > 0.0 && bb > 0.0 { ab / (aa * bb).sqrt() } else { 0.0 }
}
