//! Environments of robots of any tree.

use glam::{DAffine3, DQuat, Vec3};
use twinstep_effects::{RobotSampler, TreeModelFile};
use twinstep_envs::{
    ControlledRobot, Course, Episode, NoisyEntry, Randomisation, StepOutcome, Task, add_noise, observe_next,
    repeat_first_frame,
};
use twinstep_model::{
    AgentCommands, AutoresetMode, BackendError, BaseMount, EndedEpisode, EnvError, EnvSpec, GaitCommand, Ground,
    ResetRequest, Scene, StepBatch, TreeModel, VecEnv, VelocityCommand, frames,
};
use twinstep_sim::{Placement, TreeCommand, TreeError, TreeReadings, TreeSimulation};

use crate::tree_readings::RobotRow;

/// Initial height of the lowest contact point of a free robot above the ground, as for quadrupeds [m].
const START_CLEARANCE: f64 = 0.01;

/// Robots of one tree, each with an episode of a task.
pub struct TreeEnv<T: Task> {
    task: T,
    spec: EnvSpec,
    control: ControlledRobot,
    robot: TreeModel,
    course: Option<Course>,
    ground: Ground,
    simulation: TreeSimulation,
    randomise: Randomisation,
    sampler: Option<RobotSampler<TreeModelFile>>,
    noise: Vec<NoisyEntry>,
    autoreset: AutoresetMode,
    episodes: Vec<Episode<T::State>>,
    rows: Vec<RobotRow>,
    commands: Vec<TreeCommand>,
    /// Commands of the agent.
    agent_commands: AgentCommands,
    /// Commands of the agent that were set since the last step.
    next_agent_commands: AgentCommands,
    batch: StepBatch,
}

/// Settings of a [`TreeEnv`].
pub struct TreeEnvConfig {
    /// The ground of the simulation.
    pub ground: Ground,
    /// Domain randomisation.
    pub randomise: Randomisation,
    /// Samples the robot of each episode. Default: that of the model file.
    pub sampler: Option<RobotSampler<TreeModelFile>>,
    /// When a new episode starts after one has ended.
    pub autoreset: AutoresetMode,
    /// Number of policy steps after which an episode is truncated. Default: that of the task.
    pub max_episode_steps: Option<u32>,
    /// Seed of environment 0 until a reset sets another. Environment `i` has the seed `seed + i`.
    pub seed: u64,
}

impl<T: Task> TreeEnv<T> {
    /// Creates an environment for each robot of a simulation.
    pub fn new(
        task: T,
        control: ControlledRobot,
        robot: TreeModel,
        simulation: TreeSimulation,
        settings: TreeEnvConfig,
    ) -> Self {
        let (num_envs, joints) = (simulation.num_robots(), robot.joints.len());
        let mut spec = task.spec().clone();
        spec.max_episode_steps = settings.max_episode_steps.unwrap_or(spec.max_episode_steps);
        let single = |part: usize| control.gains.iter().map(|gains| gains[part] as f32).collect::<Vec<_>>();
        let command = TreeCommand { kp: single(0), kd: single(1), ..TreeCommand::hold(vec![0.0; joints], 0.0, 0.0) };
        let not_started = |env: u64| Episode::not_started(&task, settings.seed.wrapping_add(env));
        Self {
            randomise: settings.randomise,
            sampler: settings.sampler,
            noise: settings.randomise.noise.entries(&spec),
            autoreset: settings.autoreset,
            episodes: (0..num_envs as u64).map(not_started).collect(),
            rows: vec![RobotRow::new(&robot, &control.feet); num_envs],
            commands: vec![command; num_envs],
            agent_commands: AgentCommands::default(),
            next_agent_commands: AgentCommands::default(),
            batch: StepBatch::new(num_envs, &spec),
            course: settings.ground.patches.map(|patches| Course::new(patches, spec.max_episode_steps, num_envs)),
            spec,
            task,
            control,
            robot,
            ground: settings.ground,
            simulation,
        }
    }

    fn check_actions(&self, actions: &[f32]) -> Result<(), EnvError> {
        self.spec.check_actions(actions, self.num_envs())?;
        let restarts = self.autoreset != AutoresetMode::Disabled;
        let needs_reset = |episode: &Episode<T::State>| !episode.running && (!restarts || !episode.was_started());
        self.episodes.iter().position(needs_reset).map_or(Ok(()), |env| Err(EnvError::NeedsReset { env }))
    }

    /// Starts an episode of a robot at rest, and observes it.
    fn start(&mut self, env: usize) -> Result<(), EnvError> {
        let Self { task, episodes, randomise, sampler, robot, simulation, ground, .. } = self;
        let mut start = episodes[env].start(task, randomise, |effects, random| {
            let sampled = sampler.as_ref().map(|sampler| sampler.sample(effects));
            randomise.sample_tree(sampled.as_ref().unwrap_or(robot), random).or(sampled)
        });
        let q = start.q.into_iter().map(f64::from).collect();
        let model = start.robot.as_ref().unwrap_or(robot);
        let [x, y, _] = self.rows[env].base_position;
        let walked_to = (!start.is_first).then_some([x, y]);
        let course = self.course.as_mut();
        let place = course.map_or([0.0; 3], |course| course.start(env, walked_to, &mut start.place));
        let mut placement = Placement::standing_at(ground, robot, q, place.map(f64::from));
        placement.base_position[2] += if self.control.standing_height.is_some() { START_CLEARANCE } else { 0.0 };
        simulation.reset(env, model, &placement).map_err(failed)?;
        episodes[env].set_commands(task, &self.agent_commands, env);
        self.rows[env].read(&self.simulation.states()[env]);
        self.task.place(&mut self.episodes[env].state, &self.rows[env].view(&self.ground));
        self.observe(env);
        repeat_first_frame(&self.task, row(&mut self.batch.obs, env, self.spec.obs_len()));
        Ok(())
    }

    /// Reads a robot and writes its observations.
    fn observe(&mut self, env: usize) {
        let Self { rows, simulation, episodes, task, batch, spec, noise, ground, .. } = self;
        rows[env].read(&simulation.states()[env]);
        let (episode, robot) = (&mut episodes[env], rows[env].view(ground));
        let obs = row(&mut batch.obs, env, spec.obs_len());
        observe_next(task, &episode.state, &robot, &episode.action, obs);
        add_noise(noise, obs, &mut episode.noise);
        if !spec.critic_observation.is_empty() {
            task.observe_critic(&episode.state, &robot, row(&mut batch.critic_obs, env, spec.critic_obs_len()));
        }
    }

    /// Sets the targets of the actuators, and pushes the robots whose next push is due.
    fn command(&mut self, actions: &[f32]) -> Result<(), EnvError> {
        let (pose, scale) = (&self.control.default_pose, self.control.action_scale);
        for (env, action) in actions.chunks_exact(pose.len()).enumerate() {
            let episode = &mut self.episodes[env];
            episode.act(action, &self.rows[env].dq);
            for (joint, target) in self.commands[env].q.iter_mut().enumerate() {
                *target = (pose[joint] + scale * f64::from(episode.action[joint])) as f32;
            }
            if self.randomise.has_pushes()
                && episode.running
                && let Some(velocity) = episode.next_push(&self.randomise, self.spec.policy_dt)
            {
                self.simulation.push(env, velocity).map_err(failed)?;
            }
        }
        Ok(())
    }

    /// Writes reward, end flags and observation of a robot whose episode runs.
    fn finish(&mut self, env: usize) {
        let Self { rows, simulation, episodes, task, spec, ground, course, .. } = self;
        let (readings, episode) = (&simulation.states()[env], &mut episodes[env]);
        if let (Some(course), Some([x, y, _])) = (course, task.velocity_command(&episode.state)) {
            course.command(env, x.hypot(y) * spec.policy_dt as f32);
        }
        // A diverged robot keeps its last observation.
        let mut outcome = StepOutcome { truncated: true, ..StepOutcome::default() };
        let is_finite = is_finite(readings);
        if is_finite {
            rows[env].read(readings);
            outcome = episode.evaluate_step(task, rows[env].view(ground), spec.max_episode_steps);
            self.observe(env);
        } else {
            episode.diverge();
        }
        self.write(env, outcome);
    }

    fn write(&mut self, env: usize, StepOutcome { reward, terminated, truncated }: StepOutcome) {
        self.batch.reward[env] = reward;
        (self.batch.terminated[env], self.batch.truncated[env]) = (terminated, truncated);
    }

    fn report(&mut self, env: usize) {
        let Self { batch, episodes, spec, autoreset, .. } = self;
        let episode = &episodes[env];
        let (final_obs, final_critic_obs) = match autoreset {
            AutoresetMode::SameStep => (
                row(&mut batch.obs, env, spec.obs_len()).to_vec(),
                row(&mut batch.critic_obs, env, spec.critic_obs_len()).to_vec(),
            ),
            AutoresetMode::NextStep | AutoresetMode::Disabled => (Vec::new(), Vec::new()),
        };
        batch.ended.push(EndedEpisode {
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

impl<T: Task> VecEnv for TreeEnv<T> {
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
        for env in (0..self.num_envs()).filter(|env| request.selects(*env)) {
            if let Some(seeds) = &request.seeds {
                self.episodes[env].seed(&self.task, seeds[env]);
            }
            self.start(env)?;
        }
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

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        let commands = std::mem::take(&mut self.next_agent_commands);
        self.check_actions(actions)?;
        for (env, episode) in self.episodes.iter_mut().enumerate() {
            episode.set_commands(&self.task, &commands, env);
        }
        self.agent_commands.update(commands);
        self.command(actions)?;
        self.simulation.step(&self.commands, self.control.decimation).map_err(failed)?;
        self.batch.ended.clear();
        for env in 0..self.num_envs() {
            if !self.episodes[env].running {
                // The step after the last one of an episode resets the robot; its action has no effect.
                self.start(env)?;
                self.write(env, StepOutcome::default());
                continue;
            }
            self.finish(env);
            if self.batch.done(env) {
                self.report(env);
                if self.autoreset == AutoresetMode::SameStep {
                    self.start(env)?;
                }
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
        let TreeReadings { state, tau, shape_force } = &self.simulation.states()[env];
        let [w, x, y, z] = state.base_orientation;
        let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
        let base = DAffine3::from_rotation_translation(rotation, state.base_position.into());
        let numbers = |values: &[f64]| Some(values.iter().map(|value| *value as f32).collect());
        let row = &self.rows[env];
        let moves = !self.robot.tree.base.is_some_and(BaseMount::is_fixed) && self.control.standing_height.is_some();
        let velocity = moves.then(|| {
            let base_from_world = frames::world_from_base(row.orientation).inverse();
            let linear = base_from_world * Vec3::from(row.base_linear_velocity);
            [linear.x, linear.y, row.gyro[2]]
        });
        Ok(Scene {
            command: self.task.velocity_command(&episode.state),
            velocity,
            torque: numbers(tau),
            contact_force: numbers(shape_force),
            reward_terms: episode.terms.clone(),
            ..Scene::of_tree(
                &self.robot.tree,
                base,
                &state.q,
                &self.ground.crop(row.base_position[0], row.base_position[1]),
            )
        })
    }

    fn push(&mut self, env: usize, velocity: [f32; 3]) -> Result<(), EnvError> {
        let num_envs = self.num_envs();
        if env >= num_envs {
            return Err(EnvError::EnvOutOfRange { env, num_envs });
        }
        self.simulation.push(env, velocity).map_err(|error| match error {
            TreeError::FixedBase { .. } => BackendError::CannotPush { robot: env, reason: "its base is fixed" }.into(),
            error => failed(error),
        })
    }
}

/// Returns entries of environment `env` in an array with `len` entries per environment.
fn row(array: &mut [f32], env: usize, len: usize) -> &mut [f32] {
    &mut array[env * len..(env + 1) * len]
}

fn is_finite(readings: &TreeReadings) -> bool {
    let state = &readings.state;
    let base = state.base_position.iter().chain(&state.base_orientation).chain(&state.base_angular_velocity);
    base.chain(&state.q).chain(&state.dq).chain(&readings.tau).all(|value| value.is_finite())
}

fn failed(error: TreeError) -> EnvError {
    EnvError::Remote(Box::new(error))
}
