//! Rollouts in the batch engine: every candidate has a lane, and a register of candidates goes its whole way on one thread.

use rayon::prelude::*;
use twinstep_model::lanes::Instructions;
use twinstep_model::{Command, Ground, Job, Placement, Precision, RobotModel, RobotStates, Rollout};

use crate::batch::{Inputs, Lanes, Time, lane_robots};
use crate::{Base, BuildError, SimConfig};

/// Candidates that are stepped together: the widest register of all processors.
fn together(precision: Precision) -> usize {
    match precision {
        Precision::Single => 16,
        Precision::Double => 4,
    }
}

/// Candidates in the lanes of the batch engine, on flat ground.
pub struct BatchRollout {
    robot: RobotModel,
    config: SimConfig,
    pool: rayon::ThreadPool,
}

impl BatchRollout {
    /// At the rate and on the threads of `config`, for candidates with the drive's rate of `robot`.
    pub fn new(robot: &RobotModel, config: &SimConfig) -> Result<Self, BuildError> {
        config.check(&robot.control)?;
        let pool = crate::rapier::thread_pool(config.threads)?;
        Ok(Self { robot: robot.clone(), config: *config, pool })
    }

    /// Plays jobs whose trunks are all held, or all free.
    fn play_together(&self, jobs: &[&Job], precision: Precision) -> Vec<RobotStates> {
        let lanes = match precision {
            Precision::Single => Lanes::Single(Instructions::best()),
            Precision::Double => Lanes::Double,
        };
        let base = if jobs[0].held { Base::Fixed } else { Base::Floating };
        let config = SimConfig { base, ..self.config };
        let start = Placement::at_rest(1.0, self.robot.control.default_pose_f32());
        let mut robots = lane_robots(lanes, &self.robot, &config, &Ground::FLAT, &start, jobs.len());
        let mut now = RobotStates::new(jobs.len());
        let mut records: Vec<_> = jobs.iter().map(|job| RobotStates::new(job.commands.len() + 1)).collect();
        for (robot, job) in jobs.iter().enumerate() {
            robots.place(robot, job.robot, &job.start);
            robots.read(robot, &mut now);
            records[robot].copy_robot(0, &now, robot);
        }
        let longest = jobs.iter().map(|job| job.commands.len()).max().unwrap_or(0);
        let mut commands = vec![Command::hold([0.0; 12], 0.0, 0.0); jobs.len()];
        let time = Time { drive_periods: 1, steps: self.config.steps_per_drive_period(&self.robot.control) };
        for period in 0..longest {
            let active: Vec<bool> = jobs.iter().map(|job| period < job.commands.len()).collect();
            for (command, job) in commands.iter_mut().zip(jobs) {
                *command = job.commands.get(period).copied().unwrap_or(*command);
            }
            robots.advance(None, Inputs::Commands(&commands), &active, time, &mut now);
            for (robot, record) in records.iter_mut().enumerate().filter(|(robot, _)| active[*robot]) {
                record.copy_robot(period + 1, &now, robot);
            }
        }
        records
    }
}

impl Rollout for BatchRollout {
    fn play(&mut self, jobs: &[Job], precision: Precision) -> Vec<RobotStates> {
        let (this, size) = (&*self, together(precision));
        let (held, free): (Vec<usize>, Vec<usize>) = (0..jobs.len()).partition(|index| jobs[*index].held);
        let chunks: Vec<&[usize]> = held.chunks(size).chain(free.chunks(size)).collect();
        let play = |chunk: &&[usize]| {
            let together: Vec<_> = chunk.iter().map(|index| &jobs[*index]).collect();
            chunk.iter().copied().zip(this.play_together(&together, precision)).collect::<Vec<_>>()
        };
        let mut played: Vec<_> = self.pool.install(|| chunks.par_iter().flat_map_iter(play).collect());
        played.sort_by_key(|(index, _)| *index);
        played.into_iter().map(|(_, states)| states).collect()
    }
}
