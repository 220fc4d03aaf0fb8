//! The remote control in the operator's hand.

use std::fmt;

use twinstep_unitree::{Button, Remote};

/// Buttons with their names.
const BUTTONS: [(&str, Button); 16] = [
    ("R1", Button::R1),
    ("L1", Button::L1),
    ("start", Button::Start),
    ("select", Button::Select),
    ("R2", Button::R2),
    ("L2", Button::L2),
    ("F1", Button::F1),
    ("F2", Button::F2),
    ("A", Button::A),
    ("B", Button::B),
    ("X", Button::X),
    ("Y", Button::Y),
    ("up", Button::Up),
    ("right", Button::Right),
    ("down", Button::Down),
    ("left", Button::Left),
];

/// What the remote control does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RemoteControl {
    /// It is not received.
    Lost,
    /// It is received: pressed buttons, the others released; sticks in the middle.
    Pressed(Remote),
    /// It is received: sticks `lx`, `ly`, `rx` from −1 to 1, no button.
    Sticks([f32; 3]),
}

impl RemoteControl {
    /// Reads `lost`, `none`, buttons such as `L2+B`, or `stick LX LY RX`.
    pub(super) fn parse(words: &[&str]) -> Option<Self> {
        match *words {
            ["lost"] => Some(Self::Lost),
            ["none"] => Some(Self::Pressed(Remote::default())),
            ["stick", ref values @ ..] => {
                let numbers: Option<Vec<f32>> = values.iter().map(|value| value.parse().ok()).collect();
                let sticks: [f32; 3] = numbers?.try_into().ok()?;
                sticks.iter().all(|value| (-1.0..=1.0).contains(value)).then_some(Self::Sticks(sticks))
            }
            [names] => {
                let button = |name| BUTTONS.iter().find(|(other, _)| *other == name).map(|(_, button)| *button);
                let pressed = names
                    .split('+')
                    .try_fold(Remote::default(), |remote, name| button(name).map(|button| remote.with_pressed(button)));
                pressed.map(Self::Pressed)
            }
            _ => None,
        }
    }

    /// Returns the state in the messages; `None` if the remote is not received.
    pub(super) fn state(&self) -> Option<Remote> {
        match *self {
            Self::Lost => None,
            Self::Pressed(remote) => Some(remote),
            Self::Sticks([lx, ly, rx]) => Some(Remote { lx, ly, rx, ..Remote::default() }),
        }
    }
}

impl fmt::Display for RemoteControl {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Lost => formatter.write_str("lost"),
            Self::Pressed(remote) if remote.keys == 0 => formatter.write_str("none"),
            Self::Pressed(remote) => {
                let pressed = BUTTONS.iter().filter(|(_, button)| remote.is_pressed(*button));
                formatter.write_str(&pressed.map(|(name, _)| *name).collect::<Vec<_>>().join("+"))
            }
            Self::Sticks([lx, ly, rx]) => write!(formatter, "stick {lx} {ly} {rx}"),
        }
    }
}
