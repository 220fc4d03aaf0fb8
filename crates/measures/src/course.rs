//! How steep and high a ground a policy walks: the share of robots that leave their patch of a course, by kind and level.

use serde::Serialize;
use twinstep_envs::WalkConfig;
use twinstep_envs::tasks::walk_config::CommandRanges;
use twinstep_model::{EnvError, Patches};
use twinstep_sim::{CourseTerrain, PatchKind};

use crate::{Measure, Step};

/// Distance from the start along either axis at which a robot has arrived [m]: every step and slope of its patch is behind it.
const ARRIVED: f32 = 3.8;
/// Policy steps between two looks at the position.
const LOOK_STEPS: usize = 25;
/// Share of the robots that must arrive at a level for it to count as passed, as in RoboGauge: 4 of 5.
const PASSED: f64 = 0.8;

/// What became of the robots on the patches of a kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KindOfGround {
    /// The kind.
    pub kind: PatchKind,
    /// Number of levels that are passed, from the first one on without a gap: at each, 80 % of the robots arrive.
    pub passed: usize,
    /// What is at each level.
    pub levels: Vec<Level>,
}

/// What became of the robots at a level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Level {
    /// Angle [rad] or height [m] of the ground.
    pub size: f32,
    /// Number of robots.
    pub robots: usize,
    /// Number of robots that left the patch without a fall.
    pub arrived: usize,
}

/// Measures which robots leave their patch.
pub struct CourseWalking {
    terrain: CourseTerrain,
    patches: Patches,
    /// Level, column and place of the start of each robot.
    starts: Vec<Option<(usize, usize, [f32; 2])>>,
    arrived: Vec<bool>,
}

impl CourseWalking {
    /// Time within which a robot must arrive [s].
    pub const SECONDS: f64 = 20.0;

    /// Forward velocity that RoboGauge commands on stairs and obstacles [m/s].
    pub const SPEED: f32 = 0.8;

    /// Prepares the measure of this number of robots on a course.
    pub fn new(terrain: CourseTerrain, robots: usize) -> Self {
        let patches = terrain.patches();
        Self { terrain, patches, starts: vec![None; robots], arrived: vec![false; robots] }
    }

    /// Returns the settings of the task for a policy with these: forward at `speed` [m/s], while the robot turns to a random
    /// heading.
    pub fn task(trained: &WalkConfig, speed: f32) -> WalkConfig {
        let command = CommandRanges {
            linear_velocity_x: [speed; 2],
            linear_velocity_y: [0.0; 2],
            angular_velocity_z: [-1.0, 1.0],
        };
        WalkConfig {
            command,
            heading_probability: 1.0,
            standing_probability: 0.0,
            command_resample_s: 1e3,
            frames: trained.frames,
            ..WalkConfig::default()
        }
    }

    /// Returns the patch of a position.
    fn patch(&self, [x, y]: [f32; 2]) -> (usize, usize) {
        let Patches { origin, side, levels, columns } = self.patches;
        let index = |at: f32, origin: f32, count: usize| (((at - origin) / side).max(0.0) as usize).min(count - 1);
        (index(x, origin[0], levels), index(y, origin[1], columns))
    }
}

impl Measure for CourseWalking {
    type Found = Vec<KindOfGround>;

    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError> {
        if !step.index.is_multiple_of(LOOK_STEPS) {
            return Ok(());
        }
        for robot in step.robots() {
            if self.arrived[robot] {
                continue;
            }
            let [x, y, ..] = step.scene(robot)?.pose[0];
            match self.starts[robot] {
                None => {
                    let (level, column) = self.patch([x, y]);
                    self.starts[robot] = Some((level, column, [x, y]));
                }
                Some((_, _, start)) => self.arrived[robot] = (x - start[0]).abs().max((y - start[1]).abs()) > ARRIVED,
            }
        }
        Ok(())
    }

    fn found(self, _has_fallen: &[bool]) -> Vec<KindOfGround> {
        let kinds = self.terrain.columns().into_iter().enumerate();
        let of_kind = |(column, (kind, range))| {
            let size = |level| CourseTerrain::size(range, level, self.terrain.levels);
            let mut levels: Vec<Level> =
                (0..self.patches.levels).map(|level| Level { size: size(level), ..Level::default() }).collect();
            for ((level, own, _), arrived) in
                self.starts.iter().zip(&self.arrived).filter_map(|(start, arrived)| Some(((*start)?, *arrived)))
            {
                if own == column {
                    levels[level].robots += 1;
                    levels[level].arrived += usize::from(arrived);
                }
            }
            let is_passed = |level: &&Level| level.arrived as f64 >= PASSED * level.robots.max(1) as f64;
            KindOfGround { kind, passed: levels.iter().take_while(is_passed).count(), levels }
        };
        kinds.map(of_kind).collect()
    }
}
