//! The task `walk` on any backend: robots that follow velocity commands.

use twinstep_effects::RobotSampler;
use twinstep_model::{
    AutoresetMode, Backend, BackendError, Command, EndedEpisode, EnvError, EnvSpec, InitialState, ResetRequest,
    RobotModel, Scene, StepBatch, VecEnv,
};

use crate::episode::{Episode, EpisodeConfig, StepOutcome};
use crate::observation::{OBS_LEN, walk_spec};
use crate::{ConfigError, Randomisation, TaskConfig};

/// Initial height of the lowest foot above the ground [m].
const START_CLEARANCE: f32 = 0.01;

/// Settings of a [`TaskEnv`].
#[derive(Clone, Debug)]
pub struct TaskEnvConfig {
    /// The task.
    pub task: TaskConfig,
    /// Domain randomisation.
    pub randomise: Randomisation,
    /// Samples the robot of each episode. Default: the robot of the backend.
    pub robot_sampler: Option<RobotSampler>,
    /// When a new episode starts after one has ended.
    pub autoreset: AutoresetMode,
    /// Number of policy steps after which an episode is truncated. Default: `max_episode_s` of the task.
    pub max_episode_steps: Option<u32>,
    /// Seed of environment 0 until a reset sets another. Environment `i` has the seed `seed + i`.
    pub seed: u64,
}

/// Vectorised environments of the task `walk` on a backend.
pub struct TaskEnv<B: Backend> {
    backend: B,
    spec: EnvSpec,
    config: EpisodeConfig,
    robots: Option<RobotSampler>,
    autoreset: AutoresetMode,
    episodes: Vec<Episode>,
    commands: Vec<Command>,
    active: Vec<bool>,
    batch: StepBatch,
}

impl<B: Backend> TaskEnv<B> {
    /// Creates one environment per robot of `backend`.
    pub fn new(backend: B, settings: TaskEnvConfig) -> Result<Self, ConfigError> {
        let TaskEnvConfig { task, randomise, robot_sampler: robots, autoreset, max_episode_steps, seed } = settings;
        task.check()?;
        randomise.check()?;
        let robot = backend.robot();
        let mut spec = walk_spec(robot, &task);
        spec.max_episode_steps = max_episode_steps.unwrap_or(spec.max_episode_steps);
        let num_envs = backend.num_robots();
        Ok(Self {
            config: EpisodeConfig::new(task, randomise, robot, backend.ground(), &spec),
            spec,
            robots,
            autoreset,
            episodes: (0..num_envs as u64).map(|env| Episode::not_started(seed.wrapping_add(env))).collect(),
            commands: vec![Command::hold(robot.control.default_pose_f32(), 0.0, 0.0); num_envs],
            active: vec![true; num_envs],
            batch: StepBatch::new(num_envs, OBS_LEN),
            backend,
        })
    }

    /// Returns the backend.
    pub fn backend(&self) -> &B {
        &self.backend
    }

    fn check_actions(&self, actions: &[f32]) -> Result<(), EnvError> {
        let action_len = self.spec.action_len();
        let expected = self.num_envs() * action_len;
        if actions.len() != expected {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), expected });
        }
        // One branch-free pass over all actions, which the compiler vectorises. The index is searched only on failure.
        if !actions.iter().fold(true, |finite, value| finite & value.is_finite()) {
            let index = actions.iter().position(|value| !value.is_finite()).unwrap_or_default();
            let entry = self.spec.action_entry(index % action_len);
            return Err(EnvError::ActionNotFinite { env: index / action_len, entry, value: actions[index] });
        }
        let restarts = self.autoreset == AutoresetMode::NextStep;
        let needs_reset = |episode: &Episode| !episode.running && (!restarts || !episode.was_started());
        self.episodes.iter().position(needs_reset).map_or(Ok(()), |env| Err(EnvError::NeedsReset { env }))
    }

    fn start_episodes(&mut self, envs: &[usize]) -> Result<(), BackendError> {
        for env in envs {
            let (initial_state, robot) = self.start(*env);
            match robot {
                Some(robot) => self.backend.reset_with_model(*env, &robot, &initial_state)?,
                None => self.backend.reset(&[(*env, initial_state)])?,
            }
            let row = &mut self.batch.obs[env * OBS_LEN..(env + 1) * OBS_LEN];
            self.episodes[*env].observe(&self.config, self.backend.states(), *env, row);
        }
        Ok(())
    }

    fn start(&mut self, env: usize) -> (InitialState, Option<RobotModel>) {
        let mut start = self.episodes[env].start(&self.config);
        self.commands[env] = Command::hold(start.q, start.kp, start.kd);
        let initial_state =
            InitialState::standing_on(self.config.ground(), self.backend.robot(), start.q, START_CLEARANCE);
        let robot = self.robots.as_ref().map(|robots| robots.sample(&mut start.effects));
        (InitialState { randomisation: start.variation, actuator_seed: start.actuator_seed, ..initial_state }, robot)
    }

    /// Sets the commands of all running environments, and resets those whose episode has ended (NextStep).
    fn prepare(&mut self, actions: &[f32]) -> Result<(), BackendError> {
        let dq = &self.backend.states().dq;
        let (actions, _) = actions.as_chunks();
        let mut waiting = Vec::new();
        for (env, (episode, action)) in self.episodes.iter_mut().zip(actions).enumerate() {
            self.active[env] = episode.running;
            if episode.running {
                // The gains are constant during an episode.
                self.commands[env].q = episode.joint_targets(&self.config, action, &dq[env]);
            } else {
                waiting.push(env);
            }
        }
        self.start_episodes(&waiting)
    }

    /// Writes reward, end flags and observation of every environment that was stepped.
    fn finish(&mut self) {
        let Self { episodes, active, batch, config, backend, .. } = self;
        let rows = batch.obs.chunks_exact_mut(OBS_LEN);
        for (env, (episode, obs)) in episodes.iter_mut().zip(rows).enumerate() {
            let not_stepped = StepOutcome { reward: 0.0, terminated: false, truncated: false };
            let outcome =
                if active[env] { episode.evaluate_step(config, backend.states(), env, obs) } else { not_stepped };
            batch.reward[env] = outcome.reward;
            batch.terminated[env] = outcome.terminated;
            batch.truncated[env] = outcome.truncated;
        }
        self.batch.ended.clear();
        for env in 0..self.episodes.len() {
            if self.batch.done(env) {
                self.report(env);
            }
        }
    }

    fn report(&mut self, env: usize) {
        let episode = &self.episodes[env];
        let final_obs = match self.autoreset {
            AutoresetMode::SameStep => self.batch.obs[env * OBS_LEN..(env + 1) * OBS_LEN].to_vec(),
            AutoresetMode::NextStep | AutoresetMode::Disabled => Vec::new(),
        };
        self.batch.ended.push(EndedEpisode {
            env,
            length: episode.length,
            episode_return: episode.episode_return,
            terms: episode.term_sums.to_vec(),
            final_obs,
        });
    }
}

impl<B: Backend> VecEnv for TaskEnv<B> {
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
                self.episodes[*env].seed(seeds[*env]);
            }
        }
        self.start_episodes(&envs)?;
        Ok(&self.batch.obs)
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.check_actions(actions)?;
        self.prepare(actions)?;
        let decimation = self.backend.robot().control.decimation;
        match self.backend.step(&self.commands, &self.active, decimation) {
            Ok(()) => {}
            Err(BackendError::Diverged { robot, quantity, .. }) => {
                self.episodes[robot].running = false;
                self.episodes[robot].length = 0;
                return Err(EnvError::Diverged { env: robot, quantity: quantity.to_owned() });
            }
            Err(error) => return Err(error.into()),
        }
        self.finish();
        if self.autoreset == AutoresetMode::SameStep {
            let ended: Vec<usize> = self.batch.ended.iter().map(|episode| episode.env).collect();
            self.start_episodes(&ended)?;
        }
        Ok(&self.batch)
    }

    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        let num_envs = self.num_envs();
        let episode = self.episodes.get(env).ok_or(EnvError::EnvOutOfRange { env, num_envs })?;
        if !episode.running && !episode.was_started() {
            return Err(EnvError::NeedsReset { env });
        }
        let backend = &self.backend;
        let scene = Scene::new(backend.robot(), backend.states(), env, self.config.ground());
        Ok(Scene { command: Some(episode.command), ..scene })
    }
}
