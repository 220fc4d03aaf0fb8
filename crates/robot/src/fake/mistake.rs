//! Mistakes of wiring and of software between the robot and its user, as lines of text.

use std::fmt;
use std::str::FromStr;

use twinstep_model::{Joint, Leg};

/// Mistake of wiring, mounting or software. Its text, such as `encoder dead RR_thigh`, is read by [`str::parse`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Mistake {
    /// Motors and encoders of two legs are exchanged.
    LegsSwapped(Leg, Leg),
    /// Only the commands of two legs are exchanged, not their encoders.
    CommandsSwapped(Leg, Leg),
    /// A joint has the opposite sign, in commands and encoder.
    JointMirrored(Joint),
    /// The encoder has the opposite sign, the command has not.
    EncoderSign(Joint),
    /// The encoder's reading is multiplied by a factor.
    EncoderScale(Joint, f32),
    /// Every encoder's reading is in degrees.
    EncoderDegrees,
    /// The zero of a joint is wrong by this angle, in commands and encoder [rad].
    JointOffset(Joint, f32),
    /// The encoder's reading is wrong by this angle, the command is not [rad].
    EncoderOffset(Joint, f32),
    /// The encoder's reading does not change.
    EncoderDead(Joint),
    /// The motor holds its position and executes no commands.
    MotorFrozen(Joint),
    /// The motor has no torque.
    MotorDead(Joint),
    /// The motor's torque is multiplied by a factor.
    MotorWeak(Joint, f32),
    /// The motor uses gains of an earlier configuration.
    GainsStale(Joint),
    /// The velocity has the opposite sign.
    VelocitySign(Joint),
    /// The velocity is multiplied by a factor.
    VelocityScale(Joint, f32),
    /// The estimated torque has the opposite sign.
    TorqueSign(Joint),
    /// The quaternion is x, y, z, w.
    QuaternionXyzw,
    /// The quaternion is the rotation base-from-world.
    QuaternionInverted,
    /// The x and y axes of the gyroscope are exchanged.
    GyroSwapped,
    /// The gyroscope is in degrees per second.
    GyroDegrees,
    /// An axis (x, y) of the gyroscope has the opposite sign.
    GyroSign(Axis),
    /// The accelerometer is in units of g.
    AccelerometerG,
    /// The accelerometer has the opposite sign.
    AccelerometerSign,
    /// The inertial measurement unit is turned about z by a multiple of 90° [°].
    ImuTurned(u16),
    /// The inertial measurement unit is turned about x by 180°.
    ImuUpsideDown,
    /// States arrive at 50 Hz.
    StatesSlow,
    /// The robot's clock stands still.
    ClockStopped,
    /// The checksums of the states are wrong.
    ChecksumWrong,
}

/// Horizontal axis of the base frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axis {
    /// Forward.
    X,
    /// Left.
    Y,
}

impl Axis {
    /// Returns the axis's name.
    pub fn name(self) -> &'static str {
        if self == Axis::X { "x" } else { "y" }
    }
}

/// Forms of the lines.
const FORMS: &str = "legs swapped LEG LEG, commands swapped LEG LEG, joint mirrored JOINT, encoder sign JOINT, encoder \
                     scale JOINT FACTOR, encoder degrees, joint offset JOINT RAD, encoder offset JOINT RAD, encoder \
                     dead JOINT, motor frozen JOINT, motor dead JOINT, motor weak JOINT FACTOR, gains stale JOINT, \
                     velocity sign JOINT, velocity scale JOINT FACTOR, torque sign JOINT, quaternion xyzw, quaternion \
                     inverted, gyro swapped, gyro degrees, gyro sign x|y, accelerometer g, accelerometer sign, imu \
                     turned 90|180|270, imu upside down, states slow, clock stopped, checksum wrong";

/// A line is no mistake.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{line}` is no mistake; write one of: {FORMS}")]
pub struct UnknownMistake {
    /// The line.
    pub line: String,
}

impl FromStr for Mistake {
    type Err = UnknownMistake;

    fn from_str(line: &str) -> Result<Self, UnknownMistake> {
        let words: Vec<_> = line.split_whitespace().collect();
        parse(&words).ok_or_else(|| UnknownMistake { line: line.trim().to_owned() })
    }
}

fn parse(words: &[&str]) -> Option<Mistake> {
    let joint = |name: &str| name.parse::<Joint>().ok();
    let leg = |name: &str| Leg::ALL.into_iter().find(|leg| leg.name() == name);
    let number = |text: &str| text.parse::<f32>().ok().filter(|number| number.is_finite());
    let pair = |first, second| Some((leg(first)?, leg(second)?)).filter(|(first, second)| first != second);
    Some(match *words {
        ["legs", "swapped", first, second] => pair(first, second).map(|(a, b)| Mistake::LegsSwapped(a, b))?,
        ["commands", "swapped", first, second] => pair(first, second).map(|(a, b)| Mistake::CommandsSwapped(a, b))?,
        ["joint", "mirrored", name] => Mistake::JointMirrored(joint(name)?),
        ["encoder", "sign", name] => Mistake::EncoderSign(joint(name)?),
        ["encoder", "scale", name, factor] => Mistake::EncoderScale(joint(name)?, number(factor)?),
        ["encoder", "degrees"] => Mistake::EncoderDegrees,
        ["joint", "offset", name, angle] => Mistake::JointOffset(joint(name)?, number(angle)?),
        ["encoder", "offset", name, angle] => Mistake::EncoderOffset(joint(name)?, number(angle)?),
        ["encoder", "dead", name] => Mistake::EncoderDead(joint(name)?),
        ["motor", "frozen", name] => Mistake::MotorFrozen(joint(name)?),
        ["motor", "dead", name] => Mistake::MotorDead(joint(name)?),
        ["motor", "weak", name, factor] => Mistake::MotorWeak(joint(name)?, number(factor)?),
        ["gains", "stale", name] => Mistake::GainsStale(joint(name)?),
        ["velocity", "sign", name] => Mistake::VelocitySign(joint(name)?),
        ["velocity", "scale", name, factor] => Mistake::VelocityScale(joint(name)?, number(factor)?),
        ["torque", "sign", name] => Mistake::TorqueSign(joint(name)?),
        ["quaternion", "xyzw"] => Mistake::QuaternionXyzw,
        ["quaternion", "inverted"] => Mistake::QuaternionInverted,
        ["gyro", "swapped"] => Mistake::GyroSwapped,
        ["gyro", "degrees"] => Mistake::GyroDegrees,
        ["gyro", "sign", "x"] => Mistake::GyroSign(Axis::X),
        ["gyro", "sign", "y"] => Mistake::GyroSign(Axis::Y),
        ["accelerometer", "g"] => Mistake::AccelerometerG,
        ["accelerometer", "sign"] => Mistake::AccelerometerSign,
        ["imu", "turned", degrees @ ("90" | "180" | "270")] => Mistake::ImuTurned(degrees.parse().ok()?),
        ["imu", "upside", "down"] => Mistake::ImuUpsideDown,
        ["states", "slow"] => Mistake::StatesSlow,
        ["clock", "stopped"] => Mistake::ClockStopped,
        ["checksum", "wrong"] => Mistake::ChecksumWrong,
        _ => return None,
    })
}

impl fmt::Display for Mistake {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Mistake::LegsSwapped(first, second) => {
                write!(formatter, "legs swapped {} {}", first.name(), second.name())
            }
            Mistake::CommandsSwapped(first, second) => {
                write!(formatter, "commands swapped {} {}", first.name(), second.name())
            }
            Mistake::JointMirrored(joint) => write!(formatter, "joint mirrored {joint}"),
            Mistake::EncoderSign(joint) => write!(formatter, "encoder sign {joint}"),
            Mistake::EncoderScale(joint, factor) => write!(formatter, "encoder scale {joint} {factor}"),
            Mistake::EncoderDegrees => formatter.write_str("encoder degrees"),
            Mistake::JointOffset(joint, angle) => write!(formatter, "joint offset {joint} {angle}"),
            Mistake::EncoderOffset(joint, angle) => write!(formatter, "encoder offset {joint} {angle}"),
            Mistake::EncoderDead(joint) => write!(formatter, "encoder dead {joint}"),
            Mistake::MotorFrozen(joint) => write!(formatter, "motor frozen {joint}"),
            Mistake::MotorDead(joint) => write!(formatter, "motor dead {joint}"),
            Mistake::MotorWeak(joint, factor) => write!(formatter, "motor weak {joint} {factor}"),
            Mistake::GainsStale(joint) => write!(formatter, "gains stale {joint}"),
            Mistake::VelocitySign(joint) => write!(formatter, "velocity sign {joint}"),
            Mistake::VelocityScale(joint, factor) => write!(formatter, "velocity scale {joint} {factor}"),
            Mistake::TorqueSign(joint) => write!(formatter, "torque sign {joint}"),
            Mistake::QuaternionXyzw => formatter.write_str("quaternion xyzw"),
            Mistake::QuaternionInverted => formatter.write_str("quaternion inverted"),
            Mistake::GyroSwapped => formatter.write_str("gyro swapped"),
            Mistake::GyroDegrees => formatter.write_str("gyro degrees"),
            Mistake::GyroSign(axis) => write!(formatter, "gyro sign {}", axis.name()),
            Mistake::AccelerometerG => formatter.write_str("accelerometer g"),
            Mistake::AccelerometerSign => formatter.write_str("accelerometer sign"),
            Mistake::ImuTurned(degrees) => write!(formatter, "imu turned {degrees}"),
            Mistake::ImuUpsideDown => formatter.write_str("imu upside down"),
            Mistake::StatesSlow => formatter.write_str("states slow"),
            Mistake::ClockStopped => formatter.write_str("clock stopped"),
            Mistake::ChecksumWrong => formatter.write_str("checksum wrong"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns one line of each form.
    fn lines() -> Vec<String> {
        let words = |form: &str| {
            form.replace("LEG LEG", "FL RR")
                .replace("JOINT", "RR_thigh")
                .replace("FACTOR", "0.5")
                .replace("RAD", "-0.25")
                .replace("x|y", "y")
                .replace("90|180|270", "270")
        };
        FORMS.split(", ").map(words).collect()
    }

    #[test]
    fn every_form_is_read_and_written() {
        assert_eq!(lines().len(), 28);
        for line in lines() {
            let mistake: Mistake = line.parse().expect("a mistake");
            assert_eq!(mistake.to_string(), line);
        }
    }

    #[test]
    fn wrong_line_is_named_with_what_is_possible() {
        for line in [
            "",
            "encoder dead",
            "encoder dead FL_knee",
            "legs swapped FL FL",
            "joint offset FL_hip nan",
            "imu turned 45",
        ] {
            let text = line.parse::<Mistake>().expect_err("wrong").to_string();
            assert!(text.starts_with(&format!("`{line}` is no mistake")) && text.contains("clock stopped"), "{text}");
        }
    }
}
