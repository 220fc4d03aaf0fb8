//! A task on all robots of a backend.

use glam::Vec3;
use twinstep_effects::RobotSampler;
use twinstep_model::{
    AgentCommands, AutoresetMode, Backend, BackendError, Command, ControlConfig, EndedEpisode, EnvError, EnvSpec,
    GaitCommand, Ground, InitialState, PerJoint, Pose, RealTimeReport, ResetCause, ResetRequest, RobotSample, Scene,
    StepBatch, Stream, VecEnv, VelocityCommand, frames, stream,
};

use crate::course::Course;
use crate::episode::{Episode, StepOutcome};
use crate::observation_noise::{NoisyEntry, add_noise};
use crate::task::{RobotView, Task, observe_next, repeat_first_frame};
use crate::{ConfigError, Randomisation};

/// Initial height of the lowest foot above the ground [m].
const START_CLEARANCE: f32 = 0.01;

/// Settings of a [`TaskEnv`].
#[derive(Clone, Debug)]
pub struct TaskEnvConfig {
    /// Domain randomisation.
    pub randomise: Randomisation,
    /// Samples the robot of each episode. Default: the robot of the backend.
    pub robot_sampler: Option<RobotSampler>,
    /// When a new episode starts after one has ended.
    pub autoreset: AutoresetMode,
    /// Number of policy steps after which an episode is truncated. Default: that of the task.
    pub max_episode_steps: Option<u32>,
    /// Seed of environment 0 until a reset sets another. Environment `i` has the seed `seed + i`.
    pub seed: u64,
}

impl TaskEnvConfig {
    /// Returns the settings of environments of the backend's robot without disturbances, with the episodes of the task.
    pub fn new(autoreset: AutoresetMode, seed: u64) -> Self {
        Self { randomise: Randomisation::default(), robot_sampler: None, autoreset, max_episode_steps: None, seed }
    }
}

/// Vectorised environments of a task on a backend.
pub struct TaskEnv<B: Backend, T: Task> {
    backend: B,
    task: T,
    spec: EnvSpec,
    randomise: Randomisation,
    noise: Vec<NoisyEntry>,
    robots: Option<RobotSampler>,
    ground: Ground,
    course: Option<Course>,
    autoreset: AutoresetMode,
    episodes: Vec<Episode<T::State>>,
    commands: Vec<Command>,
    active: Vec<bool>,
    /// Commands of the agent.
    agent_commands: AgentCommands,
    /// Commands of the agent that were set since the last step.
    next_agent_commands: AgentCommands,
    batch: StepBatch,
    /// Samples of each environment in the last step; `None` until somebody asks for them.
    samples: Option<Vec<Vec<RobotSample>>>,
    /// Random numbers of the noise of samples. Those of the episodes do not depend on sampling.
    sample_noise: Stream,
}

impl<B: Backend, T: Task> TaskEnv<B, T> {
    /// Creates one environment per robot of `backend`.
    pub fn new(backend: B, task: T, settings: TaskEnvConfig) -> Result<Self, ConfigError> {
        let TaskEnvConfig { randomise, robot_sampler: robots, autoreset, max_episode_steps, seed } = settings;
        let robot = backend.robot();
        randomise.check()?;
        randomise.check_base(robot.trunk.mass)?;
        let mut spec = task.spec().clone();
        spec.max_episode_steps = max_episode_steps.unwrap_or(spec.max_episode_steps);
        let (num_envs, control) = (backend.num_robots(), &robot.control);
        let command = control.hold(control.default_pose_f32());
        let not_started = |env: u64| Episode::not_started(&task, seed.wrapping_add(env));
        Ok(Self {
            noise: randomise.noise.entries(&spec),
            randomise,
            robots,
            course: backend.ground().patches.map(|patches| Course::new(patches, spec.max_episode_steps, num_envs)),
            ground: backend.ground(),
            autoreset,
            episodes: (0..num_envs as u64).map(not_started).collect(),
            commands: vec![command; num_envs],
            active: vec![true; num_envs],
            agent_commands: AgentCommands::default(),
            next_agent_commands: AgentCommands::default(),
            batch: StepBatch::new(num_envs, &spec),
            samples: None,
            sample_noise: stream(seed, "noise of samples", 0),
            spec,
            task,
            backend,
        })
    }

    /// Returns the backend.
    pub fn backend(&self) -> &B {
        &self.backend
    }

    fn check_actions(&self, actions: &[f32]) -> Result<(), EnvError> {
        self.spec.check_actions(actions, self.num_envs())?;
        let restarts = self.autoreset != AutoresetMode::Disabled;
        let needs_reset = |episode: &Episode<T::State>| !episode.running && (!restarts || !episode.was_started());
        self.episodes.iter().position(needs_reset).map_or(Ok(()), |env| Err(EnvError::NeedsReset { env }))
    }

    fn start_episodes(&mut self, envs: &[usize], cause: ResetCause) -> Result<(), BackendError> {
        if !envs.is_empty() {
            self.backend.prepare_reset(cause)?;
        }
        for env in envs {
            let Self { task, backend, randomise, robots, course, .. } = self;
            let nominal = backend.robot();
            let mut start = self.episodes[*env].start(task, randomise, |effects, random| {
                let sampled = robots.as_ref().map(|sampler| sampler.sample(effects));
                randomise.sample(sampled.as_ref().unwrap_or(nominal), random).or(sampled)
            });
            let q = per_joint(&start.q);
            let walked_to = backend.ground_truth().filter(|_| !start.is_first).map(|truth| truth.base_position[*env]);
            let place = course
                .as_mut()
                .map_or([0.0; 3], |course| course.start(*env, walked_to.map(|[x, y, _]| [x, y]), &mut start.place));
            self.episodes[*env].set_commands(task, &self.agent_commands, *env);
            self.commands[*env].q = q;
            let turned = task.start_rotation(&self.episodes[*env].state);
            let initial_state = InitialState {
                actuator_seed: start.actuator_seed,
                ..InitialState::turned_at(&self.ground, backend.robot(), q, START_CLEARANCE, place, turned)
            };
            match start.robot {
                Some(robot) => backend.reset_with_model(*env, &robot, &initial_state)?,
                None => backend.reset(&[(*env, initial_state)])?,
            }
            let robot = view(&self.backend, &self.ground, *env);
            self.task.place(&mut self.episodes[*env].state, &robot);
            self.follow_robot(*env);
            self.observe(*env);
            repeat_first_frame(&self.task, row(&mut self.batch.obs, *env, self.spec.obs_len()));
        }
        Ok(())
    }

    /// Removes the samples before a reset.
    fn clear_samples(&mut self, envs: &[usize]) {
        if let Some(samples) = &mut self.samples {
            for env in envs {
                samples[*env].clear();
            }
            let _ = self.backend.take_samples();
        }
    }

    /// Advances the active robots by a policy period, and samples them if somebody has asked for it.
    fn advance(&mut self) -> Result<(), BackendError> {
        let Self { backend, commands, active, samples, randomise, sample_noise, .. } = self;
        let decimation = backend.robot().control.decimation;
        let Some(samples) = samples else { return backend.step(commands, active, decimation) };
        samples.iter_mut().for_each(Vec::clear);
        if backend.real_time().is_some() {
            backend.step(commands, active, decimation)?;
            samples[0] = backend.take_samples().unwrap_or_default();
            return Ok(());
        }
        let (mut active, mut diverged) = (active.clone(), Vec::new());
        for _ in 0..decimation {
            let sampled: Vec<usize> = (0..active.len()).filter(|env| active[*env]).collect();
            for env in &sampled {
                let (measured, truth) = (backend.measured(), backend.ground_truth());
                samples[*env].push(RobotSample::before(measured, truth, *env, &commands[*env]));
            }
            match backend.step(commands, &active, 1) {
                Err(BackendError::Diverged { robots }) => {
                    for (env, _) in &robots {
                        active[*env] = false;
                    }
                    diverged.extend(robots);
                }
                stepped => stepped?,
            }
            for env in sampled {
                if let Some(sample) = samples[env].last_mut() {
                    sample.tau = backend.measured().tau[env];
                    randomise.noise.disturb(sample, sample_noise);
                }
            }
        }
        if diverged.is_empty() { Ok(()) } else { Err(BackendError::Diverged { robots: diverged }) }
    }

    /// Takes the velocity command of the operator, unless the agent has its own, and the action that a robot in real
    /// time has executed.
    fn follow_robot(&mut self, env: usize) {
        let Self { backend, task, episodes, .. } = self;
        let episode = &mut episodes[env];
        if let Some(command) = backend.velocity_command().filter(|_| self.agent_commands.velocity.is_none()) {
            task.set_velocity_command(&mut episode.state, command);
        }
        if let Some(report) = backend.real_time() {
            episode.action.copy_from_slice(&report.applied);
        }
    }

    /// Writes the observations of environment `env`.
    fn observe(&mut self, env: usize) {
        let Self { backend, task, ground, episodes, batch, spec, noise, .. } = self;
        let episode = &mut episodes[env];
        let robot = view(backend, ground, env);
        let obs = row(&mut batch.obs, env, spec.obs_len());
        observe_next(task, &episode.state, &robot, &episode.action, obs);
        add_noise(noise, obs, &mut episode.noise);
        if !spec.critic_observation.is_empty() {
            task.observe_critic(&episode.state, &robot, row(&mut batch.critic_obs, env, spec.critic_obs_len()));
        }
    }

    /// Puts new commands of the agent into force.
    fn apply_commands(&mut self, commands: AgentCommands) {
        for (env, episode) in self.episodes.iter_mut().enumerate() {
            episode.set_commands(&self.task, &commands, env);
        }
        self.agent_commands.update(commands);
    }

    /// Sets the commands of all running environments, and resets those whose episode has ended (NextStep).
    fn prepare(&mut self, actions: &[f32]) -> Result<(), BackendError> {
        let (dq, control) = (&self.backend.measured().dq, &self.backend.robot().control);
        let (actions, _) = actions.as_chunks();
        let mut waiting = Vec::new();
        for (env, (episode, action)) in self.episodes.iter_mut().zip(actions).enumerate() {
            self.active[env] = episode.running;
            if episode.running {
                let action: &PerJoint = action;
                episode.act(action, &dq[env]);
                self.commands[env].q = joint_targets(control, &episode.action);
            } else {
                waiting.push(env);
            }
        }
        self.start_episodes(&waiting, ResetCause::Autoreset)
    }

    /// Pushes the robots whose next push is due.
    fn push(&mut self) -> Result<(), BackendError> {
        if !self.randomise.has_pushes() {
            return Ok(());
        }
        let policy_dt = self.spec.policy_dt;
        for (env, episode) in self.episodes.iter_mut().enumerate().filter(|(env, _)| self.active[*env]) {
            if let Some(velocity) = episode.next_push(&self.randomise, policy_dt) {
                self.backend.push(env, velocity)?;
            }
        }
        Ok(())
    }

    /// Writes reward, end flags and observation of every environment that was stepped.
    fn finish(&mut self) {
        for env in 0..self.episodes.len() {
            // A diverged robot keeps its last observation.
            let mut outcome = StepOutcome { truncated: self.episodes[env].diverged, ..StepOutcome::default() };
            if self.active[env] {
                self.follow_robot(env);
                let Self { backend, task, spec, ground, episodes, course, .. } = self;
                if let (Some(course), Some([x, y, _])) = (course, task.velocity_command(&episodes[env].state)) {
                    course.command(env, x.hypot(y) * spec.policy_dt as f32);
                }
                let robot = view(backend, ground, env);
                outcome = episodes[env].evaluate_step(task, robot, spec.max_episode_steps);
                if let Some(stop) = backend.real_time().and_then(|report| report.stop.as_ref()) {
                    outcome = episodes[env].stop(outcome, stop.terminates);
                }
                self.observe(env);
            }
            self.batch.reward[env] = outcome.reward;
            self.batch.terminated[env] = outcome.terminated;
            self.batch.truncated[env] = outcome.truncated;
        }
        self.batch.real_time = self.backend.real_time().cloned();
        self.batch.ended.clear();
        for env in 0..self.episodes.len() {
            if self.batch.done(env) {
                self.report(env);
            }
        }
    }

    fn report(&mut self, env: usize) {
        let Self { spec, batch, .. } = self;
        let episode = &self.episodes[env];
        let (final_obs, final_critic_obs) = match self.autoreset {
            AutoresetMode::SameStep => (
                row(&mut batch.obs, env, spec.obs_len()).to_vec(),
                row(&mut batch.critic_obs, env, spec.critic_obs_len()).to_vec(),
            ),
            AutoresetMode::NextStep | AutoresetMode::Disabled => (Vec::new(), Vec::new()),
        };
        self.batch.ended.push(EndedEpisode {
            env,
            length: episode.length,
            episode_return: episode.episode_return,
            terms: episode.term_sums.clone(),
            diverged: episode.diverged,
            final_obs,
            final_critic_obs,
        });
    }
}

/// Returns values of a quadruped's joints as an array.
fn per_joint(values: &[f32]) -> PerJoint {
    std::array::from_fn(|joint| values[joint])
}

/// Returns the commanded joint positions of an action [rad].
fn joint_targets(control: &ControlConfig, action: &[f32]) -> PerJoint {
    let scale = control.action_scale as f32;
    std::array::from_fn(|joint| control.default_pose[joint] as f32 + scale * action[joint])
}

/// Returns entries of environment `env` in an array with `len` entries per environment.
fn row(array: &mut [f32], env: usize, len: usize) -> &mut [f32] {
    &mut array[env * len..(env + 1) * len]
}

fn view<'a>(backend: &'a impl Backend, ground: &'a Ground, index: usize) -> RobotView<'a> {
    RobotView::of(backend.measured(), backend.ground_truth(), ground, index)
}

impl<B: Backend, T: Task> VecEnv for TaskEnv<B, T> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.episodes.len()
    }

    fn autoreset(&self) -> AutoresetMode {
        self.autoreset
    }

    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        request.check(self.num_envs())?;
        let envs: Vec<usize> = (0..self.num_envs()).filter(|env| request.selects(*env)).collect();
        if let Some(seeds) = &request.seeds {
            for env in &envs {
                self.episodes[*env].seed(&self.task, seeds[*env]);
            }
        }
        self.clear_samples(&envs);
        self.start_episodes(&envs, ResetCause::Request)?;
        Ok(&self.batch.obs)
    }

    fn obs(&self) -> &[f32] {
        &self.batch.obs
    }

    fn critic_obs(&self) -> &[f32] {
        &self.batch.critic_obs
    }

    fn mean_level(&self) -> Option<f64> {
        self.course.as_ref().map(Course::mean_level)
    }

    fn set_velocity_commands(&mut self, commands: &[VelocityCommand]) -> Result<(), EnvError> {
        self.spec.check_velocity_commands(commands, self.num_envs())?;
        self.next_agent_commands.velocity = Some(commands.to_vec());
        Ok(())
    }

    fn set_gait_commands(&mut self, commands: &[GaitCommand]) -> Result<(), EnvError> {
        self.spec.check_gait_commands(commands, self.num_envs())?;
        self.next_agent_commands.gait = Some(commands.to_vec());
        Ok(())
    }

    fn set_action_tick(&mut self, tick: u64) {
        self.backend.set_action_tick(tick);
    }

    fn real_time(&self) -> Option<&RealTimeReport> {
        self.backend.real_time()
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        let commands = std::mem::take(&mut self.next_agent_commands);
        self.check_actions(actions)?;
        self.apply_commands(commands);
        self.prepare(actions)?;
        self.push()?;
        let diverged = match self.advance() {
            Ok(()) => Vec::new(),
            // The other robots were stepped.
            Err(BackendError::Diverged { robots }) => robots,
            Err(error) => return Err(error.into()),
        };
        for (env, _) in &diverged {
            self.active[*env] = false;
            self.episodes[*env].diverge();
        }
        self.finish();
        if self.autoreset == AutoresetMode::SameStep {
            let ended: Vec<usize> = self.batch.ended.iter().map(|episode| episode.env).collect();
            match self.start_episodes(&ended, ResetCause::Autoreset) {
                // The episode has ended all the same; the next step starts another one, as with `NextStep`.
                Err(BackendError::Waiting { .. }) => {}
                started => started?,
            }
        }
        Ok(&self.batch)
    }

    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        let num_envs = self.num_envs();
        let episode = self.episodes.get(env).ok_or(EnvError::EnvOutOfRange { env, num_envs })?;
        if !episode.running && !episode.was_started() {
            return Err(EnvError::NeedsReset { env });
        }
        let robot = view(&self.backend, &self.ground, env);
        let q = per_joint(robot.q);
        // Where the position is not measured, the robot stands at the origin.
        let position = robot.truth.map_or_else(
            || InitialState::standing_on(robot.ground, self.backend.robot(), q, 0.0).base_position,
            |truth| truth.base_position,
        );
        let rotation = frames::world_from_base(robot.orientation);
        let world_from_base = Pose { position: Vec3::from(position), rotation };
        let scene = Scene::new(self.backend.robot(), world_from_base, &q, robot.ground);
        let velocity = robot.truth.map(|truth| {
            let linear = rotation.inverse() * Vec3::from(truth.base_linear_velocity);
            [linear.x, linear.y, robot.gyro[2]]
        });
        Ok(Scene {
            command: self.task.velocity_command(&episode.state),
            velocity,
            torque: Some(robot.tau.to_vec()),
            contact_force: robot.truth.map(|truth| truth.foot_force.to_vec()),
            reward_terms: episode.terms.clone(),
            // Zero is that of actuators that do not estimate it.
            uncertainty: robot.truth.map(|truth| truth.epistemic_uncertainty).filter(|value| *value != 0.0),
            ..scene
        })
    }

    fn samples(&mut self, env: usize) -> Result<Vec<RobotSample>, EnvError> {
        let num_envs = self.num_envs();
        let samples = self.samples.get_or_insert_with(|| vec![Vec::new(); num_envs]);
        samples.get(env).cloned().ok_or(EnvError::EnvOutOfRange { env, num_envs })
    }

    fn push(&mut self, env: usize, velocity: [f32; 3]) -> Result<(), EnvError> {
        let num_envs = self.num_envs();
        if env >= num_envs {
            return Err(EnvError::EnvOutOfRange { env, num_envs });
        }
        self.backend.push(env, velocity).map_err(EnvError::from)
    }
}
