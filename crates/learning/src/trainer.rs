//! Training: rollouts and updates in turn.

use std::time::{Duration, Instant};

use rand::seq::SliceRandom;
use rayon::prelude::*;
use twinstep_model::{AutoresetMode, EnvError, EnvSpec, stream};
use twinstep_policy::{BehaviourPolicy, Collector, Mlp, Network, Normaliser, Policy, noise_seed};

use crate::adam::Adam;
use crate::config::{PpoConfig, PpoConfigError};
use crate::rollout::{Behaviour, Group, feature_len};
use crate::statistics::Statistics;
use crate::symmetry::{Mirror, NoMirror};
use crate::update::{Batch, GradientTask, LossSums, Mirrors, Parameters, Sample};

/// Lowest learning rate.
const MIN_LEARNING_RATE: f32 = 1e-5;
/// Factor by which the learning rate changes.
const LEARNING_RATE_FACTOR: f32 = 1.5;
/// Share of the training after which the target of the divergence decreases, and its share that is left at the end.
const DECAY_START: f64 = 0.5;
const FINAL_KL_SHARE: f64 = 0.1;
/// Share of the earlier mean that remains in [`Learner::mean_actor`] after an update.
const MEAN_DECAY: f32 = 0.9;
/// Gain of the actor's last layer, so that the first actions are close to the default pose.
const ACTOR_OUTPUT_GAIN: f32 = 0.01;

/// Highest learning rate with which another training starts from earlier networks.
///
/// The deviation of their actions is small, and the first steps of a new optimiser are large: with the rate of untrained
/// networks the first update of a policy that jumps had a divergence of 5 nat. A higher rate is found within few updates.
const START_LEARNING_RATE: f32 = 3e-5;

/// Number of observations for which the moments of a policy's normaliser count when another training starts with it.
const POLICY_MOMENTS_COUNT: f64 = 1e5;

/// Time without any robot after which the training ends.
const MAX_ENV_LOSS: Duration = Duration::from_mins(1);
/// Pause before the next attempt to reach a robot.
const RETRY_PERIOD: Duration = Duration::from_millis(100);

/// What is learnt, with the state of the optimiser.
#[derive(Clone, Debug, PartialEq)]
pub struct Learner {
    /// Network from the normalised observation of group `policy` to the mean action.
    pub actor: Mlp,
    /// Mean of the actor's parameters over the last updates: the policy that is kept.
    ///
    /// Its actions are less noisy than those of the actor after any one update (Polyak and Juditsky 1992).
    pub mean_actor: Mlp,
    /// Network from the normalised observations of both groups to the value.
    pub critic: Mlp,
    /// Logarithm of the standard deviation of each entry of the action.
    pub log_std: Vec<f32>,
    /// Moments of the observations of both groups, `policy` first.
    pub normaliser: Normaliser,
    /// Optimisers of actor, critic and standard deviation.
    pub optimisers: [Adam; 3],
    /// Current learning rate.
    pub learning_rate: f32,
    /// Number of updates so far.
    pub iteration: u64,
    /// Number of environment steps so far.
    pub env_steps: u64,
}

impl Learner {
    /// Creates untrained networks for the observations and actions of `spec`.
    pub fn new(config: &PpoConfig, spec: &EnvSpec, seed: u64) -> Self {
        let sizes = |inputs: usize, hidden: &[usize], outputs: usize| {
            std::iter::once(inputs).chain(hidden.iter().copied()).chain([outputs]).collect::<Vec<_>>()
        };
        let (obs_len, feature_len, action_len) = (spec.obs_len(), feature_len(spec), spec.action_len());
        let mut random = stream(seed, "networks", 0);
        let actor_sizes = sizes(obs_len, &config.actor_hidden, action_len);
        let actor = Mlp::orthogonal(&actor_sizes, ACTOR_OUTPUT_GAIN, &mut random);
        let critic = Mlp::orthogonal(&sizes(feature_len, &config.critic_hidden, 1), 1.0, &mut random);
        let log_std = vec![config.initial_std.ln(); action_len];
        let lengths = [actor.parameters.len(), critic.parameters.len(), log_std.len()];
        Self {
            mean_actor: actor.clone(),
            actor,
            critic,
            log_std,
            normaliser: Normaliser::identity(feature_len),
            optimisers: lengths.map(Adam::new),
            learning_rate: config.learning_rate,
            iteration: 0,
            env_steps: 0,
        }
    }

    /// Creates a learner whose actor is that of a policy for the same observations and actions. The critic is untrained.
    pub fn from_policy(policy: &Policy, config: &PpoConfig, spec: &EnvSpec, seed: u64) -> Self {
        let untrained = Self::new(config, spec, seed);
        let Policy { actor, log_std, .. } = policy.clone();
        let (mean, std) = policy.normaliser.mean_and_std();
        // Group `critic` has no moments yet: the count is so small that a few updates find them.
        let more = feature_len(spec) - mean.len();
        let mean = mean.iter().map(|mean| f64::from(*mean)).chain(vec![0.0; more]).collect();
        let variance = std.iter().map(|std| f64::from(*std).powi(2)).chain(vec![1.0; more]).collect();
        let normaliser = Normaliser::from_moments(POLICY_MOMENTS_COUNT, mean, variance);
        let optimisers = [actor.parameters.len(), untrained.critic.parameters.len(), log_std.len()].map(Adam::new);
        Self { mean_actor: actor.clone(), actor, log_std, normaliser, optimisers, ..untrained }
    }

    /// Returns the start of another training with these networks: its optimisers and counters are new, and its learning rate
    /// is low.
    pub fn fine_tuned(self, config: &PpoConfig) -> Self {
        let lengths = [self.actor.parameters.len(), self.critic.parameters.len(), self.log_std.len()];
        Self {
            optimisers: lengths.map(Adam::new),
            learning_rate: config.learning_rate.min(START_LEARNING_RATE),
            iteration: 0,
            env_steps: 0,
            ..self
        }
    }

    /// Returns the policy, with the normaliser of the observation of group `policy`.
    pub fn policy(&self, spec: &EnvSpec) -> Policy {
        let normaliser = self.policy_normaliser(spec.obs_len());
        Policy { spec: spec.clone(), normaliser, actor: self.mean_actor.clone(), log_std: self.log_std.clone() }
    }

    /// Returns the policy that collects the next transitions.
    fn behaviour_policy(&self, obs_len: usize) -> BehaviourPolicy {
        BehaviourPolicy::new(self.actor.clone(), self.policy_normaliser(obs_len), self.log_std.clone())
    }

    /// Returns the normaliser of the observation of group `policy`.
    fn policy_normaliser(&self, obs_len: usize) -> Normaliser {
        let Normaliser { count, mean, variance, .. } = &self.normaliser;
        Normaliser::from_moments(*count, mean[..obs_len].to_vec(), variance[..obs_len].to_vec())
    }

    /// Checks that the networks fit the observations and actions of `spec`.
    fn check_layout(&self, spec: &EnvSpec) -> Result<(), LearningError> {
        let own = [self.actor.inputs(), self.critic.inputs(), self.actor.outputs()];
        let expected = [spec.obs_len(), feature_len(spec), spec.action_len()];
        if own == expected {
            return Ok(());
        }
        Err(LearningError::OtherLayout { learner: format!("{own:?}"), envs: format!("{expected:?}") })
    }

    /// Returns true if all parameters are finite.
    fn is_finite(&self) -> bool {
        [&self.actor.parameters, &self.critic.parameters, &self.log_std]
            .into_iter()
            .all(|values| values.iter().all(|value| value.is_finite()))
    }
}

/// Result of one rollout and update.
#[derive(Clone, Debug, PartialEq)]
pub struct Iteration {
    /// Number of updates so far.
    pub iteration: u64,
    /// Number of environment steps so far.
    pub env_steps: u64,
    /// Rewards, falls and velocity errors of the rollout.
    pub statistics: Statistics,
    /// Mean clipped surrogate of the return.
    pub surrogate: f64,
    /// Mean squared error of the value.
    pub value_loss: f64,
    /// Mean Kullback–Leibler divergence between the policies before and after [nat].
    pub kl: f64,
    /// Share of the probability ratios that were clipped.
    pub clipped_share: f64,
    /// Learning rate after the update.
    pub learning_rate: f32,
    /// Mean standard deviation of the actions.
    pub action_std: f32,
    /// Time of the rollout.
    pub rollout_time: Duration,
    /// Time of the update.
    pub update_time: Duration,
}

/// Reasons why training ends.
#[derive(Debug, thiserror::Error)]
pub enum LearningError {
    /// A setting is outside its range.
    #[error(transparent)]
    Config(#[from] PpoConfigError),
    /// The task has no mirror image.
    #[error(transparent)]
    NoMirror(#[from] NoMirror),
    /// The environments must reset in the step in which an episode ends.
    #[error("the environments have autoreset {given:?}; training needs {:?}", AutoresetMode::SameStep)]
    Autoreset {
        /// The mode of the environments.
        given: AutoresetMode,
    },
    /// The learner that is continued is for other observations or actions.
    #[error("the learner has {learner} observation and action entries, the environments have {envs}")]
    OtherLayout {
        /// Numbers of entries of observation, both groups, and action of the learner.
        learner: String,
        /// The same of the environments.
        envs: String,
    },
    /// The environments failed.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// No environment can be reached.
    #[error("no robot can be reached for {waited_s:.0} s: start a server again, then continue with --resume")]
    NoEnvs {
        /// Time since the last rollout [s].
        waited_s: f64,
    },
    /// A parameter or the gradient became NaN or infinite.
    #[error(
        "the gradient of update {iteration} is not finite; the learner is that before the update. A lower \
         `train.learning_rate` or `train.max_learning_rate` may help"
    )]
    NotFinite {
        /// Number of the update.
        iteration: u64,
    },
}

/// Trains a policy on groups of robots. Robots that cannot be reached are left out of the updates until they are back.
pub struct Trainer {
    config: PpoConfig,
    spec: EnvSpec,
    seed: u64,
    groups: Vec<Group>,
    mirrors: Option<Mirrors>,
    learner: Learner,
    networks: [Network; 2],
    task: GradientTask,
    samples: Vec<Sample>,
}

impl Trainer {
    /// Starts or continues the training of `learner` on the robots of `collectors`, one for each group.
    ///
    /// The groups of a learner that is given first run the policy for different parts of an episode. Otherwise an update would
    /// see one phase of a jump only, and the divergence, which limits the learning rate, would not see how the actions of
    /// the other phases change. Untrained robots fall at different times.
    pub fn new(
        config: PpoConfig,
        collectors: Vec<Box<dyn Collector>>,
        learner: Option<Learner>,
        seed: u64,
    ) -> Result<Self, LearningError> {
        config.check()?;
        let spec = collectors[0].spec().clone();
        let mut modes = collectors.iter().map(|collector| collector.autoreset());
        if let Some(given) = modes.find(|mode| *mode != AutoresetMode::SameStep) {
            return Err(LearningError::Autoreset { given });
        }
        let mirrors = if config.symmetry {
            Some(Mirrors { features: Mirror::of_observations(&spec)?, actions: Mirror::of_actions(&spec)? })
        } else {
            None
        };
        let is_given = learner.is_some();
        let learner = learner.unwrap_or_else(|| Learner::new(&config, &spec, seed));
        learner.check_layout(&spec)?;
        // A continued training has other episodes than those that it has seen.
        let env_seed = seed.wrapping_add(learner.iteration);
        let mut first_robot = 0;
        let mut groups = Vec::new();
        for collector in collectors {
            let num_envs = collector.num_envs();
            groups.push(Group::new(collector, &learner.critic, config.horizon, env_seed, first_robot)?);
            first_robot += num_envs;
        }
        if is_given {
            let (policy, count) = (learner.behaviour_policy(spec.obs_len()), groups.len());
            let part = |group: usize| spec.max_episode_steps as usize * group / count;
            let noise_seed = noise_seed(seed, learner.iteration);
            let groups = groups.par_iter_mut().enumerate();
            groups.try_for_each(|(index, group)| group.advance(&policy, noise_seed, part(index)))?;
        }
        let networks = [Network::new(&learner.actor), Network::new(&learner.critic)];
        let task = GradientTask::new(&learner.actor, &learner.critic);
        Ok(Self { config, spec, seed, groups, mirrors, networks, task, learner, samples: Vec::new() })
    }

    /// Returns the spec of the environments.
    pub fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    /// Returns what is learnt.
    pub fn learner(&self) -> &Learner {
        &self.learner
    }

    /// Collects one rollout and updates the policy with it.
    ///
    /// After an error the learner is that of the last complete iteration.
    pub fn iterate(&mut self) -> Result<Iteration, LearningError> {
        let start = Instant::now();
        let statistics = self.collect()?;
        let rollout_time = start.elapsed();
        let before = self.learner.clone();
        let losses = self.update().inspect_err(|_| self.learner = before)?;
        let mean = self.learner.mean_actor.parameters.iter_mut().zip(&self.learner.actor.parameters);
        mean.for_each(|(mean, value)| *mean = MEAN_DECAY * *mean + (1.0 - MEAN_DECAY) * value);
        let samples = (self.config.epochs * self.samples.len()) as f64;
        self.learner.iteration += 1;
        self.learner.env_steps += statistics.steps;
        let stds = self.learner.log_std.iter().map(|log_std| log_std.exp());
        Ok(Iteration {
            iteration: self.learner.iteration,
            env_steps: self.learner.env_steps,
            surrogate: losses.surrogate / samples,
            value_loss: losses.value / samples,
            kl: losses.mean_kl(),
            clipped_share: losses.clipped as f64 / samples,
            learning_rate: self.learner.learning_rate,
            action_std: stds.sum::<f32>() / self.learner.log_std.len() as f32,
            statistics,
            rollout_time,
            update_time: start.elapsed().saturating_sub(rollout_time),
        })
    }

    fn collect(&mut self) -> Result<Statistics, LearningError> {
        let Self { groups, learner, networks, config, .. } = self;
        let behaviour = Behaviour {
            policy: &learner.behaviour_policy(self.spec.obs_len()),
            noise_seed: noise_seed(self.seed, learner.iteration),
            critic: &networks[1],
            normaliser: &learner.normaliser,
            discounts: config.discounts(),
        };
        let since = Instant::now();
        loop {
            groups.iter_mut().try_for_each(|group| group.send(&behaviour))?;
            groups.par_iter_mut().try_for_each(|group| group.collect(&behaviour))?;
            if groups.iter().any(|group| group.statistics.steps > 0) {
                break;
            }
            let waited = since.elapsed();
            if waited > MAX_ENV_LOSS {
                return Err(LearningError::NoEnvs { waited_s: waited.as_secs_f64() });
            }
            std::thread::sleep(RETRY_PERIOD);
        }
        let mut statistics = Statistics::new(&self.spec);
        for group in &self.groups {
            self.learner.normaliser.merge(&group.moments);
            statistics.merge(&group.statistics);
        }
        if let Some(mirrors) = &self.mirrors {
            let Normaliser { count, mut mean, mut variance, .. } = self.learner.normaliser.clone();
            mirrors.features.symmetrise(&mut mean, &mut variance);
            self.learner.normaliser = Normaliser::from_moments(count, mean, variance);
        }
        Ok(statistics)
    }

    fn update(&mut self) -> Result<LossSums, LearningError> {
        let segments: Vec<_> = self.groups.iter().map(|group| &group.segment).collect();
        let batch = Batch {
            advantage_moments: moments(segments.iter().flat_map(|segment| &segment.advantages)),
            segments: &segments,
            obs_len: self.spec.obs_len(),
            feature_len: feature_len(&self.spec),
            mirrors: self.mirrors.as_ref(),
        };
        let Self { config, learner, networks, task, samples, .. } = self;
        samples.clear();
        for (group, segment) in segments.iter().enumerate() {
            let indices = 0..segment.values.len() as u32;
            // Every second sample is mirrored in the first pass, the others in the second.
            let is_mirrored = |index: u32| config.symmetry && index % 2 == 1;
            let sample = |index| Sample { group: group as u32, index, is_mirrored: is_mirrored(index) };
            samples.extend(indices.map(sample));
        }
        let mut random = stream(self.seed, "minibatches", learner.iteration);
        let mut losses = LossSums::default();
        for _ in 0..config.epochs {
            samples.shuffle(&mut random);
            for minibatch in samples.chunks(samples.len().div_ceil(config.minibatches)) {
                let [actor, critic] = networks;
                let parameters = Parameters { actor, critic, log_std: &learner.log_std };
                let sums = task.run(&batch, minibatch, &parameters, config);
                adapt_learning_rate(learner, sums.mean_kl(), config);
                let is_finite = apply(learner, task, minibatch.len(), config);
                networks[0].update(&learner.actor);
                networks[1].update(&learner.critic);
                if !is_finite {
                    return Err(LearningError::NotFinite { iteration: learner.iteration + 1 });
                }
                losses.add(&sums);
            }
            for sample in samples.iter_mut() {
                sample.is_mirrored ^= config.symmetry;
            }
        }
        Ok(losses)
    }
}

/// Moves the parameters against the mean gradient. Returns false if a parameter is not finite afterwards.
fn apply(learner: &mut Learner, task: &GradientTask, samples: usize, config: &PpoConfig) -> bool {
    let norm = task.gradient.norm() / samples as f64;
    let clip = (f64::from(config.max_gradient_norm) / (norm + 1e-6)).min(1.0);
    let (scale, rate) = ((clip / samples as f64) as f32, learner.learning_rate);
    let [actor, critic, log_std] = &mut learner.optimisers;
    actor.step(&mut learner.actor.parameters, &task.gradient.actor, scale, rate);
    critic.step(&mut learner.critic.parameters, &task.gradient.critic, scale, rate);
    log_std.step(&mut learner.log_std, &task.gradient.log_std, scale, rate);
    norm.is_finite() && learner.is_finite()
}

/// Adapts the learning rate to the divergence of the last minibatch (Schulman's rule, as in rsl_rl).
///
/// The first minibatch of an update has no divergence, which says nothing about the rate.
fn adapt_learning_rate(learner: &mut Learner, kl: f64, config: &PpoConfig) {
    let progress = learner.env_steps as f64 / config.total_steps as f64;
    let decay = ((progress - DECAY_START) / (1.0 - DECAY_START)).clamp(0.0, 1.0);
    let target = f64::from(config.target_kl) * (1.0 - decay * (1.0 - FINAL_KL_SHARE));
    let learning_rate = &mut learner.learning_rate;
    if target == 0.0 {
        return;
    }
    if kl > 2.0 * target {
        *learning_rate = (*learning_rate / LEARNING_RATE_FACTOR).max(MIN_LEARNING_RATE);
    } else if kl > 0.0 && kl < 0.5 * target {
        *learning_rate = (*learning_rate * LEARNING_RATE_FACTOR).min(config.max_learning_rate);
    }
}

/// Returns mean and standard deviation, at least 1e-8.
fn moments<'a>(values: impl Iterator<Item = &'a f32> + Clone) -> [f32; 2] {
    let count = values.clone().count() as f64;
    let mean = values.clone().map(|value| f64::from(*value)).sum::<f64>() / count;
    let variance = values.map(|value| (f64::from(*value) - mean).powi(2)).sum::<f64>() / count;
    [mean as f32, variance.sqrt().max(1e-8) as f32]
}
