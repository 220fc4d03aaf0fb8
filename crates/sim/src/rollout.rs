//! Rollouts in the batch engine: one candidate per SIMD lane, and one batch of candidates per task of the thread pool.

use std::cmp::Reverse;

use rayon::prelude::*;
use twinstep_simd::InstructionSet;
use twinstep_model::{Ground, RolloutRequest, Precision, RobotModel, RobotStates, Rollout, BaseMount};

use crate::batch::{SimdPrecision, batch_simulator};
use crate::{BackendBuildError, SimConfig};

/// Returns the number of candidates in a batch: the lanes of the widest register of any processor.
fn together(precision: Precision) -> usize {
    match precision {
        Precision::Single => 16,
        Precision::Double => 4,
    }
}

/// Rollouts in the batch engine on flat ground.
pub struct BatchRollout {
    robot: RobotModel,
    config: SimConfig,
    pool: rayon::ThreadPool,
}

impl BatchRollout {
    /// Creates rollouts with the rates and threads of `config`. All candidates have the actuator rate of `robot`.
    pub fn new(robot: &RobotModel, config: &SimConfig) -> Result<Self, BackendBuildError> {
        config.check(&robot.control)?;
        let pool = crate::rapier::thread_pool(config.threads)?;
        Ok(Self { robot: robot.clone(), config: *config, pool })
    }

    /// Runs requests that all have a fixed base, or all a floating base.
    fn play_together(&self, jobs: &[&RolloutRequest], precision: Precision) -> Vec<RobotStates> {
        let lanes = match precision {
            Precision::Single => SimdPrecision::Single(InstructionSet::best()),
            Precision::Double => SimdPrecision::Double,
        };
        let base = if jobs[0].held { BaseMount::Fixed } else { BaseMount::Floating };
        let config = SimConfig { base, ..self.config };
        let mut robots = batch_simulator(lanes, &self.robot, &config, &Ground::FLAT, &jobs[0].start, jobs.len());
        let mut start = RobotStates::new(jobs.len());
        let mut records: Vec<_> = jobs.iter().map(|job| RobotStates::new(job.commands.len() + 1)).collect();
        for (robot, (job, record)) in jobs.iter().zip(&mut records).enumerate() {
            robots.place(robot, job.robot, &job.start);
            robots.read(robot, &mut start);
            record.copy_robot(0, &start, robot);
        }
        let steps = self.config.steps_per_actuator_period(&self.robot.control);
        robots.remember(&jobs.iter().map(|job| job.history).collect::<Vec<_>>(), steps);
        robots.play(&jobs.iter().map(|job| job.commands).collect::<Vec<_>>(), steps, &mut records);
        records
    }
}

impl Rollout for BatchRollout {
    fn run(&mut self, jobs: &[RolloutRequest], precision: Precision) -> Vec<RobotStates> {
        let (this, size) = (&*self, together(precision));
        // Sorted by length, so that the candidates of a batch have similar lengths.
        let mut order: Vec<usize> = (0..jobs.len()).collect();
        order.sort_by_key(|index| Reverse(jobs[*index].commands.len()));
        let (held, free): (Vec<usize>, Vec<usize>) = order.into_iter().partition(|index| jobs[*index].held);
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
