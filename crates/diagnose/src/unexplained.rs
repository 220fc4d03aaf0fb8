//! Unexplained residual: the worst channel, and what its residual depends on.

use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, RobotModel, Rollout};

use super::data_split::DataSplit;
use super::residual_data::ResidualData;
use super::residual_power::{ResidualPower, STANCE, TORQUE, TRUNK, WRENCH};
use super::spectral_line::spectral_line;
use crate::findings::Unexplained;
use twinstep_identify::experiment::{Experiment, Regime, ResidualChannel};
use twinstep_logs::replay::{JointCommands, command, joint_commands};

/// Number of bins of a variable that may explain a residual.
const BINS: usize = 12;
/// Cross-validated R² from which a variable is reported.
const MIN_R_SQUARED: f64 = 0.3;
/// Power above noise from which an unexplained residual is reported [noise variance].
pub const LEAST_EXCESS: f64 = 0.3;

/// Describes the unexplained residual of `robot`, relative to the residual power `given` of the given model.
pub fn unexplained(
    evidence: &ResidualData,
    robot: &RobotModel,
    given: &ResidualPower,
    left: &ResidualPower,
    simulator: &mut dyn Rollout,
) -> Unexplained {
    let (before, after) = (given.power_above_noise(), left.power_above_noise());
    let fraction = if before > 0.0 { (after / before).min(1.0) } else { 0.0 };
    let count = |channel: usize| left.counts[channel].iter().sum::<f64>();
    let worst = (0..TRUNK)
        .chain(STANCE..WRENCH)
        .filter(|channel| count(*channel) > 0.0)
        .max_by(|one, other| {
            let of = |channel: usize| left.channel_excess(channel) / count(channel);
            of(*one).total_cmp(&of(*other))
        })
        .filter(|channel| left.channel_excess(*channel) > LEAST_EXCESS * count(*channel));
    let Some(channel) = worst else { return only_noise() };
    let log = &evidence.logs()[0];
    let residual = residual(evidence, robot, channel, simulator);
    let kind = if (TORQUE..TRUNK).contains(&channel) { "torque" } else { "position" };
    let whose = format!("The {kind} of {}", JOINT_NAMES[channel % 12]);
    describe_residual(log, &residual, variables(log, robot), fraction, &whose)
}

/// Describes what a residual of a log depends on. The text starts with `whose`.
pub fn describe_residual(
    log: &Log,
    residual: &[f64],
    variables: Vec<(String, Vec<f64>)>,
    fraction: f64,
    whose: &str,
) -> Unexplained {
    let split = DataSplit::new(log);
    let mut found: Vec<(f64, String)> = variables
        .into_iter()
        .map(|(name, cells)| (binned_r_squared(&split, residual, &cells), name))
        .chain(
            line_of(log, &split, residual)
                .map(|(frequency, share)| (share, format!("a spectral line at {frequency:.2} Hz"))),
        )
        .filter(|(share, _)| *share > MIN_R_SQUARED)
        .collect();
    found.sort_by(|one, other| other.0.total_cmp(&one.0));
    found.truncate(3);
    let dependence = found.first().map_or("it depends on none of the channels".to_owned(), |(share, variable)| {
        format!("{:.0} % of its variance is explained by {variable}", 100.0 * share)
    });
    let text = format!("{whose} has a residual above noise that no cause explains: {dependence}.");
    Unexplained { fraction, depends_on: found.into_iter().map(|(_, name)| name).collect(), text }
}

/// Returns the result for a residual that does not exceed noise.
pub fn only_noise() -> Unexplained {
    Unexplained { fraction: 0.0, depends_on: Vec::new(), text: "The residual is noise.".to_owned() }
}

/// Returns the measured channels of a log, and time.
pub fn measured(log: &Log) -> Vec<(String, Vec<f64>)> {
    let starts = ["q_", "dq_", "tau_measured_", "battery_V", "temp_"];
    let measured = log.channels().filter(|(name, _)| starts.iter().any(|start| name.starts_with(start)));
    let mut all: Vec<(String, Vec<f64>)> = measured.map(|(name, cells)| (name.to_owned(), cells.to_vec())).collect();
    all.push(("t".to_owned(), log.t().to_vec()));
    all
}

/// Returns the frequency of the strongest spectral line of a residual [Hz], and the explained fraction.
fn line_of(log: &Log, split: &DataSplit, residual: &[f64]) -> Option<(f64, f64)> {
    let rows = (0..residual.len()).filter(|row| residual[*row].is_finite());
    let rows: Vec<(usize, usize)> = rows.filter_map(|row| Some((row, split.fold(row)?))).collect();
    let t: Vec<f64> = rows.iter().map(|(row, _)| log.t()[*row]).collect();
    let values: Vec<f64> = rows.iter().map(|(row, _)| residual[*row]).collect();
    let folds: Vec<usize> = rows.iter().map(|(_, fold)| *fold).collect();
    spectral_line(&t, &values, &folds)
}

/// Returns the residual of a joint's position or torque, by row of the first log; NaN if it was not measured.
fn residual(evidence: &ResidualData, robot: &RobotModel, channel: usize, simulator: &mut dyn Rollout) -> Vec<f64> {
    let log = &evidence.logs()[0];
    let mut residual = vec![f64::NAN; log.rows()];
    if (TORQUE..TRUNK).contains(&channel) {
        let each = |joint: usize, row: usize, difference: f64| {
            if TORQUE + joint == channel {
                residual[row] = difference;
            }
        };
        evidence.torques().differences(robot, each);
    } else {
        let corrected = evidence.fit_rows.nuisance_corrected(simulator, std::slice::from_ref(robot)).remove(0);
        let experiment = &evidence.fit_rows.experiments[0];
        let (joint, regime) =
            if channel < STANCE { (channel, Regime::Fixed) } else { (channel - STANCE, Regime::Floating) };
        let cells = experiment.residual_index().zip(experiment.groups());
        for (corrected, ((quantity, row), group)) in corrected.into_iter().zip(cells) {
            if quantity == ResidualChannel::Position(joint) && Experiment::regime(group) == regime {
                residual[row] = corrected;
            }
        }
    }
    residual
}

/// Returns the variables that may explain a residual: measured channels and commanded torques of all joints, and time.
fn variables(log: &Log, robot: &RobotModel) -> Vec<(String, Vec<f64>)> {
    let mut all = measured(log);
    all.extend(wanted_torques(log, robot));
    all
}

/// Returns the commanded torques of the PD loop, `tau_cmd_<joint>` [N·m].
fn wanted_torques(log: &Log, robot: &RobotModel) -> Vec<(String, Vec<f64>)> {
    let joints = joint_commands(log).unwrap_or_default();
    let of = |joint: &JointCommands| -> Option<(String, Vec<f64>)> {
        let (name, index) = (joint.joint.name(), joint.joint.index());
        let (q, dq) = (log.q(name)?, log.dq(name));
        let wanted = |row: usize| {
            let command = command(robot, &joints, row);
            let [kp, kd, to, at] =
                [command.kp, command.kd, command.q, command.dq].map(|values| f64::from(values[index]));
            kp * (to - q[row]) + kd * (at - dq.map_or(at, |dq| dq[row]))
        };
        Some((format!("tau_cmd_{name}"), (0..log.rows()).map(wanted).collect()))
    };
    joints.iter().filter_map(of).collect()
}

/// Returns the R² of binned means: bins of `cells`, means from one fold, evaluated on the other.
fn binned_r_squared(split: &DataSplit, residual: &[f64], cells: &[f64]) -> f64 {
    let rows: Vec<usize> =
        (0..residual.len()).filter(|row| residual[*row].is_finite() && cells[*row].is_finite()).collect();
    if rows.len() < 10 * BINS {
        return 0.0;
    }
    let mut sorted: Vec<f64> = rows.iter().map(|row| cells[*row]).collect();
    sorted.sort_by(f64::total_cmp);
    let bin = |value: f64| {
        let below = sorted.partition_point(|other| *other < value);
        (below * BINS / sorted.len()).min(BINS - 1)
    };
    let (mut rest, mut total) = (0.0, 0.0);
    for fold in [0, 1] {
        let (mut sums, mut counts) = ([0.0; BINS], [0.0; BINS]);
        let of_fold = |fold: usize| rows.iter().copied().filter(move |row| split.fold(*row) == Some(fold));
        for row in of_fold(fold) {
            sums[bin(cells[row])] += residual[row];
            counts[bin(cells[row])] += 1.0;
        }
        let mean = sums.iter().sum::<f64>() / counts.iter().sum::<f64>().max(1.0);
        for row in of_fold(1 - fold) {
            let bin = bin(cells[row]);
            let expected = if counts[bin] > 0.0 { sums[bin] / counts[bin] } else { mean };
            rest += (residual[row] - expected).powi(2);
            total += (residual[row] - mean).powi(2);
        }
    }
    if total > 0.0 { 1.0 - rest / total } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::BaseMount;

    use super::*;

    const ROWS: usize = 4000;

    /// Returns a log of 20 s whose hip and thigh move with different frequencies.
    fn log() -> Log {
        let column = |name: &str, of: &dyn Fn(f64) -> f64| {
            (name.to_owned(), (0..ROWS).map(|row| of(row as f64 / 200.0)).collect::<Vec<_>>())
        };
        let columns = [
            column("t", &|t| t),
            column("q_FL_hip", &|t| (3.7 * t).sin()),
            column("q_cmd_FL_hip", &|t| (3.7 * t).sin()),
            column("q_FL_thigh", &|t| (5.3 * t + 1.0).sin()),
            column("q_cmd_FL_thigh", &|t| (5.3 * t + 1.0).sin()),
            column("kp", &|_| 25.0),
            column("kd", &|_| 0.6),
        ];
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        Log::new(Meta::new(200.0, TorqueSensor::None, segments), columns).expect("a log")
    }

    fn described(residual: impl Fn(f64) -> f64) -> Unexplained {
        let log = log();
        let residual: Vec<f64> = log.t().iter().map(|t| residual(*t)).collect();
        describe_residual(&log, &residual, measured(&log), 0.5, "The position")
    }

    #[test]
    fn nonlinear_dependence_on_another_joint_is_found() {
        let unexplained = described(|t| 0.01 * (5.3 * t + 1.0).sin().powi(3));
        assert_eq!(unexplained.depends_on[0], "q_FL_thigh", "{unexplained:?}");
    }

    #[test]
    fn sine_that_follows_no_channel_is_found_by_its_frequency() {
        let unexplained = described(|t| 0.01 * (std::f64::consts::TAU * 4.1 * t).sin());
        let [line] = &unexplained.depends_on[..] else { panic!("{unexplained:?}") };
        assert!(line.starts_with("a spectral line at 4.1"), "{line}");
    }

    #[test]
    fn noise_depends_on_nothing() {
        let unexplained = described(|t| ((t * 200.0) as usize * 7919 % 1009) as f64 / 1009.0 - 0.5);
        assert!(unexplained.depends_on.is_empty(), "{unexplained:?}");
        assert!(unexplained.text.contains("depends on none"), "{}", unexplained.text);
    }
}
