//! Unexplained residual: the one that depends most clearly on a variable, and which variable that is.

use rayon::prelude::*;
use twinstep_identify::FootHeights;
use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, Leg, RobotModel, Rollout};

use super::data_split::DataSplit;
use super::explained_variance::r_squared;
use super::residual_data::{ResidualData, torque_sigma, variance};
use super::residual_power::{GYRO_AT_REST, ResidualPower, STANCE, TORQUE, TRUNK, WRENCH, channel_name};
use super::spectral_line::spectral_line;
use crate::findings::Unexplained;
use twinstep_logs::replay::{JointCommands, command, joint_commands};

/// Cross-validated R² from which a variable is reported.
const MIN_R_SQUARED: f64 = 0.3;
/// Power above noise from which an unexplained residual is reported [noise variance].
pub const LEAST_EXCESS: f64 = 0.3;
/// Standard deviation of the height of a standing foot that contact explains [m].
const HEIGHT_STD_M: f64 = 0.001;
/// Least log-likelihood gain of a variable that is reported, beside the logarithm of the number of variables and residuals that are
/// tried [nat].
const LEAST_GAIN: f64 = 5.0;
/// Number of torques, and of other channels, that are examined: those with the largest power above noise.
const EXAMINED: usize = 6;
/// Number of variables that are reported, the strongest first.
const REPORTED: usize = 3;
/// Start of the name of a spectral line.
const LINE: &str = "a spectral line at";

/// Describes the unexplained residual of `robot`, relative to the residual power `given` of the given model.
///
/// It is that of a channel with power above noise, or the height of a standing foot, in the first log: whatever a variable explains
/// with the largest log-likelihood gain.
pub fn unexplained(
    evidence: &ResidualData,
    robot: &RobotModel,
    given: &ResidualPower,
    left: &ResidualPower,
    simulator: &mut dyn Rollout,
) -> Unexplained {
    let (before, after) = (given.power_above_noise(), left.power_above_noise());
    let fraction = if before > 0.0 { (after / before).min(1.0) } else { 0.0 };
    let (log, split) = (&evidence.logs()[0], &evidence.splits()[0]);
    let channels = largest_excesses(left);
    let worst = channels.first().map(|channel| channel_name(*channel));
    let mut residuals = heights_of_feet(evidence, robot);
    if worst.is_some() {
        let tables = residuals_of_channels(evidence, robot, simulator);
        residuals.extend(channels.into_iter().map(|channel| Residual::of_channel(evidence, channel, &tables[channel])));
    }
    let variables = variables(log, robot);
    let least = LEAST_GAIN + ((residuals.len() * variables.len()).max(1) as f64).ln();
    let dependence = |mut residual: Residual| {
        // Held-out rows are no evidence.
        let out = residual.values.iter_mut().enumerate().filter(|(row, _)| split.fold(*row).is_none());
        out.for_each(|(_, value)| *value = f64::NAN);
        let rows = residual.values.iter().filter(|value| value.is_finite()).count() as f64;
        let mut found = dependences(log, split, &residual.values, &variables);
        found.retain(|(_, name)| residual.own_error.as_ref() != Some(name));
        Dependence { name: residual.name, independent: rows / residual.correlation_rows, variables: found }
    };
    match (clearest(residuals.into_par_iter().map(dependence).collect(), least), worst) {
        (Some(found), _) => described(found.variables, fraction, &found.name),
        (None, Some(worst)) => described(Vec::new(), fraction, &worst),
        (None, None) => only_noise(),
    }
}

/// Residual in the first log.
struct Residual {
    /// Its name, as the start of a sentence.
    name: String,
    /// Values by row; NaN where there is none.
    values: Vec<f64>,
    /// Correlation length [rows].
    correlation_rows: f64,
    /// Position error of the same joint, which the residual of its position resembles whatever moves it.
    own_error: Option<String>,
}

impl Residual {
    fn of_channel(evidence: &ResidualData, channel: usize, values: &[f64]) -> Self {
        let is_position = channel < TORQUE || (STANCE..WRENCH).contains(&channel);
        Self {
            name: channel_name(channel),
            values: values.to_vec(),
            correlation_rows: evidence.correlation_rows(channel),
            own_error: is_position.then(|| format!("q_error_{}", JOINT_NAMES[channel % 12])),
        }
    }
}

/// Returns the torques and the other channels with the largest power above noise, the largest first.
///
/// What a simulator cannot follow, such as contact, does not hide what torques on measured states show.
fn largest_excesses(left: &ResidualPower) -> Vec<usize> {
    let count = |channel: usize| left.counts[channel].iter().sum::<f64>();
    let excess = |channel: &usize| left.channel_excess(*channel) / count(*channel);
    let mut channels: Vec<usize> =
        (0..GYRO_AT_REST).filter(|channel| count(*channel) > 0.0 && excess(channel) > LEAST_EXCESS).collect();
    channels.sort_by(|one, other| excess(other).total_cmp(&excess(one)));
    let is_torque = |channel: &usize| (TORQUE..TRUNK).contains(channel);
    let torques = channels.iter().filter(|channel| is_torque(channel)).take(EXAMINED);
    let others = channels.iter().filter(|channel| !is_torque(channel)).take(EXAMINED);
    let chosen: Vec<usize> = torques.chain(others).copied().collect();
    channels.retain(|channel| chosen.contains(channel));
    channels
}

/// What a residual depends on.
#[derive(Debug)]
struct Dependence {
    /// Name of the residual, as the start of a sentence.
    name: String,
    /// Number of its rows, divided by their correlation length.
    independent: f64,
    /// Variables with the fraction of the variance that they explain, the strongest first.
    variables: Vec<(f64, String)>,
}

/// Returns the residual that a variable explains with the largest log-likelihood gain, if that is at least `least` [nat].
fn clearest(all: Vec<Dependence>, least: f64) -> Option<Dependence> {
    let gain = |one: &Dependence| one.variables.first().map(|(share, _)| -0.5 * one.independent * (1.0 - share).ln());
    let gains = all.into_iter().filter_map(|one| Some((gain(&one)?, one))).filter(|(gain, _)| *gain >= least);
    gains.max_by(|(one, _), (other, _)| one.total_cmp(other)).map(|(_, dependence)| dependence)
}

/// Returns the heights of the feet of a standing robot [m] that change by more than contact lets them.
fn heights_of_feet(evidence: &ResidualData, robot: &RobotModel) -> Vec<Residual> {
    let log = &evidence.logs()[0];
    let heights = FootHeights::new(log, robot);
    let feet = Leg::ALL.into_iter().map(|leg| (leg, heights.table(leg as usize, log.rows())));
    let changing = feet.filter(|(_, heights)| variance(heights) > HEIGHT_STD_M * HEIGHT_STD_M);
    let residual = |(leg, values): (Leg, Vec<f64>)| Residual {
        name: format!("The height of the foot {}", leg.name()),
        values,
        correlation_rows: evidence.correlation_rows(STANCE),
        own_error: None,
    };
    changing.map(residual).collect()
}

/// Returns what explains a residual, with the explained fraction of its variance, the strongest first.
fn dependences(log: &Log, split: &DataSplit, residual: &[f64], variables: &[(String, Vec<f64>)]) -> Vec<(f64, String)> {
    let line = line_of(log, split, residual).map(|(frequency, share)| (share, format!("{LINE} {frequency:.2} Hz")));
    let mut found: Vec<(f64, String)> = variables
        .iter()
        .map(|(name, cells)| (r_squared(split, residual, cells), name.clone()))
        .chain(line)
        .filter(|(share, _)| *share > MIN_R_SQUARED)
        .collect();
    found.sort_by(|one, other| other.0.total_cmp(&one.0));
    // All motors become warm together.
    let mut temperatures = 0;
    found.retain(|(_, name)| {
        temperatures += usize::from(name.starts_with("temp_"));
        temperatures < 2 || !name.starts_with("temp_")
    });
    // Variables of the joint itself follow whatever moves it. A line names a cause that they do not.
    if let Some(place) = found.iter().position(|(_, name)| name.starts_with(LINE)).filter(|place| *place >= REPORTED) {
        found.swap(place, REPORTED - 1);
    }
    found.truncate(REPORTED);
    found
}

/// Describes a residual that these variables explain.
fn described(found: Vec<(f64, String)>, fraction: f64, whose: &str) -> Unexplained {
    let dependence = found.first().map_or("it depends on none of the channels".to_owned(), |(share, variable)| {
        format!("{:.0} % of its variance is explained by {variable}", 100.0 * share)
    });
    let text = format!("{whose} differs from the model by more than noise, and no cause explains it: {dependence}.");
    Unexplained { fraction, depends_on: found.into_iter().map(|(_, name)| name).collect(), text }
}

/// Returns the result for a residual that does not exceed noise.
pub fn only_noise() -> Unexplained {
    Unexplained { fraction: 0.0, depends_on: Vec::new(), text: "The residual is noise.".to_owned() }
}

/// Returns the measured channels of a log, the position errors `q_error_<joint>` of its joints, and time.
pub fn measured(log: &Log) -> Vec<(String, Vec<f64>)> {
    let starts = ["q_", "dq_", "tau_measured_", "battery_V", "temp_"];
    let measured = log.channels().filter(|(name, _)| starts.iter().any(|start| name.starts_with(start)));
    let mut all: Vec<(String, Vec<f64>)> = measured.map(|(name, cells)| (name.to_owned(), cells.to_vec())).collect();
    let errors = log.joints().iter().filter_map(|joint| {
        let errors = log.q_cmd(joint)?.iter().zip(log.q(joint)?).map(|(to, q)| to - q);
        Some((format!("q_error_{joint}"), errors.collect()))
    });
    all.extend(errors);
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

/// Returns the residuals of the first log by channel and row, in units of noise and model error; NaN where there is none.
fn residuals_of_channels(evidence: &ResidualData, robot: &RobotModel, simulator: &mut dyn Rollout) -> Vec<Vec<f64>> {
    let log = &evidence.logs()[0];
    let mut residuals = evidence.fit_rows.tables(simulator, robot, log.rows());
    let sigma = torque_sigma(log, robot);
    evidence.torques().differences(robot, |joint, row, difference| {
        residuals[TORQUE + joint][row] = difference / sigma[joint];
    });
    residuals
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

#[cfg(test)]
mod tests {
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::BaseMount;

    use super::*;

    /// Describes what a residual of a log depends on. The text starts with `whose`.
    fn describe_residual(
        log: &Log,
        residual: &[f64],
        variables: &[(String, Vec<f64>)],
        fraction: f64,
        whose: &str,
    ) -> Unexplained {
        super::described(dependences(log, &DataSplit::new(log), residual, variables), fraction, whose)
    }

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
        describe_residual(&log, &residual, &measured(&log), 0.5, "The position")
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

    #[test]
    fn residual_of_which_a_variable_explains_most_is_described() {
        let dependence = |name: &str, independent: f64, shares: &[f64]| Dependence {
            name: name.to_owned(),
            independent,
            variables: shares.iter().map(|share| (*share, "t".to_owned())).collect(),
        };
        let chosen = |all: Vec<Dependence>| clearest(all, 12.0).map(|one| one.name);
        let all = || vec![dependence("position", 90.0, &[0.4]), dependence("height", 30.0, &[0.9, 0.4])];
        assert_eq!(chosen(all()), Some("height".to_owned()), "23 nat for 35");
        assert_eq!(chosen(vec![dependence("position", 90.0, &[])]), None);
        assert_eq!(chosen(vec![dependence("position", 9.0, &[0.9])]), None, "10 nat");
    }
}
