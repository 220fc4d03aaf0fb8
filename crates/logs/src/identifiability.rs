//! Identifiability of each effect of the catalogue from a log.

use twinstep_effects::{CATALOGUE, DataRequirement, Effect, LOW_SPEED};

use crate::excitation::{Excitation, velocity};
use crate::statistics::largest;
use crate::summary::{Identifiability, IdentifiabilityLevel, LogSummary};
use crate::{Log, TorqueSensor};
use twinstep_model::BaseMount;

/// Returns the identifiability of each effect; empty for a motion file, which has no measurements.
pub(crate) fn conclusions(log: &Log, description: &LogSummary) -> Vec<Identifiability> {
    if log.joints().iter().all(|joint| log.q(joint).is_none()) {
        return Vec::new();
    }
    let measured_hz = log.repeats().map(|repeats| repeats.rate_hz);
    let features = LogFeatures { log, description, measured_hz };
    CATALOGUE.iter().map(|effect| identifiability(effect, &features)).collect()
}

fn identifiability(effect: &Effect, features: &LogFeatures<'_>) -> Identifiability {
    let mut met = Vec::new();
    for need in effect.needs {
        match features.check(*need) {
            Ok(found) => met.push(found),
            Err(reason) => {
                return Identifiability { effect: effect.name, verdict: IdentifiabilityLevel::NotIdentifiable, reason };
            }
        }
    }
    let missing = effect.recommended.iter().find_map(|need| features.check(*need).err());
    let verdict = if missing.is_some() { IdentifiabilityLevel::Weak } else { IdentifiabilityLevel::Identifiable };
    let caveat = Some(effect.caveat.to_owned()).filter(|caveat| !caveat.is_empty());
    // A missing recommendation is reported instead of the requirements that are met.
    let reasons = if missing.is_some() { vec![missing, caveat] } else { vec![Some(met.join(", ")), caveat] };
    let reason = reasons.into_iter().flatten().collect::<Vec<_>>().join("; ");
    Identifiability { effect: effect.name, verdict, reason }
}

/// A log and its summary.
struct LogFeatures<'a> {
    log: &'a Log,
    description: &'a LogSummary,
    /// Rate of the measurements, if sensors repeat [Hz].
    measured_hz: Option<f64>,
}

impl LogFeatures<'_> {
    /// Returns how the log meets a requirement, or as error what is missing and how to record it.
    fn check(&self, need: DataRequirement) -> Result<String, String> {
        let joints = &self.description.joints;
        let share = |of: fn(&Excitation) -> Option<(f64, f64)>| {
            let ratio = |joint: &Excitation| of(joint).map(|(reached, limit)| (reached / limit, joint.joint.clone()));
            joints.iter().filter_map(ratio).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, String::new()))
        };
        match need {
            DataRequirement::Reversals => {
                let reversing: Vec<_> =
                    joints.iter().filter(|joint| joint.reversals >= 4).map(|joint| joint.joint.as_str()).collect();
                let found = self.some_of(&reversing, ["moves in both directions", "move in both directions"]);
                found.ok_or_else(|| "no joint reverses four times: move one back and forth".to_owned())
            }
            DataRequirement::Bandwidth(hz) => {
                let reached = joints.iter().filter_map(|joint| joint.band_hz).map(|band| band[1]).fold(0.0, f64::max);
                let too_low = || format!("motion reaches only {reached:.1} Hz: move at {hz} Hz or more");
                if reached >= hz { Ok(format!("motion reaches {reached:.1} Hz")) } else { Err(too_low()) }
            }
            DataRequirement::LowSpeed => {
                let slow: Vec<_> =
                    joints.iter().map(|joint| joint.joint.as_str()).filter(|joint| self.moves_slowly(joint)).collect();
                let found = self.some_of(&slow, ["moves slower than 0.3 rad/s", "move slower than 0.3 rad/s"]);
                found.ok_or_else(|| "no joint moves slowly: add motion of 0.02 to 0.3 rad/s".to_owned())
            }
            DataRequirement::Speed(least) => {
                let (reached, joint) = share(|joint| joint.speed_max.zip(joint.speed_limit));
                reaches(reached, least, &joint, "speed")
            }
            DataRequirement::Torque(least) => {
                let (reached, joint) = share(|joint| joint.torque_max.zip(joint.torque_limit));
                reaches(reached, least, &joint, "torque")
            }
            DataRequirement::Range(radians) => {
                let reached = joints.iter().map(|joint| joint.q_max - joint.q_min).fold(0.0, f64::max);
                let too_small = || format!("positions span only {reached:.2} rad: span {radians} rad or more");
                if reached >= radians { Ok(format!("positions span up to {reached:.2} rad")) } else { Err(too_small()) }
            }
            DataRequirement::TorqueMeasured => {
                let measured = self.log.meta().tau_sensor != TorqueSensor::None && self.has_channel("tau_measured");
                need_channel(measured, "torque was measured", "torque was not measured: only motion is available")
            }
            DataRequirement::Rate(hz) => {
                let of_rows = self.description.timing.rate_hz.unwrap_or(0.0);
                let rate = self.measured_hz.unwrap_or(of_rows);
                let too_low = || match self.measured_hz {
                    Some(rate) => format!("the sensors repeat: measured at {rate:.0} Hz; {hz} Hz or more are needed"),
                    None => format!("a rate of {rate:.0} Hz is too low: record at {hz} Hz or more"),
                };
                if rate >= 0.98 * hz { Ok(format!("recorded at {rate:.0} Hz")) } else { Err(too_low()) }
            }
            DataRequirement::KdVaries => need_channel(
                self.varies(Log::kd),
                "kd has several values",
                "kd is constant: repeat the motion with another kd",
            ),
            DataRequirement::KpVaries => need_channel(
                self.varies(Log::kp),
                "kp has several values",
                "kp is constant: repeat the motion with another kp",
            ),
            DataRequirement::Temperature(kelvin) => self.span("temp", kelvin, "K", "motor temperature"),
            DataRequirement::Voltage(volts) => self.span("battery_V", volts, "V", "supply voltage"),
            DataRequirement::Floating => {
                let floating = self.description.segments.iter().filter(|segment| segment.base == BaseMount::Floating);
                let seconds = floating.map(|segment| segment.duration_s).sum::<f64>();
                need_channel(
                    seconds > 0.0,
                    &format!("the base is floating for {seconds:.1} s"),
                    "the base is fixed: record a floating base",
                )
            }
            DataRequirement::BaseRotation(rate) => {
                let axes = ["gyro_x", "gyro_y", "gyro_z"].map(|axis| self.log.channel(axis));
                let reached = largest(axes.into_iter().flatten().flatten().map(|rate| rate.abs()));
                match reached {
                    None => Err("no gyro was recorded".to_owned()),
                    Some(reached) if reached < rate => {
                        Err(format!("the base rotates at only {reached:.2} rad/s: rotate it at {rate} rad/s or more"))
                    }
                    Some(reached) => Ok(format!("the gyro reaches {reached:.2} rad/s")),
                }
            }
            DataRequirement::Orientation => need_channel(
                self.has_channel("quat"),
                "the base orientation was measured",
                "no orientation (quat) was recorded",
            ),
            DataRequirement::BasePose => need_channel(
                self.has_channel("pos") || self.has_channel("vel"),
                "the base position or velocity was measured",
                "no base position or velocity (pos, vel) was recorded",
            ),
            DataRequirement::FootContact => need_channel(
                self.has_channel("foot_force") || self.has_channel("contact"),
                "foot forces or contacts were measured",
                "no foot_force or contact was recorded",
            ),
        }
    }

    fn has_channel(&self, quantity: &str) -> bool {
        self.description.channels.iter().any(|channel| channel.quantity == quantity)
    }

    /// Returns a phrase with the joints and the singular or plural verb, or `None` without joints.
    fn some_of(&self, joints: &[&str], [moves, move_]: [&str; 2]) -> Option<String> {
        let all = self.description.joints.len();
        match joints.len() {
            0 => None,
            1 => Some(format!("{} {moves}", joints[0])),
            count if count == all => Some(format!("all {all} joints {move_}")),
            count if count <= 3 => Some(format!("{} {move_}", joints.join(", "))),
            count => Some(format!("{count} of {all} joints {move_}")),
        }
    }

    fn moves_slowly(&self, joint: &str) -> bool {
        let Some(q) = self.log.q(joint) else { return false };
        let (velocity, _) = velocity(self.log, joint, q);
        let rows = velocity.iter().map(Vec::len).sum::<usize>();
        let slow = velocity.iter().flatten().filter(|(_, dq)| (LOW_SPEED[0]..LOW_SPEED[1]).contains(&dq.abs())).count();
        slow * 10 > rows
    }

    fn varies(&self, gain: fn(&Log, &str, usize) -> Option<f64>) -> bool {
        self.log.joints().iter().any(|joint| {
            let first = gain(self.log, joint, 0);
            (1..self.log.rows()).any(|row| gain(self.log, joint, row) != first)
        })
    }

    fn span(&self, quantity: &str, least: f64, unit: &str, what: &str) -> Result<String, String> {
        let of = |name: &str| name == quantity || name.strip_prefix(quantity).is_some_and(|rest| rest.starts_with('_'));
        let spans =
            self.log.channels().filter(|(name, _)| of(name)).filter_map(|(_, cells)| {
                Some(largest(cells.iter().copied())? + largest(cells.iter().map(|cell| -cell))?)
            });
        match largest(spans) {
            None => Err(format!("no {quantity} was recorded")),
            Some(span) if span < least => {
                Err(format!("{what} spans only {span:.1} {unit}: {least} {unit} or more are needed"))
            }
            Some(span) => Ok(format!("{what} spans {span:.1} {unit}")),
        }
    }
}

fn need_channel(exists: bool, found: &str, missing: &str) -> Result<String, String> {
    if exists { Ok(found.to_owned()) } else { Err(missing.to_owned()) }
}

fn reaches(reached: f64, least: f64, joint: &str, what: &str) -> Result<String, String> {
    if joint.is_empty() {
        return Err(format!("the {what} limits of the joints are unknown"));
    }
    let (percent, least_percent) = (100.0 * reached, 100.0 * least);
    if reached >= least {
        return Ok(format!("{joint} reaches {percent:.0} % of its {what} limit"));
    }
    Err(format!("no joint exceeds {percent:.0} % of its {what} limit: reach {least_percent:.0} % or more"))
}
