//! Episode of one environment: random numbers, actions and sums of rewards, for any task.

use rand::Rng;
use twinstep_model::{AgentCommands, Stream, stream};

use crate::Randomisation;
use crate::task::{RobotView, Step, Task};

/// State of the episode of one environment. `S` is that of the task.
pub struct Episode<S> {
    /// State of the task.
    pub state: S,
    /// Source of random numbers for robots, poses and commands.
    random: Stream,
    /// Source of the noise of the observation.
    pub noise: Stream,
    /// Source of the pushes.
    pushes: Stream,
    /// Policy steps until the next push.
    steps_to_push: u32,
    seed: u64,
    /// Number of episodes that were started with this seed.
    episode_index: u64,
    /// True from a reset to the end of the episode.
    pub running: bool,
    /// True if the simulation diverged in the last step.
    pub diverged: bool,
    /// Number of policy steps so far.
    pub length: u32,
    /// Sum of rewards so far.
    pub episode_return: f32,
    /// Weighted reward terms of the last step.
    pub terms: Vec<f32>,
    /// Sum of each weighted reward term so far.
    pub term_sums: Vec<f32>,
    /// Last action, clipped.
    pub action: Vec<f32>,
    previous_action: Vec<f32>,
    previous_dq: Vec<f32>,
}

/// Random values of a new episode.
pub struct EpisodeStart<R> {
    /// The robot of the episode. `None`: that of the backend.
    pub robot: Option<R>,
    /// Seed of the random numbers in the actuators.
    pub actuator_seed: u64,
    /// Joint position [rad].
    pub q: Vec<f32>,
    /// Source of the place on the ground.
    pub place: Stream,
    /// True for the first episode with a seed.
    pub is_first: bool,
}

/// Reward and end flags of a policy step.
#[derive(Clone, Copy, Default)]
pub struct StepOutcome {
    /// The reward.
    pub reward: f32,
    /// True if the task ended the episode.
    pub terminated: bool,
    /// True if the time limit ended the episode.
    pub truncated: bool,
}

impl<S: Default> Episode<S> {
    /// Creates an environment of `task` without an episode, whose random numbers come from `seed`.
    pub fn not_started(task: &impl Task<State = S>, seed: u64) -> Self {
        let spec = task.spec();
        let joints = spec.action_len();
        Self {
            state: S::default(),
            random: stream(seed, &spec.task, 0),
            noise: stream(seed, "noise", 0),
            pushes: stream(seed, "push", 0),
            steps_to_push: 0,
            seed,
            episode_index: 0,
            running: false,
            diverged: false,
            length: 0,
            episode_return: 0.0,
            terms: vec![0.0; spec.reward_terms.len()],
            term_sums: vec![0.0; spec.reward_terms.len()],
            action: vec![0.0; joints],
            previous_action: vec![0.0; joints],
            previous_dq: vec![0.0; joints],
        }
    }

    /// Sets the seed of the following episodes.
    pub fn seed(&mut self, task: &impl Task<State = S>, seed: u64) {
        (self.random, self.seed, self.episode_index) = (stream(seed, &task.spec().task, 0), seed, 0);
    }

    /// Ends the episode in a step in which the simulation diverged.
    pub fn diverge(&mut self) {
        (self.running, self.diverged) = (false, true);
        self.length += 1;
    }

    /// Ends the episode in a step after which the robot follows no actions. `terminates`: its motion is the reason.
    pub fn stop(&mut self, outcome: StepOutcome, terminates: bool) -> StepOutcome {
        self.running = false;
        let terminated = outcome.terminated || terminates;
        StepOutcome { terminated, truncated: !terminated, ..outcome }
    }

    /// Returns true if an episode has run.
    pub fn was_started(&self) -> bool {
        self.length > 0
    }

    /// Starts a new episode: resets the sums, and samples robot, pose and the state of the task.
    ///
    /// `sample` returns the robot of the episode, from random numbers of its effects, and from those of everything else.
    pub fn start<R>(
        &mut self,
        task: &impl Task<State = S>,
        randomise: &Randomisation,
        sample: impl FnOnce(&mut Stream, &mut Stream) -> Option<R>,
    ) -> EpisodeStart<R> {
        // Separate streams: poses and commands do not depend on whether effects, actuators, noise and pushes use random
        // numbers.
        let mut effects = stream(self.seed, "effects", self.episode_index);
        let actuator_seed = stream(self.seed, "drives", self.episode_index).next_u64();
        self.noise = stream(self.seed, "noise", self.episode_index);
        self.pushes = stream(self.seed, "push", self.episode_index);
        self.steps_to_push = randomise.sample_push_steps(task.spec().policy_dt, &mut self.pushes);
        let (place, is_first) = (stream(self.seed, "place", self.episode_index), self.episode_index == 0);
        let robot = sample(&mut effects, &mut self.random);
        let (q, state) = task.start(&mut self.random);
        self.state = state;
        self.episode_index += 1;
        (self.running, self.diverged) = (true, false);
        self.length = 0;
        self.episode_return = 0.0;
        self.terms.fill(0.0);
        self.term_sums.fill(0.0);
        self.action.fill(0.0);
        EpisodeStart { robot, actuator_seed, q, place, is_first }
    }

    /// Returns the velocity that a push adds before this step, in the world frame [m/s]. `None`: there is no push.
    pub fn next_push(&mut self, randomise: &Randomisation, policy_dt: f64) -> Option<[f32; 3]> {
        self.steps_to_push -= 1;
        if self.steps_to_push > 0 {
            return None;
        }
        self.steps_to_push = randomise.sample_push_steps(policy_dt, &mut self.pushes);
        Some(randomise.sample_push(&mut self.pushes))
    }

    /// Sets the agent's commands of environment `env`.
    pub fn set_commands(&mut self, task: &impl Task<State = S>, commands: &AgentCommands, env: usize) {
        if let Some(commands) = &commands.velocity {
            task.set_velocity_command(&mut self.state, commands[env]);
        }
        if let Some(commands) = &commands.gait {
            task.set_gait_command(&mut self.state, commands[env]);
        }
    }

    /// Stores the action before a step, clipped, and the joint velocities.
    pub fn act(&mut self, action: &[f32], dq: &[f32]) {
        std::mem::swap(&mut self.previous_action, &mut self.action);
        for (own, value) in self.action.iter_mut().zip(action) {
            *own = value.clamp(-1.0, 1.0);
        }
        self.previous_dq.copy_from_slice(dq);
    }

    /// Returns the reward and the end flags after a step of `robot`.
    pub fn evaluate_step(
        &mut self,
        task: &impl Task<State = S>,
        robot: RobotView,
        max_episode_steps: u32,
    ) -> StepOutcome {
        let Self { state, random, action, previous_action, previous_dq, terms, .. } = self;
        self.length += 1;
        let step = Step { robot, action, previous_action, previous_dq, length: self.length };
        let terminated = task.evaluate(state, &step, random, terms);
        let reward = terms.iter().sum();
        self.episode_return += reward;
        self.term_sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += *term);
        let timed_out = self.length >= max_episode_steps;
        self.running = !(terminated || timed_out);
        StepOutcome { reward, terminated, truncated: timed_out && !terminated }
    }
}
