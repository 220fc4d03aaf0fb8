//! Frames between this process and `python -m twinstep.mujoco`, whose `frames.py` has the table of all requests.
//!
//! A frame is its length (`u32`), a byte for its kind, and a body. All numbers are little-endian.

use std::io::{Error, ErrorKind, Read, Write};

/// Version of the frames. The Python package has the same one.
const PROTOCOL: u32 = 3;
const GREETING: &str = "twinstep-mujoco";
/// Longest frame [bytes].
const MAX_FRAME: usize = 1 << 28;
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

/// Joints and geoms of the robots, in the order of every row.
#[derive(Clone, Debug)]
pub struct Layout {
    /// Names of the joints.
    pub joints: Vec<String>,
    /// Names of the geoms whose normal forces are read.
    pub geoms: Vec<String>,
    /// Index of the body that a robot with a fixed base has as its base; 0 is the world.
    pub base: usize,
}

impl Layout {
    /// Returns the numbers of a robot in the sensor readings, and in the ground truth.
    fn row(&self) -> (usize, usize) {
        (3 * self.joints.len() + 4 + 3, 3 + 3 + 3 + self.geoms.len())
    }
}

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
    /// Its state: position, orientation, linear and angular velocity of the base, true positions and velocities of the joints.
    pub state: Vec<f32>,
    /// Its model.
    pub mjcf: &'a str,
}

/// Position, velocity, feed-forward torque and gains of the joints of a robot.
pub type CommandRow<'a> = [&'a [f32]; 5];

/// States of one robot.
pub struct StateRow<'a> {
    /// Joint positions [rad or m].
    pub q: &'a [f32],
    /// Joint velocities [rad/s or m/s].
    pub dq: &'a [f32],
    /// Torques, means over the last actuator period [N·m or N].
    pub tau: &'a [f32],
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub orientation: [f32; 4],
    /// Angular velocity in the base frame [rad/s].
    pub gyro: [f32; 3],
    /// Position of the base [m].
    pub base_position: [f32; 3],
    /// Velocity of the base in the world frame [m/s].
    pub base_linear_velocity: [f32; 3],
    /// Angular velocity of the base in the base frame [rad/s].
    pub base_angular_velocity: [f32; 3],
    /// Normal force on each geom of the layout [N].
    pub geom_force: &'a [f32],
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
pub fn hello(settings: &Settings, layout: &Layout, mjcf: &str) -> Vec<u8> {
    let Settings { robots, threads, iterations, steps } = settings;
    let Layout { joints, geoms, base } = layout;
    let (joints, geoms) = (joints.join("\t"), geoms.join("\t"));
    let settings = format!("robots={robots} threads={threads} iterations={iterations} steps={steps} base={base}");
    format!("{GREETING} {PROTOCOL} {settings}\n{joints}\n{geoms}\n{mjcf}").into_bytes()
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
    for Reset { robot, state, mjcf } in resets {
        put_number(&mut body, *robot);
        put(&mut body, state);
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
pub fn step<'a>(
    commands: impl IntoIterator<Item = CommandRow<'a>>,
    active: &[bool],
    actuator_periods: usize,
) -> Vec<u8> {
    let mut body = Vec::new();
    put_number(&mut body, actuator_periods);
    body.extend(active.iter().map(|active| u8::from(*active)));
    for values in commands.into_iter().flatten() {
        put(&mut body, values);
    }
    body
}

/// Reads a reply with the states of `robots`, and calls `read` for each.
pub fn read_states(
    body: &[u8],
    layout: &Layout,
    robots: &[usize],
    mut read: impl FnMut(usize, StateRow),
) -> Result<(), String> {
    let (measured_len, truth_len) = layout.row();
    let expected = 4 * robots.len() * (measured_len + truth_len);
    if body.len() != expected {
        return Err(format!("it wrote the states of its robots in {} bytes; {expected} are expected", body.len()));
    }
    let numbers: Vec<f32> = body.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    let (measured, truth) = numbers.split_at(robots.len() * measured_len);
    for (robot, (mut measured, mut truth)) in
        robots.iter().zip(measured.chunks_exact(measured_len).zip(truth.chunks_exact(truth_len)))
    {
        let [q, dq, tau] = std::array::from_fn(|_| {
            let (first, rest) = measured.split_at(layout.joints.len());
            measured = rest;
            first
        });
        let row = StateRow {
            q,
            dq,
            tau,
            orientation: take(&mut measured),
            gyro: take(&mut measured),
            base_position: take(&mut truth),
            base_linear_velocity: take(&mut truth),
            base_angular_velocity: take(&mut truth),
            geom_force: truth,
        };
        read(*robot, row);
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

    fn layout(joints: usize, geoms: usize) -> Layout {
        let names = |count: usize| (0..count).map(|index| index.to_string()).collect();
        Layout { joints: names(joints), geoms: names(geoms), base: 1 }
    }

    #[test]
    fn states_are_read_for_their_robots() {
        let layout = layout(12, 9);
        let (measured, truth) = layout.row();
        let mut body: Vec<u8> = (0..measured + truth).map(|index| index as f32).flat_map(f32::to_le_bytes).collect();
        let mut seen = Vec::new();
        read_states(&body, &layout, &[3], |robot, row| {
            seen.push(robot);
            assert_eq!((row.q[1], row.dq[0], row.tau[11]), (1.0, 12.0, 35.0));
            assert_eq!((row.orientation[0], row.gyro[2]), (36.0, 42.0));
            assert_eq!((row.base_position[0], row.geom_force[3], row.geom_force.len()), (43.0, 55.0, 9));
        })
        .expect("the states of one robot");
        assert_eq!(seen, [3]);
        body.pop();
        let error = read_states(&body, &layout, &[1], |_, _| {}).expect_err("too short");
        assert_eq!(error, "it wrote the states of its robots in 243 bytes; 244 are expected");
    }

    #[test]
    fn sizes_are_those_of_the_table() {
        let state = vec![0.0; 13 + 2 * 12];
        assert_eq!(reset(&[Reset { robot: 3, state, mjcf: "<a/>" }]).len(), 4 + 4 + 148 + 4 + 4);
        let row = [0.0; 12];
        assert_eq!(step([[&row[..]; 5]; 2], &[true, false], 4).len(), 4 + 2 * (1 + 240));
        let settings = Settings { robots: 1, threads: 2, iterations: 3, steps: 4 };
        let text = String::from_utf8(hello(&settings, &layout(2, 1), "<mujoco/>")).expect("a text");
        assert_eq!(text, "twinstep-mujoco 3 robots=1 threads=2 iterations=3 steps=4 base=1\n0\t1\n0\n<mujoco/>");
    }
}
