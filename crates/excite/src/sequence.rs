//! Commands, one after the other, and their file.

use rand::{Rng, RngExt};
use twinstep_envs::Gait;
use twinstep_model::{GaitCommand, VelocityCommand};

/// Columns of velocity commands.
const HEADER: &str = "start_s,end_s,vx,vy,wz";
/// Columns of gait commands, after them.
const GAIT_HEADER: &str = ",step_frequency,phase_fr,phase_rl,phase_rr";
/// Largest absolute velocity in a file [m/s, rad/s].
const MAX_VELOCITY: f32 = 5.0;

/// Highest step frequency in a file [Hz].
const MAX_STEP_FREQUENCY: f32 = 10.0;

/// Commands that a design may use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommandRanges {
    /// Lowest and highest velocity command: forward [m/s], left [m/s], yaw rate [rad/s].
    pub velocity: [[f32; 2]; 3],
    /// Lowest and highest step frequency [Hz], for a policy of `gait`; it may have each of the four gaits.
    pub step_frequency: Option<[f32; 2]>,
}

/// Commands and the time until which they are in force.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    /// End, from the start of the sequence [s].
    pub end_s: f64,
    /// Forward [m/s], left [m/s], yaw rate [rad/s], in the base frame.
    pub velocity: VelocityCommand,
    /// Step frequency [Hz], phases of FR, RL and RR relative to FL [cycles]. All segments of a sequence have one, or none.
    pub gait: Option<GaitCommand>,
}

/// Commands, one after the other.
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

impl CommandRanges {
    /// Returns the number of coordinates of a segment.
    pub fn dim(&self) -> usize {
        if self.step_frequency.is_some() { 5 } else { 3 }
    }

    /// Returns the commands at a point: forward, left, yaw rate, and step frequency and gait if there are any. −1 and 1
    /// are the ends of the ranges; coordinates beyond are clipped. Each gait has a quarter of its coordinate.
    fn commands(&self, point: &[f64]) -> (VelocityCommand, Option<GaitCommand>) {
        let clipped = |index: usize| point[index].clamp(-1.0, 1.0) as f32;
        let within = |[low, high]: [f32; 2], share: f32| 0.5 * (low + high) + 0.5 * (high - low) * share;
        let gait = self.step_frequency.map(|range| {
            let number = (0.5 * (clipped(4) + 1.0) * Gait::ALL.len() as f32) as usize;
            let [fr, rl, rr] = Gait::ALL[number.min(Gait::ALL.len() - 1)].phase_offset();
            [within(range, clipped(3)), fr, rl, rr]
        });
        (std::array::from_fn(|axis| within(self.velocity[axis], clipped(axis))), gait)
    }

    /// Inverts [`CommandRanges::commands`]. A gait gives the middle of its part, a range of one value gives 0.
    fn coordinates(&self, segment: &Segment) -> Vec<f64> {
        let share = |value: f32, [low, high]: [f32; 2]| {
            if high > low { f64::from((2.0 * value - low - high) / (high - low)) } else { 0.0 }
        };
        let velocity = segment.velocity.iter().zip(self.velocity).map(|(value, range)| share(*value, range));
        let gait = self.step_frequency.zip(segment.gait).map(|(range, [frequency, phase_offset @ ..])| {
            let number = Gait::ALL.iter().position(|gait| gait.phase_offset() == phase_offset).unwrap_or(0);
            [share(frequency, range), (2.0 * number as f64 + 1.0) / Gait::ALL.len() as f64 - 1.0]
        });
        velocity.chain(gait.into_iter().flatten()).collect()
    }
}

impl CommandSequence {
    /// Returns segments of equal duration with these velocities.
    pub fn new(segment_s: f64, velocities: impl IntoIterator<Item = VelocityCommand>) -> Self {
        Self::with_gaits(segment_s, velocities.into_iter().map(|velocity| (velocity, None)))
    }

    fn with_gaits(segment_s: f64, commands: impl Iterator<Item = (VelocityCommand, Option<GaitCommand>)>) -> Self {
        let segment = |(index, (velocity, gait))| Segment { end_s: segment_s * (index + 1) as f64, velocity, gait };
        Self { segments: commands.enumerate().map(segment).collect() }
    }

    /// Returns commands that are uniform in `ranges`.
    pub fn random(segment_s: f64, segments: usize, ranges: &CommandRanges, random: &mut impl Rng) -> Self {
        let coordinates: Vec<f64> = (0..ranges.dim() * segments).map(|_| random.random_range(-1.0..=1.0)).collect();
        Self::from_coordinates(segment_s, &coordinates, ranges)
    }

    /// Returns the sequence of [`CommandRanges::dim`] coordinates for each segment, each from −1 to 1.
    pub fn from_coordinates(segment_s: f64, coordinates: &[f64], ranges: &CommandRanges) -> Self {
        Self::with_gaits(segment_s, coordinates.chunks_exact(ranges.dim()).map(|point| ranges.commands(point)))
    }

    /// Inverts [`CommandSequence::from_coordinates`].
    pub fn coordinates(&self, ranges: &CommandRanges) -> Vec<f64> {
        self.segments.iter().flat_map(|segment| ranges.coordinates(segment)).collect()
    }

    /// Returns true if the sequence has gait commands.
    pub fn has_gaits(&self) -> bool {
        self.segments.iter().any(|segment| segment.gait.is_some())
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
        self.segment(t).map_or([0.0; 3], |segment| segment.velocity)
    }

    /// Returns the gait command at a time [s]. After the end it is the last one.
    pub fn gait_at(&self, t: f64) -> Option<GaitCommand> {
        self.segment(t).or(self.segments.last())?.gait
    }

    fn segment(&self, t: f64) -> Option<&Segment> {
        // Times are multiples of the policy's period, which is not exact in binary.
        self.segments.iter().find(|segment| t < segment.end_s - 1e-6)
    }

    /// Returns the file: CSV with a line for each segment.
    pub fn to_csv(&self) -> String {
        let starts = std::iter::once(0.0).chain(self.segments.iter().map(|segment| segment.end_s));
        let lines = starts.zip(&self.segments).map(|(start, Segment { end_s, velocity: [vx, vy, wz], gait })| {
            let gait = gait.map_or_else(String::new, |[f, fr, rl, rr]| format!(",{f},{fr},{rl},{rr}"));
            format!("{start},{end_s},{vx},{vy},{wz}{gait}\n")
        });
        let gait = if self.has_gaits() { GAIT_HEADER } else { "" };
        format!("{HEADER}{gait}\n{}", lines.collect::<String>())
    }

    /// Reads a file.
    pub fn parse(text: &str) -> Result<Self, SequenceError> {
        let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        let wrong = |line: usize, reason: String| Err(SequenceError { line: line + 1, reason });
        let header = match lines.next() {
            Some((_, header))
                if [HEADER.to_owned(), format!("{HEADER}{GAIT_HEADER}")].contains(&header.trim().into()) =>
            {
                header.trim()
            }
            other => {
                let found = other.map_or("nothing".to_owned(), |(_, header)| format!("`{}`", header.trim()));
                return wrong(0, format!("the header is {found}; it must be `{HEADER}` or `{HEADER}{GAIT_HEADER}`"));
            }
        };
        let mut segments: Vec<Segment> = Vec::new();
        for (line, cells) in lines {
            let start = segments.last().map_or(0.0, |segment| segment.end_s);
            match segment(header, cells, start) {
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

/// Reads a line of a file with this header. `expected` is the end of the segment before [s].
fn segment(header: &str, line: &str, expected: f64) -> Result<Segment, String> {
    let names: Vec<&str> = header.split(',').collect();
    let cells: Vec<&str> = line.split(',').map(str::trim).collect();
    if cells.len() != names.len() {
        return Err(format!("`{line}` has {} cells; {} are expected: {header}", cells.len(), names.len()));
    }
    let number = |index: usize| {
        let value = cells[index].parse::<f64>().ok().filter(|value| value.is_finite());
        value.ok_or_else(|| format!("`{}` = `{}` is not a finite number", names[index], cells[index]))
    };
    let (start, end_s) = (number(0)?, number(1)?);
    if (start - expected).abs() > 1e-6 {
        return Err(format!("`start_s` = {start} is not {expected}, where the segment before ends"));
    }
    if end_s <= start {
        return Err(format!("`end_s` = {end_s} is not greater than `start_s` = {start}"));
    }
    let bounded = |index: usize, [low, high]: [f32; 2]| {
        let value = number(index)? as f32;
        let is_allowed = (low..=high).contains(&value);
        if is_allowed { Ok(value) } else { Err(format!("`{}` = {value} is outside {low} to {high}", names[index])) }
    };
    let velocity = |index: usize| bounded(index, [-MAX_VELOCITY, MAX_VELOCITY]);
    let velocity = [velocity(2)?, velocity(3)?, velocity(4)?];
    let phase = |index: usize| bounded(index, [0.0, 1.0]);
    let gait = if names.len() > 5 {
        Some([bounded(5, [0.0, MAX_STEP_FREQUENCY])?, phase(6)?, phase(7)?, phase(8)?])
    } else {
        None
    };
    Ok(Segment { end_s, velocity, gait })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const RANGES: CommandRanges =
        CommandRanges { velocity: [[-1.0, 1.0], [-0.5, 0.5], [-1.0, 1.0]], step_frequency: None };
    const GAIT_RANGES: CommandRanges =
        CommandRanges { velocity: [[-1.0, 1.0], [0.0, 0.0], [-1.0, 1.0]], step_frequency: Some([2.0, 4.0]) };

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
            (
                "start_s,end_s,vx,vy,wz,step_frequency,phase_fr,phase_rl,phase_rr\n0,5,1,0,0,3,0.5,0.5,2\n",
                "line 2: `phase_rr` = 2 is outside 0 to 1",
            ),
        ];
        for (text, expected) in cases {
            let error = CommandSequence::parse(text).expect_err(expected).to_string();
            assert!(error.starts_with(expected), "{error}");
        }
    }

    #[test]
    fn gaits_are_the_four_quarters_of_their_coordinate() {
        let gaits: Vec<_> = [-1.0, -0.3, 0.3, 1.0]
            .map(|gait| CommandSequence::from_coordinates(1.0, &[0.0, 0.7, 0.0, 0.0, gait], &GAIT_RANGES).gait_at(0.0))
            .to_vec();
        let expected = Gait::ALL.map(|gait| {
            let [fr, rl, rr] = gait.phase_offset();
            Some([3.0, fr, rl, rr])
        });
        assert_eq!(gaits, expected);
    }

    proptest! {
        #[test]
        fn file_and_coordinates_return_a_sequence_with_gaits(
            coordinates in prop::collection::vec(-1.0..1.0f64, 5..30),
            segment_s in 0.1..10.0f64,
        ) {
            let sequence = CommandSequence::from_coordinates(segment_s, &coordinates, &GAIT_RANGES);
            prop_assert_eq!(&CommandSequence::parse(&sequence.to_csv()).expect("a valid file"), &sequence);
            let again = CommandSequence::from_coordinates(segment_s, &sequence.coordinates(&GAIT_RANGES), &GAIT_RANGES);
            for (one, other) in again.segments().iter().zip(sequence.segments()) {
                prop_assert_eq!(one.gait.map(|gait| [gait[1], gait[2], gait[3]]), other.gait.map(|gait| [gait[1], gait[2], gait[3]]));
                prop_assert!((one.velocity[0] - other.velocity[0]).abs() < 1e-5);
            }
        }

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
