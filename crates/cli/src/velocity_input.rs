//! Velocity commands of a person: keyboard and gamepad.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use signal_hook::consts::{SIGINT, SIGTERM};
use twinstep_envs::WalkConfig;

use crate::exit::{Failure, other};
use crate::key_terminal::KeyTerminal;

/// Change of a velocity per key press: forward and left [m/s], yaw rate [rad/s].
const KEY_STEP: [f32; 3] = [0.1, 0.1, 0.2];
/// Share of the range of a stick that counts as zero.
const DEAD_ZONE: f32 = 0.1;

/// Velocity command that a person changes while the robot walks.
pub struct VelocityInput {
    state: Arc<State>,
    keyboard: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct State {
    command: Mutex<[f32; 3]>,
    /// True once the person wants to end the run, or the device is lost.
    has_ended: AtomicBool,
    /// Why the device was lost.
    failure: Mutex<Option<String>>,
}

/// Effect of a key.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Key {
    /// Adds to the velocity, in units of the step of a key press.
    Add([f32; 3]),
    Stop,
    Quit,
}

/// The gamepad cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("`--gamepad`: cannot read {}: {cause}\n  connect a gamepad and give its joystick device, such as /dev/input/js0", path.display())]
struct NoGamepad {
    path: PathBuf,
    cause: std::io::Error,
}

/// No keyboard: stdin is not a terminal, for example.
#[derive(Debug, thiserror::Error)]
#[error("`--keyboard` needs a terminal: {0}\n  use --velocity VX,VY,WZ without one")]
struct NoTerminal(rustix::io::Errno);

impl VelocityInput {
    /// Reads keys of this terminal until the value is dropped, which restores the terminal.
    pub fn keyboard() -> Result<Self, Failure> {
        let terminal =
            KeyTerminal::open().map_err(|error| Failure::Input(miette::Report::msg(NoTerminal(error).to_string())))?;
        let state = Arc::new(State::default());
        let (shared, interrupted) = (Arc::clone(&state), Arc::new(AtomicBool::new(false)));
        // A second signal terminates the program at once. The terminal is restored before, even if a step takes long.
        for signal in [SIGINT, SIGTERM] {
            signal_hook::flag::register(signal, Arc::clone(&interrupted)).map_err(other)?;
        }
        let thread = std::thread::Builder::new().spawn(move || read_keys(&shared, &interrupted, terminal));
        let thread = thread.map_err(other)?;
        Ok(Self { state, keyboard: Some(thread) })
    }

    /// Reads the sticks of a gamepad from its joystick device.
    pub fn gamepad(path: &Path) -> Result<Self, Failure> {
        let unreadable =
            |cause| Failure::Input(miette::Report::msg(NoGamepad { path: path.into(), cause }.to_string()));
        let device = File::open(path).map_err(unreadable)?;
        let state = Arc::new(State::default());
        let shared = Arc::clone(&state);
        // The thread waits in `read` and ends with the process.
        std::thread::Builder::new().spawn(move || read_sticks(device, &shared)).map_err(other)?;
        Ok(Self { state, keyboard: None })
    }

    /// Returns the velocity command: forward [m/s], left [m/s], yaw rate [rad/s]. `None` once the run shall end.
    pub fn command(&self) -> Option<[f32; 3]> {
        let ended = self.state.has_ended.load(Ordering::Acquire);
        (!ended).then(|| *self.state.command.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Returns why the device was lost, if it was.
    pub fn failure(&self) -> Option<String> {
        self.state.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Drop for VelocityInput {
    fn drop(&mut self) {
        self.state.has_ended.store(true, Ordering::Release);
        if let Some(thread) = self.keyboard.take() {
            // It restores the terminal.
            let _ = thread.join();
        }
    }
}

impl State {
    fn set(&self, command: [f32; 3]) {
        *self.command.lock().unwrap_or_else(PoisonError::into_inner) = command;
    }

    fn fail(&self, reason: String) {
        self.set([0.0; 3]);
        *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(reason);
        self.has_ended.store(true, Ordering::Release);
    }
}

/// Reads keys until the run ends or a signal arrives.
fn read_keys(state: &State, interrupted: &AtomicBool, terminal: KeyTerminal) {
    let (mut command, mut bytes) = ([0.0; 3], [0; 64]);
    while !state.has_ended.load(Ordering::Acquire) && !interrupted.load(Ordering::Acquire) {
        let pressed = match terminal.read(&mut bytes) {
            Ok(pressed) => pressed,
            Err(error) => {
                state.fail(format!("the keyboard cannot be read: {error}"));
                break;
            }
        };
        for key in keys(pressed) {
            match key {
                Key::Quit => state.has_ended.store(true, Ordering::Release),
                pressed => {
                    command = after_key(command, pressed);
                    state.set(command);
                }
            }
        }
    }
    drop(terminal);
}

/// Returns the keys in bytes that a terminal sent. Arrows are ESC [ A to D or ESC O A to D; a single ESC is the key Esc.
fn keys(mut bytes: &[u8]) -> Vec<Key> {
    let mut keys = Vec::new();
    while !bytes.is_empty() {
        let (key, len) = match bytes {
            [0x1b, b'[' | b'O', arrow, ..] => (arrow_key(*arrow), 3),
            [0x1b] => (Some(Key::Quit), 1),
            [byte, ..] => (letter_key(*byte), 1),
            [] => (None, 1),
        };
        keys.extend(key);
        bytes = &bytes[len..];
    }
    keys
}

fn arrow_key(last: u8) -> Option<Key> {
    match last {
        b'A' => Some(Key::Add([1.0, 0.0, 0.0])),
        b'B' => Some(Key::Add([-1.0, 0.0, 0.0])),
        b'C' => Some(Key::Add([0.0, 0.0, -1.0])),
        b'D' => Some(Key::Add([0.0, 0.0, 1.0])),
        _ => None,
    }
}

fn letter_key(letter: u8) -> Option<Key> {
    match letter.to_ascii_lowercase() {
        b'w' => Some(Key::Add([1.0, 0.0, 0.0])),
        b's' => Some(Key::Add([-1.0, 0.0, 0.0])),
        b'a' => Some(Key::Add([0.0, 1.0, 0.0])),
        b'd' => Some(Key::Add([0.0, -1.0, 0.0])),
        b' ' => Some(Key::Stop),
        b'q' => Some(Key::Quit),
        _ => None,
    }
}

/// Returns the velocity command after a key, within the limits.
fn after_key(command: [f32; 3], key: Key) -> [f32; 3] {
    match key {
        Key::Add(steps) => std::array::from_fn(|entry| {
            let step = KEY_STEP[entry];
            let [low, high] = limits()[entry];
            // Whole steps, so that the way back ends at zero.
            (((command[entry] / step).round() + steps[entry]) * step).clamp(low, high)
        }),
        Key::Stop => [0.0; 3],
        Key::Quit => command,
    }
}

/// Returns lowest and highest velocity command: the range of the task's own commands.
pub fn limits() -> [[f32; 2]; 3] {
    let ranges = WalkConfig::default().command;
    [ranges.linear_velocity_x, ranges.linear_velocity_y, ranges.angular_velocity_z]
}

/// Reads events of the Linux joystick interface: left stick forward and left, right stick turn.
///
/// An event has 8 bytes: time [ms] (u32), value (i16), type (u8; 1 button, 2 axis, and 128 for the initial state), number
/// (u8). Linux, Documentation/input/joydev/joystick-api.rst.
fn read_sticks(mut device: File, state: &State) {
    let (mut sticks, mut event) = ([0.0; 3], [0; 8]);
    loop {
        if let Err(error) = device.read_exact(&mut event) {
            return state.fail(format!("the gamepad is lost: {error}"));
        }
        sticks = after_event(sticks, event);
        let command = std::array::from_fn(|entry| {
            let [low, high] = limits()[entry];
            if sticks[entry] < 0.0 { -sticks[entry] * low } else { sticks[entry] * high }
        });
        state.set(command);
    }
}

/// Returns the positions of the sticks after an event: forward, left, turn left, −1 to 1.
fn after_event(mut sticks: [f32; 3], event: [u8; 8]) -> [f32; 3] {
    let [_, _, _, _, low, high, kind, number] = event;
    // Axes of the drivers xpad and hid-playstation; up and left are negative.
    let entry = match (kind & 0x7f, number) {
        (2, 1) => 0,
        (2, 0) => 1,
        (2, 3) => 2,
        _ => return sticks,
    };
    let value = -f32::from(i16::from_le_bytes([low, high])) / 32767.0;
    let beyond = (value.abs() - DEAD_ZONE).max(0.0) / (1.0 - DEAD_ZONE);
    sticks[entry] = beyond.min(1.0).copysign(value);
    sticks
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(bytes: &[u8]) -> [f32; 3] {
        keys(bytes).into_iter().fold([0.0; 3], after_key)
    }

    #[test]
    fn keys_change_the_velocity_they_are_named_for() {
        let near = |one: [f32; 3], other: [f32; 3]| one.iter().zip(other).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(near(after(b"w\x1b[A"), [0.2, 0.0, 0.0]));
        assert!(near(after(b"S"), [-0.1, 0.0, 0.0]));
        assert!(near(after(b"aad"), [0.0, 0.1, 0.0]));
        assert!(near(after(b"\x1b[D"), [0.0, 0.0, 0.2]));
        assert!(near(after(b"\x1bOCx\x1b[Z"), [0.0, 0.0, -0.2]));
        assert_eq!(after(b"w\x1b[D "), [0.0; 3]);
        assert_eq!(after(b"wwwsss"), [0.0; 3]);
    }

    #[test]
    fn velocity_stays_within_the_range_of_the_task() {
        assert_eq!((after(&[b'w'; 50]), after(&[b'a'; 50])), ([1.0, 0.0, 0.0], [0.0, 0.5, 0.0]));
    }

    #[test]
    fn escape_is_not_the_beginning_of_an_arrow() {
        assert_eq!(keys(b"\x1b"), [Key::Quit]);
        assert_eq!(keys(b"\x1b[A"), [Key::Add([1.0, 0.0, 0.0])]);
        assert_eq!(keys(b"wQ"), [Key::Add([1.0, 0.0, 0.0]), Key::Quit]);
    }

    fn axis(number: u8, value: i16) -> [u8; 8] {
        let [low, high] = value.to_le_bytes();
        [1, 2, 3, 4, low, high, 2, number]
    }

    #[test]
    fn sticks_point_forward_and_left_and_have_a_dead_zone() {
        assert_eq!(after_event([0.0; 3], axis(1, -32767)), [1.0, 0.0, 0.0]);
        assert_eq!(after_event([0.0; 3], axis(0, i16::MAX)), [0.0, -1.0, 0.0]);
        assert_eq!(after_event([0.0; 3], axis(3, i16::MIN)), [0.0, 0.0, 1.0]);
        assert_eq!(after_event([0.5; 3], axis(1, 3000))[0].abs(), 0.0, "9 % of the range");
        let half = after_event([0.0; 3], axis(1, -16384))[0];
        assert!((half - 0.4 / 0.9).abs() < 1e-3, "{half}");
    }

    #[test]
    fn buttons_and_other_axes_do_nothing() {
        let mut button = axis(1, 1);
        button[6] = 1;
        for event in [button, axis(2, 30_000), axis(6, 30_000)] {
            assert_eq!(after_event([0.1, 0.2, 0.3], event), [0.1, 0.2, 0.3]);
        }
        let mut initial = axis(1, -32767);
        initial[6] = 0x82;
        assert_eq!(after_event([0.0; 3], initial), [1.0, 0.0, 0.0]);
    }
}
