//! Small tasks that are learnt in seconds.

use rand::RngExt;
use twinstep_model::{
    AutoresetMode, EndedEpisode, EnvError, EnvSpec, ResetRequest, SpecField, StepBatch, Stream, Trajectory, VecEnv,
    stream,
};

use twinstep_policy::{BehaviourPolicy, Collector, StepCollector};

use crate::{Learner, LearningError, PpoConfig, Trainer};

/// State of one environment of a small task.
trait ToyTask: Clone + Send + 'static {
    const NAME: &'static str;
    const OBS_LEN: usize;
    const EPISODE_STEPS: u32;
    fn start(random: &mut Stream) -> Self;
    fn observe(&self, obs: &mut [f32]);
    /// Advances the state and returns the reward, and true if the episode terminates.
    fn step(&mut self, action: f32) -> (f32, bool);
}

/// The reward is highest if the action equals the observation. Every episode has one step.
#[derive(Clone)]
struct Identity(f32);

impl ToyTask for Identity {
    const NAME: &'static str = "identity";
    const OBS_LEN: usize = 1;
    const EPISODE_STEPS: u32 = 1;

    fn start(random: &mut Stream) -> Self {
        Self(2.0 * random.random::<f32>() - 1.0)
    }

    fn observe(&self, obs: &mut [f32]) {
        obs[0] = self.0;
    }

    fn step(&mut self, action: f32) -> (f32, bool) {
        (-(action - self.0).powi(2), true)
    }
}

/// A pendulum that must be swung up with a torque that is too small to lift it (Gymnasium's `Pendulum-v1`).
#[derive(Clone)]
struct Pendulum {
    angle: f32,
    velocity: f32,
}

impl ToyTask for Pendulum {
    const NAME: &'static str = "pendulum";
    const OBS_LEN: usize = 3;
    const EPISODE_STEPS: u32 = 200;

    fn start(random: &mut Stream) -> Self {
        Self { angle: std::f32::consts::TAU * random.random::<f32>(), velocity: 2.0 * random.random::<f32>() - 1.0 }
    }

    fn observe(&self, obs: &mut [f32]) {
        obs.copy_from_slice(&[self.angle.cos(), self.angle.sin(), self.velocity]);
    }

    fn step(&mut self, action: f32) -> (f32, bool) {
        let torque = 2.0 * action.clamp(-1.0, 1.0);
        let from_top = (self.angle + std::f32::consts::PI).rem_euclid(std::f32::consts::TAU) - std::f32::consts::PI;
        let cost = from_top.powi(2) + 0.1 * self.velocity.powi(2) + 0.001 * torque.powi(2);
        self.velocity = (self.velocity + 0.05 * (15.0 * self.angle.sin() + 3.0 * torque)).clamp(-8.0, 8.0);
        self.angle += 0.05 * self.velocity;
        (-cost, false)
    }
}

struct ToyEnv<T> {
    spec: EnvSpec,
    states: Vec<T>,
    random: Vec<Stream>,
    lengths: Vec<u32>,
    returns: Vec<f32>,
    obs: Vec<f32>,
    batch: StepBatch,
    /// Step in which the reward is NaN.
    nan_at: Option<u64>,
    steps: u64,
}

impl<T: ToyTask> ToyEnv<T> {
    fn boxed(num_envs: usize, nan_at: Option<u64>) -> Box<dyn VecEnv> {
        let field = |name: &str, size| SpecField {
            name: name.to_owned(),
            size,
            unit: String::new(),
            low: -10.0,
            high: 10.0,
            description: String::new(),
        };
        let spec = EnvSpec {
            task: T::NAME.to_owned(),
            robot: "none".to_owned(),
            observation: vec![field("state", T::OBS_LEN)],
            critic_observation: Vec::new(),
            action: vec![field("action", 1)],
            joint_order: Vec::new(),
            policy_dt: 0.05,
            actuator_dt: 0.05,
            kp: 0.0,
            kd: 0.0,
            joint_gains: Vec::new(),
            action_scale: 1.0,
            default_pose: Vec::new(),
            reward_terms: Vec::new(),
            max_episode_steps: T::EPISODE_STEPS,
        };
        let mut random: Vec<Stream> = (0..num_envs as u64).map(|env| stream(env, "toy", 0)).collect();
        Box::new(Self {
            states: random.iter_mut().map(T::start).collect(),
            random,
            lengths: vec![0; num_envs],
            returns: vec![0.0; num_envs],
            obs: vec![0.0; num_envs * T::OBS_LEN],
            batch: StepBatch::new(num_envs, &spec),
            spec,
            nan_at,
            steps: 0,
        })
    }

    fn observe(&mut self) {
        for (state, obs) in self.states.iter().zip(self.obs.chunks_exact_mut(T::OBS_LEN)) {
            state.observe(obs);
        }
    }
}

impl<T: ToyTask> VecEnv for ToyEnv<T> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.states.len()
    }

    fn autoreset(&self) -> AutoresetMode {
        AutoresetMode::SameStep
    }

    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        for (env, seed) in request.seeds.iter().flatten().enumerate() {
            self.random[env] = stream(*seed, "toy", 0);
            self.states[env] = T::start(&mut self.random[env]);
        }
        self.observe();
        Ok(&self.obs)
    }

    fn obs(&self) -> &[f32] {
        &self.obs
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.batch.ended.clear();
        self.steps += 1;
        for (env, action) in actions.iter().enumerate() {
            let (reward, terminated) = self.states[env].step(*action);
            self.lengths[env] += 1;
            self.returns[env] += reward;
            let truncated = self.lengths[env] == T::EPISODE_STEPS && !terminated;
            self.batch.reward[env] = if self.nan_at == Some(self.steps) { f32::NAN } else { reward };
            (self.batch.terminated[env], self.batch.truncated[env]) = (terminated, truncated);
            if terminated || truncated {
                let mut final_obs = vec![0.0; T::OBS_LEN];
                self.states[env].observe(&mut final_obs);
                let ended = EndedEpisode {
                    env,
                    length: self.lengths[env],
                    episode_return: self.returns[env],
                    final_obs,
                    ..EndedEpisode::default()
                };
                self.batch.ended.push(ended);
                self.states[env] = T::start(&mut self.random[env]);
                (self.lengths[env], self.returns[env]) = (0, 0.0);
            }
        }
        self.observe();
        self.batch.obs.copy_from_slice(&self.obs);
        Ok(&self.batch)
    }
}

fn config() -> PpoConfig {
    PpoConfig {
        num_envs: 32,
        groups: 2,
        actor_hidden: vec![32, 32],
        critic_hidden: vec![32, 32],
        ..PpoConfig::default()
    }
}

fn envs<T: ToyTask>(config: &PpoConfig) -> Vec<Box<dyn Collector>> {
    let env = |_| ToyEnv::<T>::boxed(config.num_envs / config.groups, None);
    (0..config.groups).map(env).map(|env| Box::new(StepCollector(env)) as Box<dyn Collector>).collect()
}

/// Returns the mean reward per step of the last of `iterations` iterations.
fn train<T: ToyTask>(config: PpoConfig, iterations: usize) -> f64 {
    let mut trainer = Trainer::new(config.clone(), envs::<T>(&config), None, 1).expect("valid");
    let mut reward = 0.0;
    for _ in 0..iterations {
        let statistics = trainer.iterate().expect("finite").statistics;
        reward = statistics.reward / statistics.steps as f64;
    }
    reward
}

#[test]
fn identity_is_learnt_up_to_the_exploration_noise() {
    let config = PpoConfig { horizon: 16, epochs: 4, entropy_weight: 0.0, ..config() };
    let untrained = train::<Identity>(config.clone(), 1);
    let trained = train::<Identity>(config, 60);
    // A random action of standard deviation 0.5 has −(1/3 + 0.25).
    assert!((untrained + 0.58).abs() < 0.08, "{untrained}");
    assert!(trained > -0.02, "{trained}");
}

#[test]
fn pendulum_is_swung_up_and_balanced() {
    let config = PpoConfig { horizon: 128, epochs: 5, gamma: 0.95, ..config() };
    let reward = train::<Pendulum>(config, 100);
    // Hanging costs π² ≈ 10 per step. A good controller reaches −1 in Gymnasium's task, the swing-up included.
    assert!(reward > -1.6, "{reward}");
}

#[test]
fn equal_seeds_give_equal_bits_on_any_number_of_threads() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| {
            let config = PpoConfig { groups: 4, ..config() };
            let mut trainer = Trainer::new(config.clone(), envs::<Pendulum>(&config), None, 7).expect("valid");
            (0..5).for_each(|_| drop(trainer.iterate().expect("finite")));
            trainer.learner().clone()
        })
    };
    let one = run(1);
    assert!(one == run(3));
    let other = {
        let config = PpoConfig { groups: 4, ..config() };
        Learner::new(&config, envs::<Pendulum>(&config)[0].spec(), 8)
    };
    assert!(one.actor != other.actor);
}

#[test]
fn nan_ends_the_training_with_the_last_good_policy() {
    let config = PpoConfig { groups: 1, ..config() };
    let env = ToyEnv::<Pendulum>::boxed(config.num_envs, Some(3 * config.horizon as u64 + 5));
    let mut trainer = Trainer::new(config, vec![Box::new(StepCollector(env))], None, 1).expect("valid");
    for _ in 0..3 {
        trainer.iterate().expect("finite");
    }
    let good = trainer.learner().clone();
    let error = trainer.iterate().expect_err("a reward is NaN");
    assert!(matches!(error, LearningError::NotFinite { iteration: 4 }), "{error}");
    assert!(trainer.learner().actor == good.actor && trainer.learner().critic == good.critic);
}

#[test]
fn resumed_learner_is_the_one_that_was_saved() {
    let config = config();
    let mut trainer = Trainer::new(config.clone(), envs::<Pendulum>(&config), None, 3).expect("valid");
    (0..3).for_each(|_| drop(trainer.iterate().expect("finite")));
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("checkpoint.safetensors");
    let checkpoint = crate::Checkpoint {
        learner: trainer.learner().clone(),
        spec: trainer.spec().clone(),
        seed: 3,
        config: "text".to_owned(),
        curve: Vec::new(),
    };
    checkpoint.write(&path).expect("written");
    let read = crate::Checkpoint::read(&path).expect("read");
    assert!(read.learner.actor == checkpoint.learner.actor && read.learner.optimisers == checkpoint.learner.optimisers);
    let mut resumed = Trainer::new(config.clone(), envs::<Pendulum>(&config), Some(read.learner), 3).expect("valid");
    let iteration = resumed.iterate().expect("finite");
    assert_eq!((iteration.iteration, iteration.env_steps), (4, 4 * config.batch_len() as u64));
}

/// With the learning rate of untrained networks, the first update has a divergence of 0.12 nat.
#[test]
fn fine_tuning_starts_near_the_earlier_policy() {
    let config = PpoConfig { horizon: 128, epochs: 5, gamma: 0.95, initial_std: 0.005, ..config() };
    let mut trainer = Trainer::new(config.clone(), envs::<Pendulum>(&config), None, 1).expect("valid");
    (0..5).for_each(|_| drop(trainer.iterate().expect("finite")));
    let start = trainer.learner().clone().fine_tuned(&config);
    assert!(start.actor == trainer.learner().actor && start.critic == trainer.learner().critic);
    let mut tuned = Trainer::new(config.clone(), envs::<Pendulum>(&config), Some(start), 1).expect("valid");
    let kl = tuned.iterate().expect("finite").kl;
    assert!(kl < 0.03, "{kl}");
}

#[test]
fn groups_of_a_given_learner_are_in_different_parts_of_their_episodes() {
    let config = PpoConfig { horizon: 110, ..config() };
    let ended = |learner: Option<Learner>| {
        let mut trainer = Trainer::new(config.clone(), envs::<Pendulum>(&config), learner, 1).expect("valid");
        (trainer.iterate().expect("finite").statistics.episodes, trainer.learner().clone())
    };
    let (at_once, learner) = ended(None);
    // Episodes have 200 steps. One of the two groups begins in their middle.
    assert_eq!((at_once, ended(Some(learner)).0), (0, config.num_envs as u64 / 2));
}

/// Robots that cannot be reached in their second rollout.
struct Unreliable(StepCollector, u32);

impl Collector for Unreliable {
    fn spec(&self) -> &EnvSpec {
        self.0.spec()
    }

    fn num_envs(&self) -> usize {
        self.0.num_envs()
    }

    fn autoreset(&self) -> AutoresetMode {
        self.0.autoreset()
    }

    fn reset(&mut self, seeds: &[u64]) -> Result<(), EnvError> {
        self.0.reset(seeds)
    }

    fn collect(
        &mut self,
        policy: &BehaviourPolicy,
        noise_seed: u64,
        steps: usize,
        trajectory: &mut Trajectory,
    ) -> Result<bool, EnvError> {
        self.1 += 1;
        if self.1 == 2 { Ok(false) } else { self.0.collect(policy, noise_seed, steps, trajectory) }
    }
}

#[test]
fn robots_that_cannot_be_reached_are_left_out_of_the_update() {
    let config = config();
    let mut collectors = envs::<Pendulum>(&config);
    collectors[1] = Box::new(Unreliable(StepCollector(ToyEnv::<Pendulum>::boxed(16, None)), 0));
    let mut trainer = Trainer::new(config.clone(), collectors, None, 1).expect("valid");
    let steps: Vec<u64> = (0..3).map(|_| trainer.iterate().expect("finite").env_steps).collect();
    let batch = config.batch_len() as u64;
    assert_eq!(steps, [batch, batch + batch / 2, 2 * batch + batch / 2]);
}

#[test]
fn learner_of_another_task_is_refused() {
    let config = config();
    let learner = Learner::new(&config, envs::<Identity>(&config)[0].spec(), 1);
    let error = Trainer::new(config.clone(), envs::<Pendulum>(&config), Some(learner), 1).err().expect("refused");
    assert_eq!(
        error.to_string(),
        "the learner has [1, 1, 1] observation and action entries, the environments have [3, 3, 1]"
    );
}

#[test]
fn task_without_a_known_mirror_image_is_refused_with_its_field() {
    let config = PpoConfig { symmetry: true, ..config() };
    let error = Trainer::new(config.clone(), envs::<Pendulum>(&config), None, 1).err().expect("refused").to_string();
    assert_eq!(error, "`train.symmetry` is not possible: the mirror image of `state` is not known");
}
