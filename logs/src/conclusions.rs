//! What a log can tell about each effect that a robot may have and its ideal model lacks.

use serde::Serialize;

use crate::describe::{LogSummary, largest};
use crate::excitation::{Excitation, velocity};
use crate::{BaseMount, Log, TorqueSensor};

/// What a log can tell about one effect.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Identifiability {
    /// The effect's name in the catalogue.
    pub effect: &'static str,
    /// Whether the log can tell.
    pub verdict: IdentifiabilityLevel,
    /// Why, in a sentence.
    pub reason: String,
}

/// Whether a log can tell about an effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum IdentifiabilityLevel {
    /// It holds all that is needed.
    Identifiable,
    /// It holds what is needed, but not what would make it sharp.
    Weak,
    /// It lacks something that is needed.
    NotIdentifiable,
}

/// Something that a log must have for a conclusion.
#[derive(Clone, Copy, Debug)]
enum DataRequirement {
    /// A joint that turns at least four times.
    Reversals,
    /// A joint whose motion reaches a frequency [Hz].
    Bandwidth(f64),
    /// A joint that moves slower than [`CREEP`] for a tenth of the time.
    LowSpeed,
    /// A joint that reaches a fraction of its highest speed.
    Speed(f64),
    /// A joint that reaches a fraction of its highest torque.
    Torque(f64),
    /// A joint that covers a range of position [rad].
    Range(f64),
    /// Measured torque.
    TorqueMeasured,
    /// Rows per second [Hz].
    Rate(f64),
    /// More than one value of kd.
    KdVaries,
    /// More than one value of kp.
    KpVaries,
    /// A span of motor temperature [K].
    Temperature(f64),
    /// A span of the supply's voltage [V].
    Voltage(f64),
    /// A trunk that is free to move.
    Floating,
    /// The trunk's turning, up to a rate [rad/s].
    BaseRotation(f64),
    /// The trunk's orientation.
    Orientation,
    /// The trunk's position or velocity.
    BasePose,
    /// Forces or contacts of the feet.
    FootContact,
}

/// Speeds between which friction at low speed shows [rad/s].
const LOW_SPEED: [f64; 2] = [0.02, 0.3];

/// What one effect needs.
struct Rule {
    effect: &'static str,
    needs: &'static [DataRequirement],
    /// What makes the answer sharp.
    recommended: &'static [DataRequirement],
    /// What else looks like it, and how they are told apart.
    caveat: &'static str,
}

/// Every effect of the catalogue, in the order of the chain from command to motion.
const RULES: [Rule; 25] = {
    use DataRequirement::{
        LowSpeed, Bandwidth, FootContact, Floating, KdVaries, KpVaries, Orientation, BasePose, Range, Rate, Speed, BaseRotation, Temperature,
        Torque, TorqueMeasured, Reversals, Voltage,
    };
    const fn rule(
        effect: &'static str,
        needs: &'static [DataRequirement],
        sharper: &'static [DataRequirement],
        caution: &'static str,
    ) -> Rule {
        Rule { effect, needs, recommended: sharper, caveat: caution }
    }
    [
        rule("command_delay", &[Reversals, Rate(100.0)], &[Bandwidth(2.0)], "armature looks alike in slow motion"),
        rule("encoder_offset", &[Reversals], &[KpVaries], "a constant load looks alike at one kp"),
        rule("torque_saturation", &[Torque(0.6)], &[TorqueMeasured], ""),
        rule("supply_sag", &[Torque(0.4), Voltage(0.5)], &[TorqueMeasured], ""),
        rule("thermal_derating", &[Torque(0.1), Temperature(10.0)], &[TorqueMeasured], ""),
        rule(
            "torque_delay",
            &[Reversals, Rate(200.0)],
            &[Bandwidth(2.0), TorqueMeasured],
            "command_delay differs only where the joint is pushed",
        ),
        rule("torque_speed_limit", &[Speed(0.5)], &[Torque(0.5)], ""),
        rule(
            "drive_lag",
            &[Reversals, Rate(200.0), Bandwidth(2.0)],
            &[TorqueMeasured],
            "its gain falls with frequency, a delay's does not",
        ),
        rule("torque_sensor_delay", &[TorqueMeasured, Reversals, Rate(200.0)], &[Bandwidth(2.0)], ""),
        rule("torque_gain", &[Reversals], &[TorqueMeasured, Torque(0.1)], "a wrong kp or mass looks alike"),
        rule("torque_ripple", &[Range(0.5), Rate(100.0)], &[LowSpeed, TorqueMeasured], ""),
        rule("backlash", &[Reversals, Rate(200.0)], &[LowSpeed, TorqueMeasured], "it shows where the load changes its sign"),
        rule("joint_elasticity", &[Rate(500.0), Bandwidth(5.0)], &[TorqueMeasured], ""),
        rule("coulomb_friction", &[Reversals], &[TorqueMeasured], ""),
        rule("viscous_friction", &[Reversals, Speed(0.03)], &[KdVaries], "at one kd it is the same as a wrong kd"),
        rule("stribeck_friction", &[Reversals, LowSpeed], &[TorqueMeasured], ""),
        rule(
            "load_friction",
            &[Reversals, Torque(0.15)],
            &[TorqueMeasured],
            "only loads that differ tell it from coulomb_friction",
        ),
        rule(
            "armature",
            &[Reversals, Rate(100.0), Bandwidth(1.0)],
            &[Bandwidth(3.0)],
            "a delay looks alike: two spectra, or the first 10 ms of a step, tell them apart",
        ),
        rule("joint_spring", &[Range(0.5)], &[TorqueMeasured], ""),
        rule("payload", &[Floating], &[TorqueMeasured], "a load on a leg shows with the trunk held too"),
        rule("com_shift", &[Floating], &[Orientation, TorqueMeasured], ""),
        rule("inertia", &[Floating, BaseRotation(1.0)], &[Orientation], ""),
        rule("ground_friction", &[Floating], &[BasePose], "only feet that slip tell its size"),
        rule("ground_stiffness", &[Floating, Rate(200.0)], &[FootContact], ""),
        rule("gyro_bias", &[BaseRotation(0.0)], &[Orientation], ""),
    ]
};

/// What the log can tell about each effect; empty for a motion, in which nothing was measured.
pub(crate) fn conclusions(log: &Log, description: &LogSummary) -> Vec<Identifiability> {
    if log.joints().iter().all(|joint| log.q(joint).is_none()) {
        return Vec::new();
    }
    let evidence = LogFeatures { log, description };
    RULES.iter().map(|rule| rule.judge(&evidence)).collect()
}

impl Rule {
    fn judge(&self, evidence: &LogFeatures<'_>) -> Identifiability {
        let mut met = Vec::new();
        for need in self.needs {
            match evidence.check(*need) {
                Ok(found) => met.push(found),
                Err(because) => return Identifiability { effect: self.effect, verdict: IdentifiabilityLevel::NotIdentifiable, reason: because },
            }
        }
        let blunt = self.recommended.iter().find_map(|need| evidence.check(*need).err());
        let verdict = if blunt.is_some() { IdentifiabilityLevel::Weak } else { IdentifiabilityLevel::Identifiable };
        let caution = Some(self.caveat.to_owned()).filter(|caution| !caution.is_empty());
        // What is lacking matters more than what is there.
        let reasons = if blunt.is_some() { vec![blunt, caution] } else { vec![Some(met.join(", ")), caution] };
        let because = reasons.into_iter().flatten().collect::<Vec<_>>().join("; ");
        Identifiability { effect: self.effect, verdict, reason: because }
    }
}

/// What is known of a log.
struct LogFeatures<'a> {
    log: &'a Log,
    description: &'a LogSummary,
}

impl LogFeatures<'_> {
    /// What meets a need, or else what is missing and how to get it.
    fn check(&self, need: DataRequirement) -> Result<String, String> {
        let joints = &self.description.joints;
        let share = |of: fn(&Excitation) -> Option<(f64, f64)>| {
            let ratio = |joint: &Excitation| of(joint).map(|(reached, limit)| (reached / limit, joint.joint.clone()));
            joints.iter().filter_map(ratio).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, String::new()))
        };
        match need {
            DataRequirement::Reversals => {
                let turning: Vec<_> =
                    joints.iter().filter(|joint| joint.reversals >= 4).map(|joint| joint.joint.as_str()).collect();
                let found = self.some_of(&turning, ["moves both ways", "move both ways"]);
                found.ok_or_else(|| "no joint turns four times: move it back and forth".to_owned())
            }
            DataRequirement::Bandwidth(hz) => {
                let reached = joints.iter().filter_map(|joint| joint.band_hz).map(|band| band[1]).fold(0.0, f64::max);
                let few = || format!("motion reaches {reached:.1} Hz only: move at {hz} Hz or more");
                if reached >= hz { Ok(format!("motion reaches {reached:.1} Hz")) } else { Err(few()) }
            }
            DataRequirement::LowSpeed => {
                let slow: Vec<_> =
                    joints.iter().map(|joint| joint.joint.as_str()).filter(|joint| self.creeps(joint)).collect();
                let found = self.some_of(&slow, ["creeps below 0.3 rad/s", "creep below 0.3 rad/s"]);
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
                let few = || format!("positions span {reached:.2} rad only: span {radians} rad or more");
                if reached >= radians { Ok(format!("positions span up to {reached:.2} rad")) } else { Err(few()) }
            }
            DataRequirement::TorqueMeasured => {
                let measured = self.log.meta().tau_sensor != TorqueSensor::None && self.holds("tau_measured");
                need_channel(measured, "torque was measured", "no torque was measured: motion alone must show it")
            }
            DataRequirement::Rate(hz) => {
                let rate = self.description.timing.rate_hz.unwrap_or(0.0);
                let few = || format!("{rate:.0} Hz is too slow: record at {hz} Hz or more");
                if rate >= 0.98 * hz { Ok(format!("recorded at {rate:.0} Hz")) } else { Err(few()) }
            }
            DataRequirement::KdVaries => need_channel(
                self.varies(Log::kd),
                "kd takes several values",
                "kd never changes: repeat the motion at another kd",
            ),
            DataRequirement::KpVaries => need_channel(
                self.varies(Log::kp),
                "kp takes several values",
                "kp never changes: repeat the motion at another kp",
            ),
            DataRequirement::Temperature(kelvin) => self.span("temp", kelvin, "K", "motor temperature"),
            DataRequirement::Voltage(volts) => self.span("battery_V", volts, "V", "the supply"),
            DataRequirement::Floating => {
                let free = self.description.segments.iter().filter(|segment| segment.base == BaseMount::Floating);
                let seconds = free.map(|segment| segment.duration_s).sum::<f64>();
                need_channel(
                    seconds > 0.0,
                    &format!("the trunk is free for {seconds:.1} s"),
                    "the trunk is held: record a floating base",
                )
            }
            DataRequirement::BaseRotation(rate) => {
                let axes = ["gyro_x", "gyro_y", "gyro_z"].map(|axis| self.log.channel(axis));
                let reached = largest(axes.into_iter().flatten().flatten().map(|rate| rate.abs()));
                match reached {
                    None => Err("no gyro was recorded".to_owned()),
                    Some(reached) if reached < rate => {
                        Err(format!("the trunk turns at {reached:.2} rad/s only: tilt it at {rate} rad/s or more"))
                    }
                    Some(reached) => Ok(format!("the gyro reaches {reached:.2} rad/s")),
                }
            }
            DataRequirement::Orientation => need_channel(
                self.holds("quat"),
                "the trunk's orientation is known",
                "no orientation (quat) was recorded",
            ),
            DataRequirement::BasePose => need_channel(
                self.holds("pos") || self.holds("vel"),
                "the trunk's path is known",
                "no path (pos, vel) was recorded",
            ),
            DataRequirement::FootContact => need_channel(
                self.holds("foot_force") || self.holds("contact"),
                "the feet's load is known",
                "no foot_force or contact was recorded",
            ),
        }
    }

    fn holds(&self, quantity: &str) -> bool {
        self.description.channels.iter().any(|channel| channel.quantity == quantity)
    }

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

    fn creeps(&self, joint: &str) -> bool {
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
                Err(format!("{what} spans {span:.1} {unit} only: {least} {unit} or more are needed"))
            }
            Some(span) => Ok(format!("{what} spans {span:.1} {unit}")),
        }
    }
}

fn need_channel(there: bool, found: &str, missing: &str) -> Result<String, String> {
    if there { Ok(found.to_owned()) } else { Err(missing.to_owned()) }
}

fn reaches(reached: f64, least: f64, joint: &str, what: &str) -> Result<String, String> {
    if joint.is_empty() {
        return Err(format!("the joints' highest {what} is not known"));
    }
    let (percent, least_percent) = (100.0 * reached, 100.0 * least);
    if reached >= least {
        return Ok(format!("{joint} reaches {percent:.0} % of its highest {what}"));
    }
    Err(format!("no joint passes {percent:.0} % of its highest {what}: reach {least_percent:.0} % or more"))
}

#[cfg(test)]
mod tests {
    use twinstep_model::effects::{CATALOGUE, Effect};

    use super::RULES;

    #[test]
    fn there_is_a_rule_for_each_effect_of_the_catalogue_in_its_order() {
        assert_eq!(RULES.map(|rule| rule.effect), CATALOGUE.map(|effect| effect.name));
    }

    #[test]
    fn names_in_cautions_are_in_the_catalogue() {
        for rule in RULES {
            let words = rule.caveat.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '_');
            for word in words.filter(|word| word.contains('_')) {
                assert!(Effect::named(word).is_some(), "the caution of `{}` names `{word}`", rule.effect);
            }
        }
    }
}
