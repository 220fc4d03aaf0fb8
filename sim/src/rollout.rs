//! Rollouts in the batch engine: every candidate has a lane.

use twinstep_model::lanes::Instructions;
use twinstep_model::{Ground, Job, Placement, RobotModel, RobotStates, Rollout};

use crate::batch::{Inputs, Lanes, Robots, Time, lane_robots};
use crate::{BuildError, SimConfig};

/// Most candidates that are stepped together: enough for all cores, few enough for their caches.
const TOGETHER: usize = 512;

/// Candidates in the lanes of the batch engine.
pub struct BatchRollout {
    robots: Box<dyn Robots>,
    pool: Option<rayon::ThreadPool>,
    steps: usize,
}

impl BatchRollout {
    /// Rollouts on flat ground, at the rate, base and threads of `config`, for robots with the drive's rate of `robot`.
    pub fn new(robot: &RobotModel, config: &SimConfig) -> Result<Self, BuildError> {
        config.check(&robot.control)?;
        let pool = if config.threads == 1 { None } else { Some(crate::rapier::thread_pool(config.threads)?) };
        let (start, lanes) =
            (Placement::at_rest(1.0, robot.control.default_pose_f32()), Lanes::Single(Instructions::best()));
        let robots = lane_robots(lanes, robot, config, &Ground::FLAT, &start, TOGETHER);
        Ok(Self { robots, pool, steps: config.steps_per_drive_period(&robot.control) })
    }

    fn play_together(&mut self, jobs: &[Job]) -> Vec<RobotStates> {
        let mut now = RobotStates::new(TOGETHER);
        let mut records: Vec<_> = jobs.iter().map(|job| RobotStates::new(job.commands.len() + 1)).collect();
        for (robot, job) in jobs.iter().enumerate() {
            self.robots.place(robot, job.robot, &job.start);
            self.robots.read(robot, &mut now);
            records[robot].copy_robot(0, &now, robot);
        }
        let longest = jobs.iter().map(|job| job.commands.len()).max().unwrap_or(0);
        let hold = twinstep_model::Command::hold([0.0; 12], 0.0, 0.0);
        let (mut commands, mut active) = (vec![hold; TOGETHER], vec![false; TOGETHER]);
        for period in 0..longest {
            for (robot, job) in jobs.iter().enumerate() {
                active[robot] = period < job.commands.len();
                if active[robot] {
                    commands[robot] = job.commands[period];
                }
            }
            let time = Time { drive_periods: 1, steps: self.steps };
            self.robots.advance(self.pool.as_ref(), Inputs::Commands(&commands), &active, time, &mut now);
            for (robot, record) in records.iter_mut().enumerate().filter(|(robot, _)| active[*robot]) {
                record.copy_robot(period + 1, &now, robot);
            }
        }
        records
    }
}

impl Rollout for BatchRollout {
    fn play(&mut self, jobs: &[Job]) -> Vec<RobotStates> {
        jobs.chunks(TOGETHER).flat_map(|jobs| self.play_together(jobs)).collect()
    }
}
