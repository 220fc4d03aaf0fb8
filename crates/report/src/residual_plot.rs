//! The residual of a log beside the variable that explains it, and what a finding makes of it.

use twinstep_effects::{EffectEntry, Target};
use twinstep_identify::{JointSeries, JointTrajectory};
use twinstep_logs::Log;
use twinstep_logs::replay::{JointCommands, cell_or_zero};
use twinstep_model::{Joint, RobotModel};

/// Bins of a picture.
const BINS: usize = 40;
/// Rows that a bin has at least.
const LEAST_ROWS: usize = 8;

/// A residual over the variable that explains it.
#[derive(Clone, Debug, PartialEq)]
pub struct ResidualPlot {
    /// Effect and scope, as in the model file.
    pub cause: (String, String),
    /// The variable, with its unit.
    pub x_label: &'static str,
    /// The residual, with its unit.
    pub y_label: &'static str,
    /// From left to right.
    pub bins: Vec<Bin>,
}

/// Rows whose variable is alike.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bin {
    /// Middle of the bin.
    pub x: f64,
    /// Mean residual of the model without the finding.
    pub mean: f64,
    /// The middle 68 % of it.
    pub spread: [f64; 2],
    /// Mean of what the finding takes away.
    pub law: f64,
}

/// What an effect depends on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Variable {
    Position,
    Velocity,
    Acceleration,
    /// Torque of an actuator without effects.
    CommandedTorque,
    CommandedTorqueRate,
    CommandRate,
    /// Size of that torque with the sign of the velocity.
    Load,
    Voltage,
    Temperature,
    Time,
}

impl Variable {
    /// The one that explains an entry.
    pub fn of(entry: &EffectEntry) -> Self {
        match entry.effect.name {
            "coulomb_friction" | "viscous_friction" | "stribeck_friction" | "torque_speed_limit" => Self::Velocity,
            "joint_spring" | "torque_ripple" | "encoder_offset" => Self::Position,
            "torque_gain" | "torque_saturation" | "backlash" | "joint_elasticity" => Self::CommandedTorque,
            "torque_delay" | "drive_lag" | "torque_sensor_delay" => Self::CommandedTorqueRate,
            "command_delay" => Self::CommandRate,
            "armature" => Self::Acceleration,
            "load_friction" => Self::Load,
            "supply_sag" => Self::Voltage,
            "thermal_derating" => Self::Temperature,
            _ => Self::Time,
        }
    }

    fn label(self) -> &'static str {
        match self {
            Self::Position => "joint position [rad]",
            Self::Velocity => "joint velocity [rad/s]",
            Self::Acceleration => "joint acceleration [rad/s²]",
            Self::CommandedTorque => "torque of the ideal actuator [N·m]",
            Self::CommandedTorqueRate => "change of the ideal actuator's torque [N·m/s]",
            Self::CommandRate => "change of the command [rad/s]",
            Self::Load => "size of the torque, signed as the velocity [N·m]",
            Self::Voltage => "battery voltage [V]",
            Self::Temperature => "motor temperature [°C]",
            Self::Time => "time [s]",
        }
    }

    /// Its value in every row.
    fn values(self, log: &Log, robot: &RobotModel, joint: &JointCommands, kinematics: &JointTrajectory) -> Vec<f64> {
        let index = joint.joint.index();
        let wanted = || wanted(log, robot, joint, kinematics);
        let channel = |name: &str| log.channel(name).map_or(Vec::new(), <[f64]>::to_vec);
        match self {
            Self::Position => kinematics.q[index].clone(),
            Self::Velocity => kinematics.dq[index].clone(),
            Self::Acceleration => kinematics.ddq[index].clone(),
            Self::CommandedTorque => wanted(),
            Self::CommandedTorqueRate => rates(log, &wanted()),
            Self::CommandRate => rates(log, joint.q_cmd),
            Self::Load => wanted().iter().zip(&kinematics.dq[index]).map(|(tau, dq)| tau.abs() * dq.signum()).collect(),
            Self::Voltage => channel("battery_V"),
            Self::Temperature => channel(&format!("temp_{}", joint.joint)),
            Self::Time => log.t().to_vec(),
        }
    }
}

/// What residuals there are, and where they come from.
pub struct Residuals<'a> {
    pub log: &'a Log,
    pub robot: &'a RobotModel,
    pub joints: &'a [JointCommands<'a>],
    pub kinematics: &'a JointTrajectory,
    /// What is on the y axis.
    pub y_label: &'static str,
    /// Of the model without the finding, and of the one with it.
    pub without: &'a JointSeries,
    pub with: &'a JointSeries,
}

impl Residuals<'_> {
    /// The law of `entry` in them; none where no row has both residual and variable.
    pub fn law(&self, entry: &EffectEntry) -> Option<ResidualPlot> {
        let variable = Variable::of(entry);
        let of_bodies = !matches!(entry.effect.target, Target::Joints | Target::Supply);
        let shown = |joint: Joint| of_bodies || entry.scope.contains(joint);
        let mut points = Vec::new();
        for joint in self.joints.iter().filter(|joint| shown(joint.joint)) {
            let index = joint.joint.index();
            let x = variable.values(self.log, self.robot, joint, self.kinematics);
            for (x, (without, with)) in x.iter().zip(self.without[index].iter().zip(&self.with[index])) {
                if x.is_finite() && without.is_finite() && with.is_finite() {
                    // Over time only the size counts: signs of different joints cancel.
                    let size = |y: f64| if variable == Variable::Time { y.abs() } else { y };
                    points.push([*x, size(*without), size(*without) - size(*with)]);
                }
            }
        }
        let bins = bins(points);
        let cause = (entry.effect.name.to_owned(), entry.scope.to_string());
        (bins.len() > 1).then_some(ResidualPlot { cause, x_label: variable.label(), y_label: self.y_label, bins })
    }
}

/// Of points of x, residual and law, between the half percents of x.
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
    let place = |point: &[f64; 3]| (((point[0] - first[0]) / width) as usize).min(BINS - 1);
    points.chunk_by(|one, other| place(one) == place(other)).filter(|rows| rows.len() >= LEAST_ROWS).map(bin).collect()
}

/// Torque of an actuator without effects on the measured state [N·m].
fn wanted(log: &Log, robot: &RobotModel, joint: &JointCommands, kinematics: &JointTrajectory) -> Vec<f64> {
    let index = joint.joint.index();
    let q = log.q(joint.joint.name()).unwrap_or_default();
    let gain = |gains: &Option<Vec<f64>>, row: usize, model: f64| gains.as_ref().map_or(model, |gains| gains[row]);
    let of = |row: usize| {
        let [dq_cmd, tau_ff] = [joint.dq_cmd, joint.tau_ff].map(|column| f64::from(cell_or_zero(column, row)));
        let (kp, kd) = (gain(&joint.kp, row, robot.control.kp), gain(&joint.kd, row, robot.control.kd));
        kp * (joint.q_cmd[row] - q[row]) + kd * (dq_cmd - kinematics.dq[index][row]) + tau_ff
    };
    (0..q.len()).map(of).collect()
}

/// Change with time between neighbours; NaN at the ends of the log's parts.
fn rates(log: &Log, cells: &[f64]) -> Vec<f64> {
    let mut rates = vec![f64::NAN; cells.len()];
    for (_, rows) in log.segments() {
        let change = |cells: &[f64], row: usize| cells[row + 1] - cells[row - 1];
        let inner = rows.start + 1..rows.end.saturating_sub(1);
        inner.for_each(|row| rates[row] = change(cells, row) / change(log.t(), row));
    }
    rates
}
