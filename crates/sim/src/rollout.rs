//! Rollouts in the batch engine: one candidate per SIMD lane, and one batch of candidates per task of the thread pool.

use std::cmp::Reverse;
use std::sync::Arc;

use rayon::prelude::*;
use twinstep_model::{Ground, Precision, RobotModel, RobotStates, Rollout, RolloutRequest};
use twinstep_simd::InstructionSet;

use crate::batch::{SimdPrecision, batch_simulator};
use crate::{BackendBuildError, SimConfig};

/// Returns the number of candidates in a batch: the lanes of the widest register of any processor.
fn batch_size(precision: Precision) -> usize {
    match precision {
        Precision::Single => 16,
        Precision::Double => 4,
    }
}

/// Rollouts in the batch engine on flat ground.
pub struct BatchRollout {
    robot: RobotModel,
    config: SimConfig,
    pool: Arc<rayon::ThreadPool>,
}

impl BatchRollout {
    /// Creates rollouts with the rates and threads of `config`. `robot` is the nominal robot.
    pub fn new(robot: &RobotModel, config: &SimConfig) -> Result<Self, BackendBuildError> {
        config.check(&robot.control)?;
        let pool = crate::thread_pool::thread_pool(config.threads)?;
        Ok(Self { robot: robot.clone(), config: *config, pool })
    }

    /// Runs requests that have one base mount and one actuator rate.
    fn run_batch(&self, jobs: &[&RolloutRequest], precision: Precision) -> Vec<RobotStates> {
        let lanes = match precision {
            Precision::Single => SimdPrecision::Single(InstructionSet::best()),
            Precision::Double => SimdPrecision::Double,
        };
        let mut robot = self.robot.clone();
        robot.control.actuator_hz = jobs[0].robot.control.actuator_hz;
        let config = SimConfig { base: jobs[0].base, ..self.config }.at_actuator_rate(&robot.control);
        let mut robots = batch_simulator(lanes, &robot, &config, &Ground::FLAT, &jobs[0].start, jobs.len());
        let mut start = RobotStates::new(jobs.len());
        let mut records: Vec<_> = jobs.iter().map(|job| RobotStates::new(job.commands.len() + 1)).collect();
        for (robot, (job, record)) in jobs.iter().zip(&mut records).enumerate() {
            robots.place(robot, job.robot, &job.start);
            robots.read(robot, &mut start);
            record.copy_robot(0, &start, robot);
        }
        let steps = config.steps_per_actuator_period(&robot.control);
        robots.remember(&jobs.iter().map(|job| job.history).collect::<Vec<_>>(), steps);
        robots.play(jobs, steps, &mut records);
        records
    }
}

impl Rollout for BatchRollout {
    fn run(&mut self, jobs: &[RolloutRequest], precision: Precision) -> Vec<RobotStates> {
        let (this, size) = (&*self, batch_size(precision));
        // Sorted by length, so that the candidates of a batch have similar lengths.
        let mut order: Vec<usize> = (0..jobs.len()).collect();
        order.sort_by_key(|index| Reverse(jobs[*index].commands.len()));
        // Fixed bases first; within a mount by actuator rate.
        let group = |index: &usize| (!jobs[*index].base.is_fixed(), jobs[*index].robot.control.actuator_hz as u32);
        order.sort_by_key(group);
        let chunks: Vec<&[usize]> =
            order.chunk_by(|a, b| group(a) == group(b)).flat_map(|group| group.chunks(size)).collect();
        let run = |chunk: &&[usize]| {
            let batch: Vec<_> = chunk.iter().map(|index| &jobs[*index]).collect();
            chunk.iter().copied().zip(this.run_batch(&batch, precision)).collect::<Vec<_>>()
        };
        let mut results: Vec<_> = self.pool.install(|| chunks.par_iter().flat_map_iter(run).collect());
        results.sort_by_key(|(index, _)| *index);
        results.into_iter().map(|(_, states)| states).collect()
    }
}
