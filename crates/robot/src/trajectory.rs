//! Motion through poses, linear in time between them.

use std::time::Duration;

use twinstep_model::PerJoint;

/// Longest time by which a trajectory advances at once. After a pause of the loop it continues, and does not jump.
const MAX_ADVANCE: Duration = Duration::from_millis(10);

/// Motion through poses.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Trajectory {
    start: PerJoint,
    /// Poses [rad], each with the time to reach it from the one before.
    poses: Vec<(PerJoint, Duration)>,
    elapsed: Duration,
}

impl Trajectory {
    pub fn new(start: PerJoint, poses: Vec<(PerJoint, Duration)>) -> Self {
        Self { start, poses, elapsed: Duration::ZERO }
    }

    /// Advances by `dt`.
    pub fn advance(&mut self, dt: Duration) {
        self.elapsed += dt.min(MAX_ADVANCE);
    }

    /// Returns the present pose [rad].
    pub fn pose(&self) -> PerJoint {
        let (mut from, mut left) = (self.start, self.elapsed);
        for (to, time) in &self.poses {
            if left < *time {
                let share = left.as_secs_f32() / time.as_secs_f32();
                return std::array::from_fn(|joint| from[joint] + share * (to[joint] - from[joint]));
            }
            (from, left) = (*to, left.saturating_sub(*time));
        }
        from
    }

    /// Returns how long ago the last pose was reached, or `None` before.
    pub fn finished_for(&self) -> Option<Duration> {
        self.elapsed.checked_sub(self.poses.iter().map(|(_, time)| *time).sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_are_reached_in_their_times() {
        let second = Duration::from_secs(1);
        let mut trajectory = Trajectory::new([0.0; 12], vec![([1.0; 12], second), ([-1.0; 12], 2 * second)]);
        let mut at = |seconds: f32| {
            while trajectory.elapsed.as_secs_f32() < seconds {
                trajectory.advance(Duration::from_millis(2));
            }
            (trajectory.pose()[5], trajectory.finished_for())
        };
        assert_eq!(at(0.5), (0.5, None));
        assert_eq!(at(1.0), (1.0, None));
        assert_eq!(at(2.0), (0.0, None));
        assert_eq!(at(3.5), (-1.0, Some(Duration::from_millis(500))));
    }

    #[test]
    fn pause_of_the_loop_is_not_a_jump() {
        let mut trajectory = Trajectory::new([0.0; 12], vec![([1.0; 12], Duration::from_secs(1))]);
        trajectory.advance(Duration::from_secs(5));
        assert!(trajectory.pose()[0] <= 0.011);
    }
}
