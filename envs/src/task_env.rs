//! The task `walk` on any backend: many robots that follow velocity commands.

use glam::Vec3;
use rand::RngExt;
use twinstep_model::{
    AutoresetMode, Backend, BackendError, Command, EndedEpisode, EnvError, EnvSpec, Ground, PerJoint, PerLeg,
    Placement, ResetRequest, Scene, StepBatch, Stream, Variation, VecEnv, frames, stream,
};

use crate::config::Range;
use crate::observation::{OBS_LEN, observe, walk_spec};
use crate::reward::Moment;
use crate::{ConfigError, Randomisation, RewardWeights, TaskConfig};

/// A foot counts as on the ground above this force [N].
const FOOT_CONTACT: f32 = 1.0;
/// Height from which the lowest foot falls when an episode starts [m].
const START_CLEARANCE: f32 = 0.01;
/// Share of a joint's range that counts as safe.
const SOFT_RANGE: f32 = 0.9;

/// Settings of a [`TaskEnv`] besides its backend.
#[derive(Clone, Debug)]
pub struct TaskSettings {
    /// The task.
    pub task: TaskConfig,
    /// What varies from episode to episode.
    pub randomise: Randomisation,
    /// When an ended episode starts anew.
    pub autoreset: AutoresetMode,
    /// Policy steps after which an episode is truncated, in place of the task's own time.
    pub max_episode_steps: Option<u32>,
    /// Seed of environment 0 until a reset gives another; environment `i` has `seed + i`.
    pub seed: u64,
}

/// Many walking robots on a backend.
pub struct TaskEnv<B: Backend> {
    backend: B,
    /// The backend's; it does not change.
    ground: Ground,
    spec: EnvSpec,
    task: TaskConfig,
    randomise: Randomisation,
    autoreset: AutoresetMode,
    default_pose: PerJoint,
    soft_lower: PerJoint,
    soft_upper: PerJoint,
    episodes: Vec<Episode>,
    commands: Vec<Command>,
    active: Vec<bool>,
    batch: StepBatch,
    terms: Vec<f32>,
}

/// What an environment remembers of its running episode.
struct Episode {
    stream: Stream,
    /// False before the first reset, and after the end of an episode that nobody has reset.
    running: bool,
    length: u32,
    episode_return: f32,
    term_sums: Vec<f32>,
    command: [f32; 3],
    action: PerJoint,
    previous_dq: PerJoint,
    air_time: PerLeg,
    kp: f32,
    kd: f32,
}

impl<B: Backend> TaskEnv<B> {
    /// The task on every robot of `backend`.
    pub fn new(backend: B, settings: TaskSettings) -> Result<Self, ConfigError> {
        let TaskSettings { task, randomise, autoreset, max_episode_steps, seed } = settings;
        task.check()?;
        randomise.check()?;
        let robot = backend.robot();
        let mut spec = walk_spec(robot, &task);
        spec.max_episode_steps = max_episode_steps.unwrap_or(spec.max_episode_steps);
        let (lower, upper) = (robot.lower_limits(), robot.upper_limits());
        let margin = |j: usize| (1.0 - SOFT_RANGE) / 2.0 * (upper[j] - lower[j]);
        let default_pose = robot.control.default_pose_f32();
        let num_envs = backend.num_robots();
        let terms = RewardWeights::NAMES.len();
        Ok(Self {
            spec,
            default_pose,
            soft_lower: std::array::from_fn(|j| lower[j] + margin(j)),
            soft_upper: std::array::from_fn(|j| upper[j] - margin(j)),
            episodes: (0..num_envs as u64).map(|env| Episode::idle(seed.wrapping_add(env), terms)).collect(),
            commands: vec![Command::hold(default_pose, 0.0, 0.0); num_envs],
            active: vec![true; num_envs],
            batch: StepBatch::new(num_envs, OBS_LEN),
            terms: vec![0.0; terms],
            ground: backend.ground(),
            backend,
            task,
            randomise,
            autoreset,
        })
    }

    /// The robots.
    pub fn backend(&self) -> &B {
        &self.backend
    }

    fn check_actions(&self, actions: &[f32]) -> Result<(), EnvError> {
        let action_len = self.spec.action_len();
        let wanted = self.num_envs() * action_len;
        if actions.len() != wanted {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), wanted });
        }
        if let Some(index) = actions.iter().position(|value| !value.is_finite()) {
            let entry = self.spec.action_entry(index % action_len);
            return Err(EnvError::ActionNotFinite { env: index / action_len, entry, value: actions[index] });
        }
        let restarts = self.autoreset == AutoresetMode::NextStep;
        let stuck = |episode: &Episode| !episode.running && (!restarts || !episode.was_started());
        self.episodes.iter().position(stuck).map_or(Ok(()), |env| Err(EnvError::NeedsReset { env }))
    }

    fn start_episodes(&mut self, envs: &[usize]) -> Result<(), BackendError> {
        let placements: Vec<(usize, Placement)> = envs.iter().map(|env| (*env, self.draw_start(*env))).collect();
        self.backend.reset(&placements)?;
        for env in envs {
            self.observe(*env);
        }
        Ok(())
    }

    /// Draws an episode's body, gains, command and pose, and forgets the episode before.
    fn draw_start(&mut self, env: usize) -> Placement {
        let control = self.backend.robot().control;
        let (randomise, noise) = (self.randomise, self.task.start_position_noise_rad);
        let episode = &mut self.episodes[env];
        let variation = Variation {
            mass_scale: draw(&mut episode.stream, randomise.mass_scale),
            payload: draw(&mut episode.stream, randomise.payload_kg),
            com_shift: std::array::from_fn(|_| draw(&mut episode.stream, randomise.com_shift_m)),
            friction_scale: draw(&mut episode.stream, randomise.friction_scale),
        };
        episode.kp = control.kp as f32 * draw(&mut episode.stream, randomise.kp_scale);
        episode.kd = control.kd as f32 * draw(&mut episode.stream, randomise.kd_scale);
        let q = self.default_pose.map(|position| position + draw(&mut episode.stream, [-noise, noise]));
        episode.start();
        self.draw_command(env);
        Placement { variation, ..Placement::above(&self.ground, self.backend.robot(), q, START_CLEARANCE) }
    }

    fn draw_command(&mut self, env: usize) {
        let ranges = self.task.command;
        let episode = &mut self.episodes[env];
        episode.command = [ranges.forward, ranges.left, ranges.yaw].map(|range| draw(&mut episode.stream, range));
    }

    fn observe(&mut self, env: usize) {
        let episode = &self.episodes[env];
        let row = &mut self.batch.obs[env * OBS_LEN..(env + 1) * OBS_LEN];
        observe(self.backend.states(), env, episode.command, &self.default_pose, &episode.action, row);
    }

    /// Sets the commands of all running environments, and restarts those that wait for it (NextStep).
    fn prepare(&mut self, actions: &[f32]) -> Result<(), BackendError> {
        let mut waiting = Vec::new();
        for (env, action) in actions.as_chunks::<12>().0.iter().enumerate() {
            let episode = &mut self.episodes[env];
            self.active[env] = episode.running;
            if !episode.running {
                waiting.push(env);
                continue;
            }
            let scale = self.spec.action_scale as f32;
            let clipped = action.map(|value| value.clamp(-1.0, 1.0));
            let target = std::array::from_fn(|j| self.default_pose[j] + scale * clipped[j]);
            self.commands[env] = Command::hold(target, episode.kp, episode.kd);
            episode.previous_dq = self.backend.states().dq[env];
        }
        self.start_episodes(&waiting)
    }

    /// Reward, ends and observation of one environment that was stepped.
    fn finish(&mut self, env: usize, action: &[f32]) {
        let clipped: PerJoint = std::array::from_fn(|j| action[j].clamp(-1.0, 1.0));
        let landed_air_time = self.update_air_time(env);
        let states = self.backend.states();
        let base_from_world = frames::world_from_base(states.base_orientation[env]).inverse();
        let gravity = base_from_world * Vec3::NEG_Z;
        let episode = &mut self.episodes[env];
        let moment = Moment {
            policy_dt: self.spec.policy_dt as f32,
            tracking_width: self.task.tracking_width,
            command: episode.command,
            linear_velocity: (base_from_world * Vec3::from(states.base_linear_velocity[env])).to_array(),
            angular_velocity: states.base_angular_velocity[env],
            gravity: gravity.to_array(),
            q: &states.q[env],
            dq: &states.dq[env],
            previous_dq: &episode.previous_dq,
            tau: &states.tau[env],
            action: &clipped,
            previous_action: &episode.action,
            default_pose: &self.default_pose,
            soft_lower: &self.soft_lower,
            soft_upper: &self.soft_upper,
            landed_air_time,
            body_contact: states.body_contact[env],
        };
        self.task.reward.evaluate(&moment, &mut self.terms);
        let reward = self.terms.iter().sum();
        episode.add(clipped, reward, &self.terms);
        let [x, y, z] = states.base_position[env];
        let base_height = z - self.ground.height(x, y);
        let fallen = -gravity.z < self.task.max_tilt_rad.cos() || base_height < self.task.min_base_height_m;
        let timed_out = episode.length >= self.spec.max_episode_steps;
        let resample_steps = (self.task.command_resample_s / self.spec.policy_dt as f32).round().max(1.0) as u32;
        if episode.length.is_multiple_of(resample_steps) {
            self.draw_command(env);
        }
        self.batch.reward[env] = reward;
        self.batch.terminated[env] = fallen;
        self.batch.truncated[env] = timed_out && !fallen;
        self.observe(env);
        if fallen || timed_out {
            self.end_episode(env);
        }
    }

    fn update_air_time(&mut self, env: usize) -> PerLeg {
        let forces = self.backend.states().foot_force[env];
        let air_time = &mut self.episodes[env].air_time;
        std::array::from_fn(|leg| {
            let in_air = forces[leg] < FOOT_CONTACT;
            let landed = if in_air { 0.0 } else { air_time[leg] };
            air_time[leg] = if in_air { air_time[leg] + self.spec.policy_dt as f32 } else { 0.0 };
            landed
        })
    }

    fn end_episode(&mut self, env: usize) {
        let episode = &mut self.episodes[env];
        episode.running = false;
        let final_obs = match self.autoreset {
            AutoresetMode::SameStep => self.batch.obs[env * OBS_LEN..(env + 1) * OBS_LEN].to_vec(),
            AutoresetMode::NextStep | AutoresetMode::Disabled => Vec::new(),
        };
        self.batch.ended.push(EndedEpisode {
            env,
            length: episode.length,
            episode_return: episode.episode_return,
            terms: episode.term_sums.clone(),
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
        let envs: Vec<usize> = (0..self.num_envs()).filter(|env| request.wants(*env)).collect();
        if let Some(seeds) = &request.seeds {
            for env in &envs {
                self.episodes[*env].stream = stream(seeds[*env], "walk", 0);
            }
        }
        self.start_episodes(&envs)?;
        Ok(&self.batch.obs)
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.check_actions(actions)?;
        self.batch.ended.clear();
        self.batch.reward.fill(0.0);
        self.batch.terminated.fill(false);
        self.batch.truncated.fill(false);
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
        for (env, action) in actions.chunks_exact(self.spec.action_len()).enumerate() {
            if self.active[env] {
                self.finish(env, action);
            }
        }
        if self.autoreset == AutoresetMode::SameStep {
            let ended: Vec<usize> = self.batch.ended.iter().map(|episode| episode.env).collect();
            self.start_episodes(&ended)?;
        }
        Ok(&self.batch)
    }

    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        let num_envs = self.num_envs();
        let episode = self.episodes.get(env).ok_or(EnvError::NoSuchEnv { env, num_envs })?;
        if !episode.running && !episode.was_started() {
            return Err(EnvError::NeedsReset { env });
        }
        let backend = &self.backend;
        let scene = Scene::new(backend.robot(), backend.states(), env, &self.ground);
        Ok(Scene { command: Some(episode.command), ..scene })
    }
}

impl Episode {
    fn idle(seed: u64, terms: usize) -> Self {
        Self {
            stream: stream(seed, "walk", 0),
            running: false,
            length: 0,
            episode_return: 0.0,
            term_sums: vec![0.0; terms],
            command: [0.0; 3],
            action: [0.0; 12],
            previous_dq: [0.0; 12],
            air_time: [0.0; 4],
            kp: 0.0,
            kd: 0.0,
        }
    }

    /// True if an episode ended here; false if none ever ran or the last one diverged.
    fn was_started(&self) -> bool {
        self.length > 0
    }

    fn start(&mut self) {
        self.running = true;
        self.length = 0;
        self.episode_return = 0.0;
        self.term_sums.fill(0.0);
        self.action = [0.0; 12];
        self.air_time = [0.0; 4];
    }

    fn add(&mut self, action: PerJoint, reward: f32, terms: &[f32]) {
        self.action = action;
        self.length += 1;
        self.episode_return += reward;
        for (sum, term) in self.term_sums.iter_mut().zip(terms) {
            *sum += term;
        }
    }
}

fn draw(stream: &mut Stream, [low, high]: Range) -> f32 {
    low + (high - low) * stream.random::<f32>()
}
