//! Residual of a log over the variable that explains it, with the part that a cause explains.

use twinstep_effects::{Effect, Scope, Target, Variable};
use twinstep_identify::{JointSeries, JointTrajectory};
use twinstep_logs::Log;
use twinstep_logs::replay::{JointCommands, cell_or_zero};
use twinstep_model::{Joint, RobotModel};

/// Number of bins of a plot.
const BINS: usize = 40;
/// Minimum number of rows of a bin.
const MIN_ROWS: usize = 8;

/// Residual over the variable that explains it.
#[derive(Clone, Debug, PartialEq)]
pub struct ResidualPlot {
    /// Effect and scope, as in the model file.
    pub cause: (String, String),
    /// Name of the variable, with its unit.
    pub x_label: &'static str,
    /// Name of the residual, with its unit.
    pub y_label: &'static str,
    /// Bins in ascending order of the variable.
    pub bins: Vec<Bin>,
}

/// Rows with similar values of the variable.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bin {
    /// Mean of the variable.
    pub x: f64,
    /// Mean residual of the model without the cause.
    pub mean: f64,
    /// 16th and 84th percentile of that residual.
    pub spread: [f64; 2],
    /// Mean of the part that the cause explains.
    pub law: f64,
}

/// Returns the name of a variable, with its unit.
fn label(variable: Variable) -> &'static str {
    match variable {
        Variable::Position => "joint position [rad]",
        Variable::Velocity => "joint velocity [rad/s]",
        Variable::Acceleration => "joint acceleration [rad/s²]",
        Variable::CommandedTorque => "torque of the ideal actuator [N·m]",
        Variable::CommandedTorqueRate => "rate of the ideal actuator's torque [N·m/s]",
        Variable::CommandRate => "rate of the commanded position [rad/s]",
        Variable::Load => "torque magnitude, sign of the velocity [N·m]",
        Variable::Voltage => "battery voltage [V]",
        Variable::Temperature => "motor temperature [°C]",
        Variable::Time => "time [s]",
    }
}

/// Returns the value of a variable in every row.
fn values(
    variable: Variable,
    log: &Log,
    robot: &RobotModel,
    joint: &JointCommands,
    kinematics: &JointTrajectory,
) -> Vec<f64> {
    let index = joint.joint.index();
    let torque = || commanded_torque(log, robot, joint, kinematics);
    let channel = |name: &str| log.channel(name).map_or(Vec::new(), <[f64]>::to_vec);
    match variable {
        Variable::Position => kinematics.q[index].clone(),
        Variable::Velocity => kinematics.dq[index].clone(),
        Variable::Acceleration => kinematics.ddq[index].clone(),
        Variable::CommandedTorque => torque(),
        Variable::CommandedTorqueRate => rates(log, &torque()),
        Variable::CommandRate => rates(log, joint.q_cmd),
        Variable::Load => torque().iter().zip(&kinematics.dq[index]).map(|(tau, dq)| tau.abs() * dq.signum()).collect(),
        Variable::Voltage => channel("battery_V"),
        Variable::Temperature => channel(&format!("temp_{}", joint.joint)),
        Variable::Time => log.t().to_vec(),
    }
}

/// Residuals of a log with and without a cause.
pub struct Residuals<'a> {
    pub log: &'a Log,
    pub robot: &'a RobotModel,
    pub joints: &'a [JointCommands<'a>],
    pub kinematics: &'a JointTrajectory,
    /// Label of the y axis.
    pub y_label: &'static str,
    /// Residuals of the model without the cause, and of the model with it.
    pub without: &'a JointSeries,
    pub with: &'a JointSeries,
}

impl Residuals<'_> {
    /// Returns the residual plot of an effect. Returns `None` if fewer than two bins have enough rows.
    pub fn law(&self, effect: &Effect, scope: Scope) -> Option<ResidualPlot> {
        let variable = effect.explained_by;
        let of_bodies = !matches!(effect.target, Target::Joints | Target::Supply);
        let is_affected = |joint: Joint| of_bodies || scope.contains(joint);
        let mut points = Vec::new();
        for joint in self.joints.iter().filter(|joint| is_affected(joint.joint)) {
            let index = joint.joint.index();
            let x = values(variable, self.log, self.robot, joint, self.kinematics);
            for (x, (without, with)) in x.iter().zip(self.without[index].iter().zip(&self.with[index])) {
                if x.is_finite() && without.is_finite() && with.is_finite() {
                    // Over time the magnitude is plotted: residuals of different joints would cancel.
                    let magnitude = |y: f64| if variable == Variable::Time { y.abs() } else { y };
                    points.push([*x, magnitude(*without), magnitude(*without) - magnitude(*with)]);
                }
            }
        }
        let bins = bins(points);
        let cause = (effect.name.to_owned(), scope.to_string());
        (bins.len() > 1).then_some(ResidualPlot { cause, x_label: label(variable), y_label: self.y_label, bins })
    }
}

/// Bins points of variable, residual and explained part. Omits the lowest and highest 0.5 % of the variable.
fn bins(mut points: Vec<[f64; 3]>) -> Vec<Bin> {
    points.sort_by(|one, other| one[0].total_cmp(&other[0]));
    let edge = points.len() / 200;
    let points = &points[edge..points.len() - edge];
    let (Some(first), Some(last)) = (points.first(), points.last()) else { return Vec::new() };
    let width = (last[0] - first[0]) / BINS as f64;
    if width <= 0.0 {
        return Vec::new();
    }
    let bin = |points: &[[f64; 3]]| {
        let count = points.len() as f64;
        let mut residuals: Vec<f64> = points.iter().map(|point| point[1]).collect();
        residuals.sort_by(f64::total_cmp);
        let quantile = |share: f64| residuals[(share * (count - 1.0)).round() as usize];
        Bin {
            x: points.iter().map(|point| point[0]).sum::<f64>() / count,
            mean: residuals.iter().sum::<f64>() / count,
            spread: [quantile(0.16), quantile(0.84)],
            law: points.iter().map(|point| point[2]).sum::<f64>() / count,
        }
    };
    let bin_index = |point: &[f64; 3]| (((point[0] - first[0]) / width) as usize).min(BINS - 1);
    points
        .chunk_by(|one, other| bin_index(one) == bin_index(other))
        .filter(|rows| rows.len() >= MIN_ROWS)
        .map(bin)
        .collect()
}

/// Returns the torque of an actuator without effects in the measured state [N·m].
fn commanded_torque(log: &Log, robot: &RobotModel, joint: &JointCommands, kinematics: &JointTrajectory) -> Vec<f64> {
    let index = joint.joint.index();
    let q = log.q(joint.joint.name()).unwrap_or_default();
    let gain = |gains: &Option<Vec<f64>>, row: usize, model: f64| gains.as_ref().map_or(model, |gains| gains[row]);
    let of = |row: usize| {
        let [dq_cmd, tau_ff] = [joint.dq_cmd, joint.tau_ff].map(|column| f64::from(cell_or_zero(column, row)));
        let (kp, kd) = (gain(&joint.kp, row, robot.control.kp[index]), gain(&joint.kd, row, robot.control.kd[index]));
        kp * (joint.q_cmd[row] - q[row]) + kd * (dq_cmd - kinematics.dq[index][row]) + tau_ff
    };
    (0..q.len()).map(of).collect()
}

/// Returns central differences over time; NaN at the ends of contiguous ranges.
fn rates(log: &Log, cells: &[f64]) -> Vec<f64> {
    let mut rates = vec![f64::NAN; cells.len()];
    for (_, rows) in log.segments() {
        let change = |cells: &[f64], row: usize| cells[row + 1] - cells[row - 1];
        let inner = rows.start + 1..rows.end.saturating_sub(1);
        inner.for_each(|row| rates[row] = change(cells, row) / change(log.t(), row));
    }
    rates
}
