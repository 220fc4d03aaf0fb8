//! Faults of the robot and its surroundings, as lines of text.

use std::fmt;
use std::str::FromStr;

use twinstep_model::Joint;

use super::mistake::{Mistake, UnknownMistake};
use super::remote::RemoteControl;

/// Fault, or its end. Its text, such as `heat FL_calf 90`, is read by [`str::parse`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FakeFault {
    /// A motor has this temperature, and cools from then on [°C].
    Heat(Joint, i8),
    /// The battery has this charge [%].
    Battery(u8),
    /// The supply voltage stays at this value [V].
    Voltage(f32),
    /// The remote control does this.
    Remote(RemoteControl),
    /// No states are made for this time [ms].
    Stale(u64),
    /// This share of the states is lost, 0 to 1.
    Loss(f32),
    /// States are this late [ms].
    Delay(u64),
    /// Every second state is published after the one that follows it.
    Reorder,
    /// The robot lies on its side.
    Fall,
    /// Somebody lays the robot on its belly.
    SetUpright,
    /// Battery taken out: no states, limp motors.
    PowerCut,
    /// Motors do not receive the main board's messages.
    MessagesLost,
    /// A joint is beyond its end.
    JointOut(Joint),
    /// Another process writes to `rt/lowcmd`, or stops.
    ForeignWriter(bool),
    /// The built-in controller starts, or is released.
    Controller(bool),
    /// A mistake of wiring, mounting or software.
    Mistake(Mistake),
    /// Every fault and mistake ends; temperature, charge and pose stay.
    Clear,
}

/// Forms of the lines.
const FORMS: &str = "heat JOINT CELSIUS, battery PERCENT, voltage VOLTS, remote lost, remote none, remote BUTTONS, \
                     remote stick LX LY RX, stale MS, loss SHARE, delay MS, \
                     reorder, fall, set upright, power cut, messages lost, joint out JOINT, foreign writer on|off, controller \
                     on|off, mistake LINE, clear";

/// A line is no fault.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UnknownFault {
    /// The line has none of the forms.
    #[error("`{line}` is no fault; write one of: {FORMS}")]
    Form {
        /// The line.
        line: String,
    },
    /// The line is for a mistake that does not exist.
    #[error(transparent)]
    Mistake(#[from] UnknownMistake),
}

impl FromStr for FakeFault {
    type Err = UnknownFault;

    fn from_str(line: &str) -> Result<Self, UnknownFault> {
        let line = line.trim();
        if let Some(mistake) = line.strip_prefix("mistake ") {
            return Ok(FakeFault::Mistake(mistake.parse()?));
        }
        let words: Vec<_> = line.split_whitespace().collect();
        parse(&words).ok_or_else(|| UnknownFault::Form { line: line.to_owned() })
    }
}

fn parse(words: &[&str]) -> Option<FakeFault> {
    let joint = |name: &str| name.parse::<Joint>().ok();
    let within = |text: &str, low: f32, high: f32| text.parse().ok().filter(|value| (low..=high).contains(value));
    let switch = |text: &str| match text {
        "on" => Some(true),
        "off" => Some(false),
        _ => None,
    };
    Some(match *words {
        ["heat", name, celsius] => FakeFault::Heat(joint(name)?, celsius.parse().ok()?),
        ["battery", percent] => FakeFault::Battery(percent.parse().ok().filter(|percent| *percent <= 100)?),
        ["voltage", volts] => FakeFault::Voltage(within(volts, 0.0, 60.0)?),
        ["remote", ref words @ ..] => FakeFault::Remote(RemoteControl::parse(words)?),
        ["stale", ms] => FakeFault::Stale(ms.parse().ok()?),
        ["loss", share] => FakeFault::Loss(within(share, 0.0, 1.0)?),
        ["delay", ms] => FakeFault::Delay(ms.parse().ok()?),
        ["reorder"] => FakeFault::Reorder,
        ["fall"] => FakeFault::Fall,
        ["set", "upright"] => FakeFault::SetUpright,
        ["power", "cut"] => FakeFault::PowerCut,
        ["messages", "lost"] => FakeFault::MessagesLost,
        ["joint", "out", name] => FakeFault::JointOut(joint(name)?),
        ["foreign", "writer", value] => FakeFault::ForeignWriter(switch(value)?),
        ["controller", value] => FakeFault::Controller(switch(value)?),
        ["clear"] => FakeFault::Clear,
        _ => return None,
    })
}

impl fmt::Display for FakeFault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let switch = |on: &bool| if *on { "on" } else { "off" };
        match self {
            FakeFault::Heat(joint, celsius) => write!(formatter, "heat {joint} {celsius}"),
            FakeFault::Battery(percent) => write!(formatter, "battery {percent}"),
            FakeFault::Voltage(volts) => write!(formatter, "voltage {volts}"),
            FakeFault::Remote(remote) => write!(formatter, "remote {remote}"),
            FakeFault::Stale(ms) => write!(formatter, "stale {ms}"),
            FakeFault::Loss(share) => write!(formatter, "loss {share}"),
            FakeFault::Delay(ms) => write!(formatter, "delay {ms}"),
            FakeFault::Reorder => formatter.write_str("reorder"),
            FakeFault::Fall => formatter.write_str("fall"),
            FakeFault::SetUpright => formatter.write_str("set upright"),
            FakeFault::PowerCut => formatter.write_str("power cut"),
            FakeFault::MessagesLost => formatter.write_str("messages lost"),
            FakeFault::JointOut(joint) => write!(formatter, "joint out {joint}"),
            FakeFault::ForeignWriter(on) => write!(formatter, "foreign writer {}", switch(on)),
            FakeFault::Controller(on) => write!(formatter, "controller {}", switch(on)),
            FakeFault::Mistake(mistake) => write!(formatter, "mistake {mistake}"),
            FakeFault::Clear => formatter.write_str("clear"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_form_is_read_and_written() {
        let words = |form: &str| {
            form.replace("JOINT", "FL_calf")
                .replace("CELSIUS", "90")
                .replace("PERCENT", "10")
                .replace("VOLTS", "20.5")
                .replace("BUTTONS", "L2+B")
                .replace("LX LY RX", "0.5 -0.25 0")
                .replace("MS", "100")
                .replace("SHARE", "0.1")
                .replace("on|off", "on")
                .replace("LINE", "encoder dead RR_thigh")
        };
        let lines: Vec<_> = FORMS.split(", ").map(words).collect();
        assert_eq!(lines.len(), 20);
        for line in lines {
            let fault: FakeFault = line.parse().expect("a fault");
            assert_eq!(fault.to_string(), line);
        }
    }

    #[test]
    fn wrong_line_is_named_with_what_is_possible() {
        let lines =
            ["", "heat", "heat FL_knee 90", "battery 101", "loss 1.5", "voltage nan", "remote Q", "controller maybe"];
        for line in lines {
            let text = line.parse::<FakeFault>().expect_err("wrong").to_string();
            assert!(text.starts_with(&format!("`{line}` is no fault")) && text.contains("power cut"), "{text}");
        }
        let text = "mistake nothing".parse::<FakeFault>().expect_err("wrong").to_string();
        assert!(text.starts_with("`nothing` is no mistake"), "{text}");
    }
}
