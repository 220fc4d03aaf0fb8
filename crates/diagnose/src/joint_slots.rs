//! Joints of any robot, at most twelve, mapped to the joint slots of the Go2.
//!
//! The actuator torques are computed from measured states and commands, without simulation of bodies.

use std::collections::BTreeMap;

use rayon::prelude::*;
use twinstep_effects::{EffectEntry, Scope, apply_effects};
use twinstep_logs::{Log, Meta, Segment};
use twinstep_model::{BaseMount, JOINT_NAMES, Joint, RobotModel, go2};

use super::data_split::DataSplit;
use super::residual_data::torque_sigma;
use super::residual_power::{ResidualPower, TORQUE};
use twinstep_identify::torque::MeasuredTorque;
use twinstep_logs::replay::ReplayError;

/// Quantities that determine the torque of a joint's actuator, and the measured torque.
const QUANTITIES: [&str; 7] = ["q", "dq", "q_cmd", "dq_cmd", "tau_ff", "tau_measured", "temp"];
/// Torque in the slots to which the largest measured torque is scaled [N·m].
///
/// It is typical of the Go2, so that the Go2's prior ranges apply to any robot.
const LARGEST_NM: f64 = 20.0;
/// Correlation time of torque residuals [s].
const INDEPENDENT_S: f64 = 0.1;

/// Joints in slots.
pub struct JointSlots {
    /// Names of the joints in the logs.
    names: Vec<String>,
    /// True if these are all joints of the robot.
    whole: bool,
    /// Logs with only these joints, renamed to their slots.
    logs: Vec<Log>,
    splits: Vec<DataSplit>,
    torques: Vec<MeasuredTorque>,
    /// Unit of torque in the slots [N·m].
    pub torque_scale: f64,
    /// Ideal actuator without limits in every slot, with one actuator period per row.
    ideal: RobotModel,
}

impl JointSlots {
    /// Creates the slots for the joints `names` of `logs`.
    pub fn new(logs: &[Log], names: &[String]) -> Result<Self, ReplayError> {
        let whole = names.len() == logs[0].joints().len();
        let mut ideal = go2();
        // Below the rate of any log: each log is replayed at its own rate, one actuator period per row.
        ideal.control.actuator_hz = 1.0;
        for joint in &mut ideal.joints {
            (joint.torque_limit, joint.armature) = (1e6, 0.0);
        }
        let torques = names.iter().flat_map(|name| logs.iter().filter_map(|log| log.tau_measured(name))).flatten();
        let largest = torques.filter(|torque| torque.is_finite()).fold(0.0_f64, |most, torque| most.max(torque.abs()));
        let unit = if largest > 0.0 { largest / LARGEST_NM } else { 1.0 };
        let logs: Vec<Log> = logs.iter().map(|log| into_slots(log, names, unit)).collect::<Result<_, _>>()?;
        let torques = logs.iter().map(|log| MeasuredTorque::new(log, &ideal)).collect::<Result<_, _>>()?;
        let splits = logs.iter().map(DataSplit::new).collect();
        Ok(Self { names: names.to_vec(), whole, logs, splits, torques, ideal, torque_scale: unit })
    }

    /// Returns the scopes that a cause can have: all joints, or one joint.
    pub fn scopes(&self) -> Vec<Scope> {
        let single = Joint::ALL.into_iter().take(self.names.len()).map(Scope::Joint);
        std::iter::once(Scope::All).filter(|_| self.names.len() > 1).chain(single).collect()
    }

    /// Returns the slots of a scope.
    pub fn of(&self, scope: Scope) -> impl Iterator<Item = usize> {
        (0..self.names.len()).filter(move |seat| scope.contains(Joint::ALL[*seat]))
    }

    /// Returns the name of a scope, with the names of the joints in the logs.
    pub fn scope_name(&self, scope: Scope) -> String {
        match scope {
            Scope::Joint(joint) => self.names[joint.index()].clone(),
            // Other joints of the robot are in another group.
            _ if !self.whole => self.names.join("+"),
            scope => scope.to_string(),
        }
    }

    /// Returns the name of a joint in the logs.
    pub fn name(&self, seat: usize) -> &str {
        &self.names[seat]
    }

    /// Returns the highest rate of the logs [Hz].
    fn max_rate_hz(&self) -> f64 {
        self.logs.iter().map(|log| log.meta().rate_hz).fold(0.0, f64::max)
    }

    /// Returns the correlation length of torque residuals [rows].
    pub fn rows_in_one(&self) -> f64 {
        (INDEPENDENT_S * self.max_rate_hz()).max(1.0)
    }

    /// Returns the actuators with these effects. Returns `None` if the entries conflict.
    pub fn robot(&self, entries: &[EffectEntry]) -> Option<RobotModel> {
        apply_effects(&self.ideal, entries).ok()
    }

    /// Returns true if two robots predict different torques at the sensor.
    pub fn affects_torque(&self, robot: &RobotModel, other: &RobotModel) -> bool {
        self.torques.iter().any(|torques| !torques.predict_same_torque(robot, other))
    }

    /// Returns the residual power of the torques of each candidate.
    pub fn residual_powers(&self, robots: &[RobotModel]) -> Vec<ResidualPower> {
        let left = |robot: &RobotModel| {
            let mut left = ResidualPower::empty();
            for ((log, split), torques) in self.logs.iter().zip(&self.splits).zip(&self.torques) {
                let sigma = torque_sigma(log, &self.ideal);
                torques.differences(robot, |seat, row, difference| {
                    left.add(TORQUE + seat, split.fold(row), difference / sigma[seat]);
                });
            }
            left
        };
        robots.par_iter().map(left).collect()
    }

    /// Returns sums over held-out blocks: squared residuals of `robot` and noise variance [N²·m²], and number of rows.
    pub fn held_out_sums(&self, robot: &RobotModel) -> [f64; 3] {
        let (mut squares, mut noise, mut rows) = (0.0, 0.0, 0.0);
        for ((log, split), torques) in self.logs.iter().zip(&self.splits).zip(&self.torques) {
            let sigma = torque_sigma(log, &self.ideal);
            torques.differences(robot, |seat, row, difference| {
                if split.is_held_out(row) {
                    squares += difference * difference;
                    noise += sigma[seat] * sigma[seat];
                    rows += 1.0;
                }
            });
        }
        [self.torque_scale * self.torque_scale * squares, self.torque_scale * self.torque_scale * noise, rows]
    }

    /// Returns the torque residual of a slot in the first log, by row; NaN if torque was not measured.
    pub fn residual(&self, robot: &RobotModel, seat: usize) -> Vec<f64> {
        let mut residual = vec![f64::NAN; self.logs[0].rows()];
        self.torques[0].differences(robot, |joint, row, difference| {
            if joint == seat {
                residual[row] = difference;
            }
        });
        residual
    }
}

/// Returns `log` with only the supply voltage and the joints `names`, renamed to their slots.
///
/// Torques are in units of `unit` [N·m].
fn into_slots(log: &Log, names: &[String], unit: f64) -> Result<Log, ReplayError> {
    let index = |cells: &[u32]| cells.iter().map(|cell| f64::from(*cell)).collect();
    let mut columns: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    columns.insert("t".to_owned(), log.t().to_vec());
    columns.insert("segment".to_owned(), index(log.segment()));
    columns.insert("episode".to_owned(), index(log.episode()));
    columns.extend(log.channel("battery_V").map(|cells| ("battery_V".to_owned(), cells.to_vec())));
    let mut noise = BTreeMap::new();
    for (name, seat) in names.iter().zip(JOINT_NAMES) {
        for quantity in ["q", "dq", "q_cmd", "tau_measured"] {
            if log.channel(&format!("{quantity}_{name}")).is_none() {
                return Err(ReplayError::Missing { joint: name.clone(), quantity });
            }
        }
        for quantity in QUANTITIES {
            let channel = format!("{quantity}_{name}");
            let unit = if quantity.starts_with("tau") { unit } else { 1.0 };
            let in_units = |cells: &[f64]| cells.iter().map(|cell| cell / unit).collect();
            columns.extend(log.channel(&channel).map(|cells| (format!("{quantity}_{seat}"), in_units(cells))));
            noise.extend(log.noise(&channel).map(|sigma| (format!("{quantity}_{seat}"), sigma / unit)));
        }
        for (gain, of) in [("kp", Log::kp as fn(&Log, &str, usize) -> Option<f64>), ("kd", Log::kd)] {
            let cells = (0..log.rows()).map(|row| of(log, name, row).unwrap_or(f64::NAN) / unit).collect();
            columns.insert(format!("{gain}_{seat}"), cells);
        }
    }
    // The base is fixed in all segments, because bodies are not simulated.
    let held = |segment: &Segment| Segment { base: BaseMount::Fixed, ..segment.clone() };
    let meta = Meta {
        joints: JOINT_NAMES[..names.len()].iter().map(ToString::to_string).collect(),
        segments: log.meta().segments.iter().map(held).collect(),
        kp: None,
        kd: None,
        noise,
        ..log.meta().clone()
    };
    Ok(Log::new(meta, columns).expect("a log with renamed joints is valid"))
}
