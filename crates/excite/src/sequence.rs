//! Velocity commands, one after the other, and their file.

use rand::{Rng, RngExt};

/// First line of the file.
const HEADER: &str = "start_s,end_s,vx,vy,wz";
/// Largest absolute velocity in a file [m/s, rad/s].
const MAX_VELOCITY: f32 = 5.0;

/// Lowest and highest velocity command: forward [m/s], left [m/s], yaw rate [rad/s].
pub type VelocityRanges = [[f32; 2]; 3];

/// A velocity command and the time until which it is in force.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    /// End, from the start of the sequence [s].
    pub end_s: f64,
    /// Forward [m/s], left [m/s], yaw rate [rad/s], in the base frame.
    pub velocity: [f32; 3],
}

/// Velocity commands, one after the other.
#[derive(Clone, Debug, PartialEq)]
pub struct CommandSequence {
    /// At least one, with increasing ends.
    segments: Vec<Segment>,
}

/// The file of a sequence is not valid.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("line {line}: {reason}")]
pub struct SequenceError {
    /// Number of the line, from 1.
    pub line: usize,
    /// What is wrong, and what is allowed.
    pub reason: String,
}

impl CommandSequence {
    /// Returns segments of equal duration with these velocities.
    pub fn new(segment_s: f64, velocities: impl IntoIterator<Item = [f32; 3]>) -> Self {
        let segment = |(index, velocity)| Segment { end_s: segment_s * (index + 1) as f64, velocity };
        Self { segments: velocities.into_iter().enumerate().map(segment).collect() }
    }

    /// Returns velocities that are uniform in `ranges`.
    pub fn random(segment_s: f64, segments: usize, ranges: &VelocityRanges, random: &mut impl Rng) -> Self {
        let coordinates: Vec<f64> = (0..3 * segments).map(|_| random.random_range(-1.0..=1.0)).collect();
        Self::from_coordinates(segment_s, &coordinates, ranges)
    }

    /// Returns the sequence of three coordinates for each segment. −1 and 1 are the ends of the ranges; coordinates
    /// beyond are clipped.
    pub fn from_coordinates(segment_s: f64, coordinates: &[f64], ranges: &VelocityRanges) -> Self {
        let velocity = |point: &[f64]| {
            std::array::from_fn(|axis| {
                let [low, high] = ranges[axis];
                0.5 * (low + high) + 0.5 * (high - low) * point[axis].clamp(-1.0, 1.0) as f32
            })
        };
        Self::new(segment_s, coordinates.chunks_exact(3).map(velocity))
    }

    /// Inverts [`CommandSequence::from_coordinates`].
    pub fn coordinates(&self, ranges: &VelocityRanges) -> Vec<f64> {
        let axis = |(value, [low, high]): (&f32, &[f32; 2])| f64::from((2.0 * value - low - high) / (high - low));
        self.segments.iter().flat_map(|segment| segment.velocity.iter().zip(ranges).map(axis)).collect()
    }

    /// Returns the segments.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// Returns the duration [s].
    pub fn duration_s(&self) -> f64 {
        self.segments.last().map_or(0.0, |segment| segment.end_s)
    }

    /// Returns the velocity command at a time [s]. After the end the robot stands.
    pub fn at(&self, t: f64) -> [f32; 3] {
        // Times are multiples of the policy's period, which is not exact in binary.
        let is_before = |segment: &&Segment| t < segment.end_s - 1e-6;
        self.segments.iter().find(is_before).map_or([0.0; 3], |segment| segment.velocity)
    }

    /// Returns the file: CSV with a line for each segment.
    pub fn to_csv(&self) -> String {
        let starts = std::iter::once(0.0).chain(self.segments.iter().map(|segment| segment.end_s));
        let lines = starts
            .zip(&self.segments)
            .map(|(start, Segment { end_s, velocity: [vx, vy, wz] })| format!("{start},{end_s},{vx},{vy},{wz}\n"));
        format!("{HEADER}\n{}", lines.collect::<String>())
    }

    /// Reads a file.
    pub fn parse(text: &str) -> Result<Self, SequenceError> {
        let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        let wrong = |line: usize, reason: String| Err(SequenceError { line: line + 1, reason });
        match lines.next() {
            Some((_, header)) if header.trim() == HEADER => {}
            other => {
                let found = other.map_or("nothing".to_owned(), |(_, header)| format!("`{}`", header.trim()));
                return wrong(0, format!("the header is {found}; it must be `{HEADER}`"));
            }
        }
        let mut segments: Vec<Segment> = Vec::new();
        for (line, cells) in lines {
            let start = segments.last().map_or(0.0, |segment| segment.end_s);
            match segment(cells, start) {
                Ok(segment) => segments.push(segment),
                Err(reason) => return wrong(line, reason),
            }
        }
        if segments.is_empty() {
            return wrong(1, "there is no segment; at least one line must follow the header".to_owned());
        }
        Ok(Self { segments })
    }
}

/// Reads a line. `expected` is the end of the segment before [s].
fn segment(line: &str, expected: f64) -> Result<Segment, String> {
    let cells: Vec<&str> = line.split(',').map(str::trim).collect();
    let [start, end, velocity @ ..] = cells.as_slice() else {
        return Err(format!("`{line}` has {} cells; 5 are expected: {HEADER}", cells.len()));
    };
    let [vx, vy, wz] = velocity else {
        return Err(format!("`{line}` has {} cells; 5 are expected: {HEADER}", cells.len()));
    };
    let number = |name: &str, cell: &str| {
        let value = cell.parse::<f64>().ok().filter(|value| value.is_finite());
        value.ok_or_else(|| format!("`{name}` = `{cell}` is not a finite number"))
    };
    let (start, end_s) = (number("start_s", start)?, number("end_s", end)?);
    if (start - expected).abs() > 1e-6 {
        return Err(format!("`start_s` = {start} is not {expected}, where the segment before ends"));
    }
    if end_s <= start {
        return Err(format!("`end_s` = {end_s} is not greater than `start_s` = {start}"));
    }
    let mut command = [0.0; 3];
    for ((value, cell), name) in command.iter_mut().zip([vx, vy, wz]).zip(["vx", "vy", "wz"]) {
        *value = number(name, cell)? as f32;
        if value.abs() > MAX_VELOCITY {
            return Err(format!("`{name}` = {value} is outside -{MAX_VELOCITY} to {MAX_VELOCITY}"));
        }
    }
    Ok(Segment { end_s, velocity: command })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const RANGES: VelocityRanges = [[-1.0, 1.0], [-0.5, 0.5], [-1.0, 1.0]];

    #[test]
    fn command_is_in_force_until_the_end_of_its_segment() {
        let sequence = CommandSequence::new(5.0, [[0.5, 0.0, 0.0], [0.0, 0.0, 1.0]]);
        assert_eq!((sequence.at(0.0), sequence.at(4.98)), ([0.5, 0.0, 0.0], [0.5, 0.0, 0.0]));
        assert_eq!((sequence.at(5.0), sequence.at(10.0)), ([0.0, 0.0, 1.0], [0.0; 3]));
        assert!((sequence.duration_s() - 10.0).abs() < 1e-9);
    }

    #[test]
    fn invalid_files_are_rejected_with_line_field_and_value() {
        let cases = [
            ("", "line 1: the header is nothing"),
            ("t,vx\n", "line 1: the header is `t,vx`"),
            ("start_s,end_s,vx,vy,wz\n", "line 2: there is no segment"),
            ("start_s,end_s,vx,vy,wz\n0,5,1\n", "line 2: `0,5,1` has 3 cells"),
            ("start_s,end_s,vx,vy,wz\n0,5,1,0,x\n", "line 2: `wz` = `x` is not a finite number"),
            ("start_s,end_s,vx,vy,wz\n0,5,1,0,9\n", "line 2: `wz` = 9 is outside -5 to 5"),
            ("start_s,end_s,vx,vy,wz\n0,5,1,0,0\n6,9,1,0,0\n", "line 3: `start_s` = 6 is not 5"),
            ("start_s,end_s,vx,vy,wz\n0,0,1,0,0\n", "line 2: `end_s` = 0 is not greater"),
        ];
        for (text, expected) in cases {
            let error = CommandSequence::parse(text).expect_err(expected).to_string();
            assert!(error.starts_with(expected), "{error}");
        }
    }

    proptest! {
        #[test]
        fn file_and_coordinates_return_the_sequence(
            coordinates in prop::collection::vec(-1.0..1.0f64, 3..30),
            segment_s in 0.1..10.0f64,
        ) {
            let sequence = CommandSequence::from_coordinates(segment_s, &coordinates, &RANGES);
            prop_assert_eq!(&CommandSequence::parse(&sequence.to_csv()).expect("a valid file"), &sequence);
            for (back, given) in sequence.coordinates(&RANGES).iter().zip(&coordinates) {
                prop_assert!((back - given).abs() < 1e-5);
            }
        }

        #[test]
        fn any_text_is_read_or_refused(text in ".{0,200}") {
            let _ = CommandSequence::parse(&text);
            let _ = CommandSequence::parse(&format!("{HEADER}\n{text}"));
        }
    }
}
