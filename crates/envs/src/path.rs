//! Paths on the ground: pose and velocity of a reference that moves along arcs.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use rand::RngExt;
use serde::{Deserialize, Serialize};
use twinstep_model::Stream;

/// Yaw rate in the corners of the square [rad/s].
const CORNER_RATE: f32 = 1.0;
/// Durations of the parts of a random path [s].
const RANDOM_DURATION: [f32; 2] = [1.0, 4.0];
/// Number of different parts of a random path.
const RANDOM_PARTS: usize = 8;

/// Shape of a path.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PathShape {
    /// Arcs and straight lines of random velocity, forward, sideways and turning: for training.
    #[default]
    Random,
    /// A circle to the left.
    Circle,
    /// A circle to the left, then one to the right.
    FigureEight,
    /// A square to the left with turns on the spot. Its sides are twice the radius.
    Square,
}

/// Pose on the ground: position [m], yaw [rad].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GroundPose {
    /// Position along the world's x axis [m].
    pub x: f32,
    /// Position along the world's y axis [m].
    pub y: f32,
    /// Yaw, positive to the left [rad].
    pub yaw: f32,
}

/// Part of a path with constant velocity in the frame of the reference.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Part {
    /// Forward [m/s], left [m/s], yaw rate [rad/s].
    velocity: [f32; 3],
    /// Duration [s].
    duration: f32,
}

/// A path; after its last part it begins again at the pose that it has reached.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Path {
    parts: Vec<Part>,
}

impl GroundPose {
    /// Returns the pose after `time` seconds of constant velocity in the frame of the pose.
    fn moved(self, [vx, vy, rate]: [f32; 3], time: f32) -> Self {
        let turned = rate * time;
        // Integrals of the cosine and sine of the yaw; their series where the rate is small.
        let (along, across) = if turned.abs() < 1e-3 {
            (time, 0.5 * turned * time)
        } else {
            (turned.sin() / rate, (1.0 - turned.cos()) / rate)
        };
        let (forward, left) = (vx * along - vy * across, vx * across + vy * along);
        let (sin, cos) = self.yaw.sin_cos();
        Self {
            x: self.x + cos * forward - sin * left,
            y: self.y + sin * forward + cos * left,
            yaw: wrapped(self.yaw + turned),
        }
    }

    /// Returns this pose relative to `other`, in the frame of `other`: forward [m], left [m], yaw [rad].
    pub fn relative_to(self, other: Self) -> [f32; 3] {
        let (dx, dy) = (self.x - other.x, self.y - other.y);
        let (sin, cos) = other.yaw.sin_cos();
        [cos * dx + sin * dy, cos * dy - sin * dx, wrapped(self.yaw - other.yaw)]
    }
}

/// Returns an angle within −π to π.
fn wrapped(angle: f32) -> f32 {
    angle - TAU * ((angle + PI) / TAU).floor()
}

impl Path {
    /// Returns a path of this shape. Shapes other than random have this radius [m] and speed [m/s].
    ///
    /// The parts of a random path have velocities within `ranges`: forward, left, yaw rate.
    pub fn new(shape: PathShape, radius: f32, speed: f32, ranges: [[f32; 2]; 3], random: &mut Stream) -> Self {
        let arc = |rate: f32| Part { velocity: [speed, 0.0, rate], duration: TAU * radius / speed };
        let parts = match shape {
            PathShape::Circle => vec![arc(speed / radius)],
            PathShape::FigureEight => vec![arc(speed / radius), arc(-speed / radius)],
            PathShape::Square => vec![
                Part { velocity: [speed, 0.0, 0.0], duration: 2.0 * radius / speed },
                Part { velocity: [0.0, 0.0, CORNER_RATE], duration: FRAC_PI_2 / CORNER_RATE },
            ],
            PathShape::Random => (0..RANDOM_PARTS).map(|_| random_part(ranges, random)).collect(),
        };
        Self { parts }
    }

    /// Returns the velocity at `time` [s] in the frame of the reference: forward [m/s], left [m/s], yaw rate [rad/s].
    pub fn velocity(&self, time: f32) -> [f32; 3] {
        let mut left = time % self.duration();
        for part in &self.parts {
            if left < part.duration {
                return part.velocity;
            }
            left -= part.duration;
        }
        self.parts.last().map_or([0.0; 3], |part| part.velocity)
    }

    /// Returns the pose after `time` seconds of this path and `dt` more, from that after `time` seconds.
    pub fn advance(&self, mut pose: GroundPose, time: f32, dt: f32) -> GroundPose {
        let (mut left, mut start) = (dt, time % self.duration());
        for part in self.parts.iter().cycle() {
            if start >= part.duration {
                start -= part.duration;
                continue;
            }
            let step = left.min(part.duration - start);
            pose = pose.moved(part.velocity, step);
            left -= step;
            start = 0.0;
            if left <= 0.0 {
                break;
            }
        }
        pose
    }

    fn duration(&self) -> f32 {
        self.parts.iter().map(|part| part.duration).sum()
    }
}

fn random_part(ranges: [[f32; 2]; 3], random: &mut Stream) -> Part {
    let mut within = |[low, high]: [f32; 2]| low + (high - low) * random.random::<f32>();
    Part { velocity: ranges.map(&mut within), duration: within(RANDOM_DURATION) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use twinstep_model::stream;

    use super::*;

    const RANGES: [[f32; 2]; 3] = [[-1.0, 1.0], [-0.5, 0.5], [-1.0, 1.0]];

    fn path(shape: PathShape) -> Path {
        Path::new(shape, 1.0, 0.5, RANGES, &mut stream(3, "path", 0))
    }

    /// Returns the poses every `dt` seconds.
    fn poses(path: &Path, dt: f32, count: usize) -> Vec<GroundPose> {
        let step = |(time, pose): &mut (f32, GroundPose), _| {
            *pose = path.advance(*pose, *time, dt);
            *time += dt;
            Some(*pose)
        };
        (0..count).scan((0.0, GroundPose::default()), step).collect()
    }

    #[test]
    fn circle_has_its_radius_and_ends_where_it_began() {
        let round = TAU / 0.5;
        let circle = poses(&path(PathShape::Circle), round / 100.0, 100);
        for pose in &circle {
            assert!((pose.x.hypot(pose.y - 1.0) - 1.0).abs() < 1e-4, "{pose:?}");
        }
        let end = circle[99];
        assert!(end.x.abs() < 1e-3 && end.y.abs() < 1e-3 && end.yaw.abs() < 1e-3, "{end:?}");
        assert!((circle[24].x - 1.0).abs() < 1e-3 && (circle[24].y - 1.0).abs() < 1e-3, "a quarter: {:?}", circle[24]);
    }

    #[test]
    fn figure_eight_turns_left_then_right_and_square_has_its_corners() {
        let eight = poses(&path(PathShape::FigureEight), TAU / 25.0, 100);
        assert!(
            (eight[24].y - 2.0).abs() < 1e-3 && (eight[74].y + 2.0).abs() < 1e-3,
            "{:?} {:?}",
            eight[24],
            eight[74]
        );
        assert!(eight[99].x.hypot(eight[99].y) < 1e-3, "{:?}", eight[99]);
        // A side takes 4 s, a corner π/2 s.
        let corner = poses(&path(PathShape::Square), 4.0 + FRAC_PI_2, 3);
        let expected = [[2.0, 0.0, FRAC_PI_2], [2.0, 2.0, PI], [0.0, 2.0, -FRAC_PI_2]];
        for (pose, expected) in corner.iter().zip(expected) {
            let error = [pose.x - expected[0], pose.y - expected[1], wrapped(pose.yaw - expected[2])];
            assert!(error.iter().all(|error| error.abs() < 1e-3), "{pose:?}");
        }
    }

    #[test]
    fn pose_relative_to_another_is_in_its_frame() {
        let facing_left = GroundPose { x: 1.0, y: 1.0, yaw: FRAC_PI_2 };
        let [forward, left, yaw] = GroundPose { x: 0.0, y: 3.0, yaw: PI }.relative_to(facing_left);
        assert!((forward - 2.0).abs() < 1e-6 && (left - 1.0).abs() < 1e-6 && (yaw - FRAC_PI_2).abs() < 1e-6);
    }

    proptest! {
        #[test]
        fn pose_is_the_integral_of_the_velocity(seed: u64, time in 0.0f32..40.0) {
            let path = Path::new(PathShape::Random, 1.0, 0.5, RANGES, &mut stream(seed, "path", 0));
            // Midpoint rule over a short time, in which the velocity may change once.
            let (dt, start) = (1e-3, GroundPose { x: 0.5, y: -0.5, yaw: 1.0 });
            let after = path.advance(start, time, dt);
            let moved = after.relative_to(start);
            let velocities = [path.velocity(time), path.velocity(time + dt)];
            for axis in 0..3 {
                let [one, other] = velocities.map(|velocity| velocity[axis]);
                let (low, high) = (one.min(other) - 2e-3, one.max(other) + 2e-3);
                prop_assert!((low..=high).contains(&(moved[axis] / dt)), "{moved:?} {velocities:?}");
            }
        }
    }
}
