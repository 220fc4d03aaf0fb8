//! Rollouts in the batch engine: one candidate per SIMD lane, and one batch of candidates per task of the thread pool.

use std::cmp::Reverse;
use std::sync::Arc;

use rayon::prelude::*;
use twinstep_model::{
    Actuator, Command, Ground, HistoryStep, NUM_JOINTS, PerJoint, Precision, RobotModel, RobotStates, Rollout,
    RolloutRequest,
};

use crate::actuator_input::ActuatorInputs;
use crate::batch::{BatchSimulator, SimdPrecision, StepCount, batch_simulator};
use crate::{BackendBuildError, SimConfig};

/// Creates the external actuators of robots, given their number and a robot with their rates.
type ActuatorFactory = dyn Fn(usize, &RobotModel) -> Box<dyn Actuator> + Send + Sync;

/// Rollouts in the batch engine on flat ground.
pub struct BatchRollout {
    robot: RobotModel,
    config: SimConfig,
    pool: Arc<rayon::ThreadPool>,
    /// `None`: analytic actuators only.
    actuators: Option<Box<ActuatorFactory>>,
}

impl BatchRollout {
    /// Creates rollouts with the rates and threads of `config`. `robot` is the nominal robot.
    pub fn new(robot: &RobotModel, config: &SimConfig) -> Result<Self, BackendBuildError> {
        config.check(robot.control.actuator_hz)?;
        let pool = crate::thread_pool::thread_pool(config.threads)?;
        Ok(Self { robot: robot.clone(), config: *config, pool, actuators: None })
    }

    /// Adds external actuators to every robot, which replace the analytic ones or add to them.
    ///
    /// `create` receives the number of robots, and a robot with their rates. The actuators must support all commands.
    #[must_use]
    pub fn with_actuators(
        self,
        create: impl Fn(usize, &RobotModel) -> Box<dyn Actuator> + Send + Sync + 'static,
    ) -> Self {
        Self { actuators: Some(Box::new(create)), ..self }
    }

    /// Runs requests that have one base mount and one actuator rate.
    fn run_batch(&self, jobs: &[&RolloutRequest], precision: Precision) -> Vec<RobotStates> {
        let mut robot = self.robot.clone();
        robot.control.actuator_hz = jobs[0].robot.control.actuator_hz;
        let config = SimConfig { base: jobs[0].base, ..self.config }.at_actuator_rate(robot.control.actuator_hz);
        let mut robots = batch_simulator(precision.into(), &robot, &config, &Ground::FLAT, &jobs[0].start, jobs.len());
        let mut start = RobotStates::new(jobs.len());
        let mut records: Vec<_> = jobs.iter().map(|job| RobotStates::new(job.commands.len() + 1)).collect();
        for (robot, (job, record)) in jobs.iter().zip(&mut records).enumerate() {
            robots.place(robot, job.robot, &job.start);
            robots.read(robot, &mut start);
            record.copy_robot(0, &start, robot);
        }
        let steps = config.steps_per_actuator_period(robot.control.actuator_hz);
        robots.remember(&jobs.iter().map(|job| job.history).collect::<Vec<_>>(), steps);
        match &self.actuators {
            Some(create) => {
                let mut stepper = ActuatedRobots { robots: &mut *robots, actuator: create(jobs.len(), &robot), steps };
                stepper.play(jobs, &mut records);
            }
            None => robots.play(jobs, steps, &mut records),
        }
        records
    }
}

/// Robots of a rollout with external actuators.
struct ActuatedRobots<'a> {
    robots: &'a mut dyn BatchSimulator,
    actuator: Box<dyn Actuator>,
    /// Physics steps per actuator period.
    steps: usize,
}

impl ActuatedRobots<'_> {
    /// Simulates every robot with the commands of its request. The state after period `i` is entry `i + 1` of its record.
    fn play(&mut self, requests: &[&RolloutRequest], records: &mut [RobotStates]) {
        let mut states = RobotStates::new(requests.len());
        let mut commands = vec![Command::hold([0.0; NUM_JOINTS], 0.0, 0.0); requests.len()];
        let mut tau = vec![[0.0; NUM_JOINTS]; requests.len()];
        self.play_history(requests, &mut commands, &mut tau);
        for robot in 0..requests.len() {
            self.robots.read(robot, &mut states);
        }
        for period in 0..requests.iter().map(|request| request.commands.len()).max().unwrap_or(0) {
            let active: Vec<bool> = requests.iter().map(|request| period < request.commands.len()).collect();
            for (robot, request) in requests.iter().enumerate().filter(|(robot, _)| active[*robot]) {
                commands[robot] = request.commands[period];
                if let Some(factors) = request.derating.get(period) {
                    self.robots.set_derating(robot, factors);
                }
            }
            self.actuator.torques(&commands, &active, &states.measured, &mut tau).expect("supported commands");
            let inputs = ActuatorInputs::of(self.actuator.mode(), &commands, &tau);
            let time = StepCount { actuator_periods: 1, steps: self.steps };
            self.robots.advance(None, inputs, &active, time, &mut states);
            for robot in (0..requests.len()).filter(|robot| active[*robot]) {
                records[robot].copy_robot(period + 1, &states, robot);
            }
        }
    }

    /// Gives the actuators the inputs of the periods before the initial states.
    fn play_history(&mut self, requests: &[&RolloutRequest], commands: &mut [Command], tau: &mut [PerJoint]) {
        let mut past = RobotStates::new(requests.len());
        for (robot, request) in requests.iter().enumerate() {
            self.actuator.reset(robot, request.start.actuator_seed);
        }
        for age in (0..requests.iter().map(|request| request.history.len()).max().unwrap_or(0)).rev() {
            let active: Vec<bool> = requests.iter().map(|request| age < request.history.len()).collect();
            for (robot, request) in requests.iter().enumerate().filter(|(robot, _)| active[*robot]) {
                let HistoryStep { command, q, dq } = request.history[request.history.len() - 1 - age];
                commands[robot] = command;
                (past.measured.q[robot], past.measured.dq[robot]) = (q, dq);
            }
            self.actuator.torques(commands, &active, &past.measured, tau).expect("supported commands");
        }
    }
}

impl Rollout for BatchRollout {
    fn run(&mut self, jobs: &[RolloutRequest], precision: Precision) -> Vec<RobotStates> {
        let (this, size) = (&*self, SimdPrecision::from(precision).lanes());
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

    fn actuator(&self, robot: &RobotModel) -> Option<Box<dyn Actuator>> {
        self.actuators.as_ref().map(|create| create(1, robot))
    }
}
