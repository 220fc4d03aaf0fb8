//! Frames between this process and `python -m twinstep.mujoco`, whose `frames.py` has the table of all requests.
//!
//! A frame is its length (`u32`), a byte for its kind, and a body. All numbers are little-endian.

use std::io::{Error, ErrorKind, Read, Write};

use twinstep_model::{Command, InitialState, NUM_JOINTS, RobotStates};

/// Version of the frames. The Python package has the same one.
const PROTOCOL: u32 = 2;
const GREETING: &str = "twinstep-mujoco";
/// Longest frame [bytes].
const MAX_FRAME: usize = 1 << 28;
/// Numbers of a robot in the sensor readings, and in the ground truth.
const ROW: (usize, usize) = (3 * NUM_JOINTS + 4 + 3, 3 + 3 + 3 + 4 + 1);

/// Kind of the first request and of its reply.
pub const HELLO: u8 = b'H';
/// Kind of a reset.
pub const RESET: u8 = b'R';
/// Kind of a step.
pub const STEP: u8 = b'S';
/// Kind of a push of one robot.
pub const PUSH: u8 = b'P';
/// Kind of a reply with the states of robots.
pub const STATES: u8 = b'D';
/// Kind of a reply with the text of an error.
pub const ERROR: u8 = b'E';

/// Kind and body of a frame.
pub type Frame = (u8, Vec<u8>);

/// Settings of the process.
pub struct Settings {
    /// Number of robots.
    pub robots: usize,
    /// Number of threads; 0 for one per core.
    pub threads: usize,
    /// Maximum number of solver iterations per physics step.
    pub iterations: u32,
    /// Number of physics steps per actuator period.
    pub steps: usize,
}

/// Reset of one robot. `mjcf` is its model; empty for the nominal one.
pub struct Reset<'a> {
    /// The robot.
    pub robot: usize,
    /// Its state, with true joint positions instead of encoder readings.
    pub initial_state: &'a InitialState,
    /// Its model.
    pub mjcf: &'a str,
}

/// Writes a frame.
pub fn write_frame(stream: &mut impl Write, kind: u8, body: &[u8]) -> Result<(), Error> {
    let length = u32::try_from(body.len() + 1).map_err(|_| Error::from(ErrorKind::FileTooLarge))?;
    stream.write_all(&[&length.to_le_bytes()[..], &[kind], body].concat())?;
    stream.flush()
}

/// Reads a frame. Returns `None` at the end of the stream.
pub fn read_frame(stream: &mut impl Read) -> Result<Option<Frame>, Error> {
    let mut head = [0; 4];
    match stream.read_exact(&mut head) {
        Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(None),
        result => result?,
    }
    let length = u32::from_le_bytes(head) as usize;
    if !(1..=MAX_FRAME).contains(&length) {
        let text = format!("it wrote {:?}, which is not the start of a frame", String::from_utf8_lossy(&head));
        return Err(Error::new(ErrorKind::InvalidData, text));
    }
    // Grows with the bytes that arrive, so that a wrong length allocates nothing.
    let mut frame = Vec::new();
    stream.take(length as u64).read_to_end(&mut frame)?;
    if frame.len() < length {
        return Ok(None);
    }
    Ok(Some((frame.remove(0), frame)))
}

/// Returns the body of the first request. `mjcf` is the nominal model.
pub fn hello(settings: &Settings, mjcf: &str) -> Vec<u8> {
    let Settings { robots, threads, iterations, steps } = settings;
    format!("{GREETING} {PROTOCOL} robots={robots} threads={threads} iterations={iterations} steps={steps}\n{mjcf}")
        .into_bytes()
}

/// Checks the reply to the first request.
pub fn check_greeting(body: &[u8]) -> Result<(), String> {
    let text = String::from_utf8_lossy(body);
    if text.starts_with(&format!("{GREETING} {PROTOCOL} ")) {
        return Ok(());
    }
    Err(format!("it is another version: it wrote {text:?}, not `{GREETING} {PROTOCOL}`"))
}

/// Returns the body of a reset.
pub fn reset(resets: &[Reset]) -> Vec<u8> {
    let mut body = Vec::new();
    put_number(&mut body, resets.len());
    for Reset { robot, initial_state, mjcf } in resets {
        put_number(&mut body, *robot);
        let InitialState {
            base_position,
            base_orientation,
            base_linear_velocity,
            base_angular_velocity,
            q,
            dq,
            actuator_seed: _,
        } = initial_state;
        let values: [&[f32]; 6] = [base_position, base_orientation, base_linear_velocity, base_angular_velocity, q, dq];
        for values in values {
            put(&mut body, values);
        }
        put_number(&mut body, mjcf.len());
        body.extend_from_slice(mjcf.as_bytes());
    }
    body
}

/// Returns the body of a push: `velocity` is added to that of the base, in the world frame [m/s].
pub fn push(robot: usize, velocity: [f32; 3]) -> Vec<u8> {
    let mut body = Vec::new();
    put_number(&mut body, robot);
    put(&mut body, &velocity);
    body
}

/// Returns the body of a step.
pub fn step(commands: &[Command], active: &[bool], actuator_periods: usize) -> Vec<u8> {
    let mut body = Vec::with_capacity(4 + commands.len() * (1 + size_of::<Command>()));
    put_number(&mut body, actuator_periods);
    body.extend(active.iter().map(|active| u8::from(*active)));
    for Command { q, dq, tau_ff, kp, kd } in commands {
        for values in [q, dq, tau_ff, kp, kd] {
            put(&mut body, values);
        }
    }
    body
}

/// Reads a reply with the states of `robots` into their entries of `states`.
pub fn read_states(body: &[u8], robots: &[usize], states: &mut RobotStates) -> Result<(), String> {
    let (measured_len, truth_len) = ROW;
    let expected = 4 * robots.len() * (measured_len + truth_len);
    if body.len() != expected {
        return Err(format!("it wrote the states of its robots in {} bytes; {expected} are expected", body.len()));
    }
    let numbers: Vec<f32> = body.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    let (measured, truth) = numbers.split_at(robots.len() * measured_len);
    for (robot, (measured, truth)) in
        robots.iter().zip(measured.chunks_exact(measured_len).zip(truth.chunks_exact(truth_len)))
    {
        let RobotStates { measured: readings, truth: truths } = states;
        let mut numbers = measured;
        for values in [&mut readings.q, &mut readings.dq, &mut readings.tau] {
            values[*robot] = take::<NUM_JOINTS>(&mut numbers);
        }
        readings.orientation[*robot] = take(&mut numbers);
        readings.gyro[*robot] = take(&mut numbers);
        let mut numbers = truth;
        truths.base_position[*robot] = take(&mut numbers);
        truths.base_linear_velocity[*robot] = take(&mut numbers);
        truths.base_angular_velocity[*robot] = take(&mut numbers);
        truths.foot_force[*robot] = take(&mut numbers);
        truths.body_contact[*robot] = take::<1>(&mut numbers) == [1.0];
    }
    Ok(())
}

fn put_number(body: &mut Vec<u8>, number: usize) {
    let number = u32::try_from(number).expect("a number of robots, periods or bytes of a model is below 2^32");
    body.extend_from_slice(&number.to_le_bytes());
}

fn put(body: &mut Vec<u8>, values: &[f32]) {
    body.extend(values.iter().flat_map(|value| value.to_le_bytes()));
}

fn take<const N: usize>(numbers: &mut &[f32]) -> [f32; N] {
    let (first, rest) = numbers.split_first_chunk().expect("the length was checked");
    *numbers = rest;
    *first
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_is_read_as_it_was_written() {
        let mut bytes = Vec::new();
        write_frame(&mut bytes, STEP, b"abc").expect("a Vec takes every byte");
        write_frame(&mut bytes, RESET, b"").expect("a Vec takes every byte");
        assert_eq!(bytes, b"\x04\0\0\0Sabc\x01\0\0\0R");
        let mut stream = &bytes[..];
        assert_eq!(read_frame(&mut stream).expect("a frame"), Some((STEP, b"abc".to_vec())));
        assert_eq!(read_frame(&mut stream).expect("a frame"), Some((RESET, Vec::new())));
        assert_eq!(read_frame(&mut stream).expect("the end"), None);
    }

    #[test]
    fn text_is_not_a_frame() {
        let error = read_frame(&mut &b"Traceback (most recent call last)"[..]).expect_err("no frame");
        assert_eq!(error.to_string(), "it wrote \"Trac\", which is not the start of a frame");
        assert_eq!(read_frame(&mut &b"\x09\0\0\0Dab"[..]).expect("the end"), None);
    }

    #[test]
    fn states_are_read_into_the_entries_of_their_robots() {
        let (measured, truth) = ROW;
        let numbers = (0..measured + truth).map(|index| index as f32);
        let mut body: Vec<u8> = numbers.flat_map(f32::to_le_bytes).collect();
        let mut states = RobotStates::new(2);
        read_states(&body, &[1], &mut states).expect("the states of one robot");
        assert_eq!((states.measured.q[1][1], states.measured.dq[1][0], states.measured.tau[1][11]), (1.0, 12.0, 35.0));
        assert_eq!((states.measured.orientation[1][0], states.measured.gyro[1][2]), (36.0, 42.0));
        assert_eq!((states.truth.base_position[1][0], states.truth.foot_force[1][3]), (43.0, 55.0));
        assert_eq!(states.measured.q[0], [0.0; NUM_JOINTS]);
        body.pop();
        let error = read_states(&body, &[1], &mut states).expect_err("too short");
        assert_eq!(error, "it wrote the states of its robots in 227 bytes; 228 are expected");
    }

    #[test]
    fn sizes_are_those_of_the_table() {
        let robot = twinstep_model::go2();
        let initial_state = InitialState::at_rest(0.3, robot.control.default_pose_f32());
        assert_eq!(
            reset(&[Reset { robot: 3, initial_state: &initial_state, mjcf: "<a/>" }]).len(),
            4 + 4 + 148 + 4 + 4
        );
        let command = Command::hold(initial_state.q, 40.0, 1.0);
        assert_eq!(step(&[command; 2], &[true, false], 4).len(), 4 + 2 * (1 + 240));
    }
}
