//! Levels of the robots on a course: a robot that walks far goes on to more difficult ground, another one goes back.
//!
//! The rule is that of Rudin et al. 2021, section 3.2: up after half the side of a patch, down if the robot has walked less than
//! half of what its commands would be in a whole episode, so that a fall counts. A robot that leaves the last level goes on at a
//! random one.

use rand::RngExt;
use twinstep_model::{Patches, Stream};

/// Share of the commanded distance below which a robot goes back a level.
const MIN_WALKED_SHARE: f32 = 0.5;

/// The robots of a batch on the patches of a course.
#[derive(Clone, Debug)]
pub struct Course {
    patches: Patches,
    /// Policy steps of a whole episode.
    episode_steps: u32,
    robots: Vec<Walker>,
}

/// A robot on its patch.
#[derive(Clone, Copy, Debug, Default)]
struct Walker {
    level: usize,
    start: [f32; 2],
    /// Policy steps of the episode, and the distance that was commanded in them [m].
    steps: u32,
    commanded: f32,
}

impl Course {
    /// Creates robots that have not started, whose episodes have at most this number of policy steps.
    pub fn new(patches: Patches, episode_steps: u32, robots: usize) -> Self {
        Self { patches, episode_steps, robots: vec![Walker::default(); robots] }
    }

    /// Returns where a robot starts its next episode: x [m], y [m] and yaw [rad]. Robots are distributed evenly over the kinds, and
    /// in their first episode over the levels.
    ///
    /// `walked_to` is where its last episode has ended; `None` for its first one.
    pub fn start(&mut self, robot: usize, walked_to: Option<[f32; 2]>, random: &mut Stream) -> [f32; 3] {
        let Self { patches, episode_steps, robots } = self;
        let walker = &mut robots[robot];
        // Drawn always, so that what follows does not depend on the last episode.
        let (any_level, yaw) = (random.random_range(0..patches.levels), random.random_range(-1.0f32..1.0));
        walker.level = match walked_to {
            None => robot / patches.columns % patches.levels,
            Some([x, y]) => {
                let walked = (x - walker.start[0]).hypot(y - walker.start[1]);
                let whole = walker.commanded * *episode_steps as f32 / walker.steps.max(1) as f32;
                if walked > 0.5 * patches.side {
                    if walker.level + 1 < patches.levels { walker.level + 1 } else { any_level }
                } else if walked < MIN_WALKED_SHARE * whole {
                    walker.level.saturating_sub(1)
                } else {
                    walker.level
                }
            }
        };
        walker.start = patches.centre(walker.level, robot % patches.columns);
        (walker.steps, walker.commanded) = (0, 0.0);
        [walker.start[0], walker.start[1], yaw * std::f32::consts::PI]
    }

    /// Adds the distance that is commanded in a step [m].
    pub fn command(&mut self, robot: usize, distance: f32) {
        self.robots[robot].steps += 1;
        self.robots[robot].commanded += distance;
    }

    /// Returns the mean level of the robots; the first is 0.
    pub fn mean_level(&self) -> f64 {
        self.robots.iter().map(|walker| walker.level as f64).sum::<f64>() / self.robots.len().max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::stream;

    use super::*;

    const PATCHES: Patches = Patches { origin: [-20.0, -8.0], side: 8.0, levels: 5, columns: 2 };
    const STEPS: u32 = 1000;

    fn level_of(course: &Course, robot: usize) -> usize {
        course.robots[robot].level
    }

    #[test]
    fn robots_start_in_the_middle_of_a_patch_of_their_kind() {
        let (mut course, mut random) = (Course::new(PATCHES, STEPS, 20), stream(1, "test", 0));
        for robot in 0..20 {
            let [x, y, yaw] = course.start(robot, None, &mut random);
            assert_eq!([x, y], PATCHES.centre(level_of(&course, robot), robot % 2));
            assert!(yaw.abs() <= std::f32::consts::PI);
        }
        let at = |level: usize| (0..20).filter(|robot| level_of(&course, *robot) == level).count();
        assert!((0..5).all(|level| at(level) == 4), "evenly over the levels");
    }

    #[test]
    fn robot_that_walks_far_goes_up_and_one_that_stays_behind_its_command_goes_down() {
        let (mut course, mut random) = (Course::new(PATCHES, STEPS, 1), stream(1, "test", 0));
        let mut after_steps = |course: &mut Course, steps: u32, level: usize, walked: f32, commanded: f32| {
            let [x, y] = PATCHES.centre(level, 0);
            course.robots[0] = Walker { level, start: [x, y], steps, commanded };
            course.start(0, Some([x + walked, y]), &mut random);
            level_of(course, 0)
        };
        assert_eq!(after_steps(&mut course, STEPS / 10, 1, 0.9, 1.0), 0, "it followed its command for 2 s, and fell");
        let mut after =
            |course: &mut Course, level, walked, commanded| after_steps(course, STEPS, level, walked, commanded);
        assert_eq!(after(&mut course, 1, 4.1, 10.0), 2);
        assert_eq!(after(&mut course, 1, 3.9, 10.0), 0);
        assert_eq!(after(&mut course, 1, 3.9, 7.0), 1);
        assert_eq!(after(&mut course, 0, 0.0, 10.0), 0);
        let after_the_last: Vec<usize> = (0..50).map(|_| after(&mut course, 4, 5.0, 5.0)).collect();
        assert!((0..5).all(|level| after_the_last.contains(&level)), "{after_the_last:?}");
    }
}
