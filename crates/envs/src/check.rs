//! A checker for vector environments, local or remote, similar to Gymnasium's `check_env`.

use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, SpecField, StepBatch, VecEnv};

/// Seed of the checker's resets and actions.
const SEED: u64 = 1234;

/// Violations of the contract of a vector environment.
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    /// A valid call failed.
    #[error("{doing} failed: {source}")]
    Failed {
        /// The call.
        doing: &'static str,
        /// Error of the environment.
        source: EnvError,
    },
    /// The environment violates the contract.
    #[error("{0}")]
    ContractViolation(String),
}

/// Checks the contract of `env` in two runs of `steps` steps with the same seed.
///
/// The contract: shapes, finite observations within the bounds of the spec, equal results for equal seeds, episodes
/// that end and start as the autoreset mode specifies, and rejection of invalid input without effect.
///
/// The environment must be deterministic. An episode is in progress afterwards.
pub fn check_vec_env(env: &mut dyn VecEnv, steps: usize) -> Result<(), CheckError> {
    let first = rollout(env, steps)?;
    let second = rollout(env, steps)?;
    if let Some(step) = first.iter().zip(&second).position(|(one, two)| one != two) {
        return Err(CheckError::ContractViolation(format!(
            "equal seeds and actions gave different results in step {step}"
        )));
    }
    check_rejections(env)
}

fn rollout(env: &mut dyn VecEnv, steps: usize) -> Result<Vec<StepBatch>, CheckError> {
    let (num_envs, action_len) = (env.num_envs(), env.spec().action_len());
    let spec = env.spec().clone();
    let failed = |doing| move |source| CheckError::Failed { doing, source };
    let obs = env.reset(&ResetRequest::seeded(SEED, num_envs)).map_err(failed("reset with seeds"))?.to_vec();
    check_observations(&obs, env.critic_obs(), &spec, num_envs)?;
    let mut batches: Vec<StepBatch> = Vec::with_capacity(steps);
    let mut lengths = vec![0u32; num_envs];
    for step in 0..steps {
        let actions: Vec<f32> = (0..num_envs * action_len).map(|index| test_action(step, index)).collect();
        let waiting: Vec<bool> = (0..num_envs).map(|env| batches.last().is_some_and(|last| last.done(env))).collect();
        if env.autoreset() == AutoresetMode::Disabled && waiting.contains(&true) {
            env.reset(&ResetRequest::masked(waiting.clone())).map_err(failed("reset with a mask"))?;
        }
        let restarts = env.autoreset() == AutoresetMode::NextStep;
        let batch = env.step(&actions).map_err(failed("step"))?.clone();
        check_observations(&batch.obs, &batch.critic_obs, &spec, num_envs)?;
        for env in 0..num_envs {
            if restarts && waiting[env] && (batch.reward[env] != 0.0 || batch.done(env)) {
                let what =
                    "NextStep: the step that resets an environment must have reward 0 and must not end the episode";
                return Err(CheckError::ContractViolation(format!("{what}; environment {env}, step {step}")));
            }
            lengths[env] = if restarts && waiting[env] { 0 } else { lengths[env] + 1 };
        }
        check_ended(&batch, &mut lengths, env, step)?;
        batches.push(batch);
    }
    Ok(batches)
}

/// Returns a deterministic action in [−0.3, 0.3], different for every step and entry.
fn test_action(step: usize, index: usize) -> f32 {
    0.3 * ((step * 31 + index * 17) as f32).sin()
}

/// Checks lengths and bounds of both observation groups.
fn check_observations(obs: &[f32], critic_obs: &[f32], spec: &EnvSpec, num_envs: usize) -> Result<(), CheckError> {
    for (field, values, layout) in
        [("obs", obs, &spec.observation), ("critic_obs", critic_obs, &spec.critic_observation)]
    {
        let names: Vec<(&SpecField, usize)> =
            layout.iter().flat_map(|field| (0..field.size).map(move |index| (field, index))).collect();
        let expected = num_envs * names.len();
        if values.len() != expected {
            let text = format!("`{field}` has {} entries; {expected} are expected", values.len());
            return Err(CheckError::ContractViolation(text));
        }
        for (index, value) in values.iter().enumerate() {
            let (field, entry) = names[index % names.len()];
            if !(field.low..=field.high).contains(value) {
                let (env, SpecField { name, low, high, .. }) = (index / names.len(), field);
                let text = format!("{name}[{entry}] of environment {env} is {value}, outside {low}..{high}");
                return Err(CheckError::ContractViolation(text));
            }
        }
    }
    Ok(())
}

fn check_ended(batch: &StepBatch, lengths: &mut [u32], env: &dyn VecEnv, step: usize) -> Result<(), CheckError> {
    let spec = env.spec();
    let violation = |text: String| Err(CheckError::ContractViolation(format!("{text}, in step {step}")));
    let done = (0..lengths.len()).filter(|env| batch.done(*env)).count();
    if batch.ended.len() != done {
        return violation(format!("{done} environments are done, but {} ended episodes are listed", batch.ended.len()));
    }
    let same_step = env.autoreset() == AutoresetMode::SameStep;
    let final_len = if same_step { [spec.obs_len(), spec.critic_obs_len()] } else { [0, 0] };
    for episode in &batch.ended {
        let index = episode.env;
        if !batch.done(index) || episode.length != lengths[index] || episode.length > spec.max_episode_steps {
            return violation(format!(
                "the ended episode of environment {index} has length {}, but {} steps were executed",
                episode.length, lengths[index]
            ));
        }
        if batch.truncated[index] && !episode.diverged && episode.length != spec.max_episode_steps {
            return violation(format!("environment {index} was truncated after {} steps", episode.length));
        }
        let given = [episode.final_obs.len(), episode.final_critic_obs.len()];
        if given != final_len || episode.terms.len() != spec.reward_terms.len() {
            return violation(format!(
                "`terms`, `final_obs` or `final_critic_obs` of the ended episode of environment {index} has the wrong length"
            ));
        }
        lengths[index] = 0;
    }
    Ok(())
}

fn check_rejections(env: &mut dyn VecEnv) -> Result<(), CheckError> {
    let num_actions = env.num_envs() * env.spec().action_len();
    let mut with_nan = vec![0.0; num_actions];
    with_nan[num_actions - 1] = f32::NAN;
    for (actions, what) in
        [(vec![0.0; num_actions + 1], "a wrong number of actions"), (with_nan, "an action that is NaN")]
    {
        if env.step(&actions).is_ok() {
            return Err(CheckError::ContractViolation(format!("{what} was accepted")));
        }
    }
    let short = ResetRequest { seeds: Some(vec![0; env.num_envs() + 1]), mask: None };
    if env.reset(&short).is_ok() {
        return Err(CheckError::ContractViolation("a wrong number of seeds was accepted".to_owned()));
    }
    env.reset(&ResetRequest::seeded(SEED, env.num_envs()))
        .map_err(|source| CheckError::Failed { doing: "reset after rejected calls", source })?;
    Ok(())
}
