//! Environments of the task `pose` on robots of any tree.

use glam::{DAffine3, DQuat};
use twinstep_envs::{PoseState, PoseTask, TreeView};
use twinstep_model::{
    AutoresetMode, EndedEpisode, EnvError, EnvSpec, Ground, ResetRequest, Scene, StepBatch, Stream, TreeModel, VecEnv,
    stream,
};
use twinstep_sim::{Placement, TreeCommand, TreeError, TreeReadings, TreeSimulation};

/// Robots of one tree that follow targets of their joints.
pub struct TreeEnv {
    task: PoseTask,
    robot: TreeModel,
    simulation: TreeSimulation,
    autoreset: AutoresetMode,
    episodes: Vec<TreeEpisode>,
    commands: Vec<TreeCommand>,
    batch: StepBatch,
}

/// Episode of one robot.
struct TreeEpisode {
    state: PoseState,
    random: Stream,
    running: bool,
    diverged: bool,
    length: u32,
    episode_return: f32,
    terms: Vec<f32>,
    term_sums: Vec<f32>,
    action: Vec<f32>,
    previous_action: Vec<f32>,
}

impl TreeEnv {
    /// Creates an environment for each robot of a simulation. `seed` is that of episodes that a client does not seed.
    pub fn new(
        task: PoseTask,
        robot: TreeModel,
        simulation: TreeSimulation,
        autoreset: AutoresetMode,
        seed: u64,
    ) -> Self {
        let (num_envs, joints) = (simulation.num_robots(), robot.joints.len());
        let single = |part: usize| task.robot().gains.iter().map(|gains| gains[part] as f32).collect::<Vec<_>>();
        let command = TreeCommand { kp: single(0), kd: single(1), ..TreeCommand::hold(vec![0.0; joints], 0.0, 0.0) };
        let episode = |env: u64| TreeEpisode {
            state: PoseState::default(),
            random: stream(seed.wrapping_add(env), "pose", 0),
            running: false,
            diverged: false,
            length: 0,
            episode_return: 0.0,
            terms: vec![0.0; task.spec().reward_terms.len()],
            term_sums: vec![0.0; task.spec().reward_terms.len()],
            action: vec![0.0; joints],
            previous_action: vec![0.0; joints],
        };
        Self {
            autoreset,
            episodes: (0..num_envs as u64).map(episode).collect(),
            commands: vec![command; num_envs],
            batch: StepBatch::new(num_envs, task.spec()),
            task,
            robot,
            simulation,
        }
    }

    fn check_actions(&self, actions: &[f32]) -> Result<(), EnvError> {
        let action_len = self.task.spec().action_len();
        let expected = self.num_envs() * action_len;
        if actions.len() != expected {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), expected });
        }
        if let Some(index) = actions.iter().position(|value| !value.is_finite()) {
            let entry = self.task.spec().action_entry(index % action_len);
            return Err(EnvError::ActionNotFinite { env: index / action_len, entry, value: actions[index] });
        }
        let restarts = self.autoreset != AutoresetMode::Disabled;
        let needs_reset = |episode: &TreeEpisode| !episode.running && (!restarts || episode.length == 0);
        self.episodes.iter().position(needs_reset).map_or(Ok(()), |env| Err(EnvError::NeedsReset { env }))
    }

    /// Starts an episode of a robot at rest, and observes it.
    fn start(&mut self, env: usize) -> Result<(), EnvError> {
        let episode = &mut self.episodes[env];
        let (q, state) = self.task.start(&mut episode.random);
        self.simulation.reset(env, &self.robot, &Placement::of(&self.robot.tree, q)).map_err(failed)?;
        episode.state = state;
        (episode.running, episode.diverged) = (true, false);
        (episode.length, episode.episode_return) = (0, 0.0);
        episode.term_sums.fill(0.0);
        episode.action.fill(0.0);
        self.observe(env);
        Ok(())
    }

    fn observe(&mut self, env: usize) {
        let (episode, len) = (&self.episodes[env], self.task.spec().obs_len());
        let robot = view(&self.simulation.states()[env]);
        self.task.observe(&episode.state, &robot, &episode.action, &mut self.batch.obs[env * len..(env + 1) * len]);
    }

    /// Sets the targets of the drives.
    fn command(&mut self, actions: &[f32]) {
        let (pose, scale) = (&self.task.robot().default_pose, self.task.robot().action_scale);
        let rows = actions.chunks_exact(pose.len());
        for ((episode, command), action) in self.episodes.iter_mut().zip(&mut self.commands).zip(rows) {
            std::mem::swap(&mut episode.previous_action, &mut episode.action);
            for (joint, value) in action.iter().enumerate() {
                episode.action[joint] = value.clamp(-1.0, 1.0);
                command.q[joint] = (pose[joint] + scale * f64::from(episode.action[joint])) as f32;
            }
        }
    }

    /// Writes reward, end flags and observation of a robot whose episode runs.
    fn finish(&mut self, env: usize) {
        let readings = &self.simulation.states()[env];
        let episode = &mut self.episodes[env];
        episode.length += 1;
        self.batch.reward[env] = 0.0;
        (self.batch.terminated[env], self.batch.truncated[env]) = (false, false);
        if !is_finite(readings) {
            // A diverged robot keeps its last observation.
            (episode.running, episode.diverged, self.batch.truncated[env]) = (false, true, true);
            return;
        }
        let TreeEpisode { state, random, terms, action, previous_action, .. } = episode;
        let terminated = self.task.evaluate(state, &view(readings), [action, previous_action], random, terms);
        let reward: f32 = terms.iter().sum();
        episode.episode_return += reward;
        episode.term_sums.iter_mut().zip(&episode.terms).for_each(|(sum, term)| *sum += term);
        let timed_out = episode.length >= self.task.spec().max_episode_steps;
        episode.running = !(terminated || timed_out);
        self.batch.reward[env] = reward;
        (self.batch.terminated[env], self.batch.truncated[env]) = (terminated, timed_out && !terminated);
        self.observe(env);
    }

    fn report(&mut self, env: usize) {
        let (episode, len) = (&self.episodes[env], self.task.spec().obs_len());
        let final_obs = match self.autoreset {
            AutoresetMode::SameStep => self.batch.obs[env * len..(env + 1) * len].to_vec(),
            AutoresetMode::NextStep | AutoresetMode::Disabled => Vec::new(),
        };
        self.batch.ended.push(EndedEpisode {
            env,
            length: episode.length,
            episode_return: episode.episode_return,
            terms: episode.term_sums.clone(),
            diverged: episode.diverged,
            final_obs,
            final_critic_obs: Vec::new(),
        });
    }
}

impl VecEnv for TreeEnv {
    fn spec(&self) -> &EnvSpec {
        self.task.spec()
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
                self.episodes[env].random = stream(seeds[env], "pose", 0);
            }
            self.start(env)?;
        }
        Ok(&self.batch.obs)
    }

    fn obs(&self) -> &[f32] {
        &self.batch.obs
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.check_actions(actions)?;
        self.command(actions);
        self.simulation.step(&self.commands, self.task.robot().decimation).map_err(failed)?;
        self.batch.ended.clear();
        for env in 0..self.num_envs() {
            if !self.episodes[env].running {
                // The step after the last one of an episode resets the robot; its action has no effect.
                self.start(env)?;
                self.batch.reward[env] = 0.0;
                (self.batch.terminated[env], self.batch.truncated[env]) = (false, false);
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
        if !episode.running && episode.length == 0 {
            return Err(EnvError::NeedsReset { env });
        }
        let TreeReadings { state, tau, shape_force } = &self.simulation.states()[env];
        let [w, x, y, z] = state.base_orientation;
        let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
        let base = DAffine3::from_rotation_translation(rotation, state.base_position.into());
        let numbers = |values: &[f64]| Some(values.iter().map(|value| *value as f32).collect());
        Ok(Scene {
            torque: numbers(tau),
            contact_force: numbers(shape_force),
            reward_terms: episode.terms.clone(),
            ..Scene::of_tree(&self.robot.tree, base, &state.q, &Ground::FLAT)
        })
    }
}

fn view(readings: &TreeReadings) -> TreeView<'_> {
    let state = &readings.state;
    TreeView {
        q: &state.q,
        dq: &state.dq,
        tau: &readings.tau,
        orientation: state.base_orientation.map(|part| part as f32),
        angular_velocity: state.base_angular_velocity.map(|part| part as f32),
        height: state.base_position[2],
    }
}

fn is_finite(readings: &TreeReadings) -> bool {
    let state = &readings.state;
    let base = state.base_position.iter().chain(&state.base_orientation).chain(&state.base_angular_velocity);
    base.chain(&state.q).chain(&state.dq).chain(&readings.tau).all(|value| value.is_finite())
}

fn failed(error: TreeError) -> EnvError {
    EnvError::Remote(Box::new(error))
}
