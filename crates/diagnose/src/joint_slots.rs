//! Joints of any robot, at most twelve, in the slots of the Go2's: what their actuators make of measured states and commands,
//! which no simulation of a body is needed for.

use std::collections::BTreeMap;

use rayon::prelude::*;
use twinstep_effects::{EffectEntry, Scope, apply_effects};
use twinstep_logs::{Log, Meta, Segment};
use twinstep_model::{BaseMount, JOINT_NAMES, Joint, RobotModel, go2};

use super::residual_data::torque_sigma;
use super::residual_power::{ResidualPower, TORQUE};
use super::residual_rows::fold_of;
use twinstep_identify::torque::MeasuredTorque;
use twinstep_logs::replay::ReplayError;

/// Quantities of a joint that its actuator's torque is made of.
const QUANTITIES: [&str; 7] = ["q", "dq", "q_cmd", "dq_cmd", "tau_ff", "tau_measured", "temp"];
/// The largest torque in the slots, which a Go2's actuator has too: what is plausible of its friction then is of any.
const LARGEST_NM: f64 = 20.0;
/// Torques this long apart [s] are independent.
const INDEPENDENT_S: f64 = 0.1;

/// Joints in slots.
pub struct JointSlots {
    /// Their own names.
    names: Vec<String>,
    /// Whether these are all joints of the robot.
    whole: bool,
    /// The logs with the joints in their slots, and nothing else.
    logs: Vec<Log>,
    torques: Vec<MeasuredTorque>,
    /// What a unit of torque in the slots is [N·m].
    pub torque_scale: f64,
    /// An ideal actuator in every seat, without limits, that ticks with the rows of the logs.
    ideal: RobotModel,
}

impl JointSlots {
    /// The joints `names` of `logs`.
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
        Ok(Self { names: names.to_vec(), whole, logs, torques, ideal, torque_scale: unit })
    }

    /// What a cause may be about: all joints, or one.
    pub fn scopes(&self) -> Vec<Scope> {
        let single = Joint::ALL.into_iter().take(self.names.len()).map(Scope::Joint);
        std::iter::once(Scope::All).filter(|_| self.names.len() > 1).chain(single).collect()
    }

    /// Seats of a scope.
    pub fn of(&self, scope: Scope) -> impl Iterator<Item = usize> {
        (0..self.names.len()).filter(move |seat| scope.contains(Joint::ALL[*seat]))
    }

    /// A scope by the joints' own names.
    pub fn scope_name(&self, scope: Scope) -> String {
        match scope {
            Scope::Joint(joint) => self.names[joint.index()].clone(),
            // Others of the robot were looked at apart.
            _ if !self.whole => self.names.join("+"),
            scope => scope.to_string(),
        }
    }

    /// A joint's own name.
    pub fn name(&self, seat: usize) -> &str {
        &self.names[seat]
    }

    /// Returns the highest rate of the logs [Hz].
    fn max_rate_hz(&self) -> f64 {
        self.logs.iter().map(|log| log.meta().rate_hz).fold(0.0, f64::max)
    }

    /// Rows that count as one.
    pub fn rows_in_one(&self) -> f64 {
        (INDEPENDENT_S * self.max_rate_hz()).max(1.0)
    }

    /// Actuators with these effects; none that are no actuators.
    pub fn robot(&self, entries: &[EffectEntry]) -> Option<RobotModel> {
        apply_effects(&self.ideal, entries).ok()
    }

    /// Whether an effect shows in torques at all, where the sensor is.
    pub fn affects_torque(&self, robot: &RobotModel, other: &RobotModel) -> bool {
        self.torques.iter().any(|torques| !torques.predict_same_torque(robot, other))
    }

    /// What candidates leave of the torques.
    pub fn residual_powers(&self, robots: &[RobotModel]) -> Vec<ResidualPower> {
        let left = |robot: &RobotModel| {
            let mut left = ResidualPower::empty();
            for (log, torques) in self.logs.iter().zip(&self.torques) {
                let sigma = torque_sigma(log, &self.ideal);
                torques.differences(robot, |seat, row, difference| {
                    left.add(TORQUE + seat, fold_of(log, row), difference / sigma[seat]);
                });
            }
            left
        };
        robots.par_iter().map(left).collect()
    }

    /// Sums of squares of what `robot` leaves on the seconds that are set aside, and of noise alone [N²·m²]; and rows.
    pub fn held_out_sums(&self, robot: &RobotModel) -> [f64; 3] {
        let (mut squares, mut noise, mut rows) = (0.0, 0.0, 0.0);
        for (log, torques) in self.logs.iter().zip(&self.torques) {
            let sigma = torque_sigma(log, &self.ideal);
            torques.differences(robot, |seat, row, difference| {
                if fold_of(log, row).is_none() {
                    squares += difference * difference;
                    noise += sigma[seat] * sigma[seat];
                    rows += 1.0;
                }
            });
        }
        [self.torque_scale * self.torque_scale * squares, self.torque_scale * self.torque_scale * noise, rows]
    }

    /// What `robot` leaves of the torque of a seat in the first log, by row; not a number where nothing was measured.
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

/// `log` with `names` in their slots, torques in units of `unit` [N·m], and nothing else but the supply.
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
    // No body moves here: whatever held it, its joints are measured.
    let held = |segment: &Segment| Segment { base: BaseMount::Fixed, ..segment.clone() };
    let meta = Meta {
        joints: JOINT_NAMES[..names.len()].iter().map(ToString::to_string).collect(),
        segments: log.meta().segments.iter().map(held).collect(),
        kp: None,
        kd: None,
        noise,
        ..log.meta().clone()
    };
    Ok(Log::new(meta, columns).expect("a log with other names is one"))
}
