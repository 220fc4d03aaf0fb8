//! Training of a policy by proximal policy optimisation.

use std::path::PathBuf;
use std::time::Instant;

use twinstep_policy::Policy;

use crate::failure::{Failure, other};
use crate::observer::Observer;
use crate::train_config::TrainConfig;
use crate::train_evaluation;
use crate::train_options::{TrainOptions, folder_error};
use crate::train_session::TrainSession;

/// Result of [`train`].
pub struct Trained {
    /// The policy.
    pub policy: Policy,
    /// Settings of the training.
    pub config: TrainConfig,
    /// Folder of the training.
    pub out: PathBuf,
    /// Servers whose robots it was trained on.
    pub endpoints: Vec<String>,
    /// Number of environment steps, also of those before it was resumed.
    pub env_steps: u64,
    /// Duration [s].
    pub seconds: f64,
}

/// Trains a policy, and writes it to the folder of the options with everything that is needed to continue.
///
/// An interrupted training is saved and returns [`Failure::Interrupted`].
///
/// ```no_run
/// use twinstep_workflows::{Observer, TrainConfig, TrainOptions, train};
///
/// let options = TrainOptions::new("walk", TrainConfig::default(), 1);
/// let trained = train(&options, &Observer::silent())?;
/// println!("{} steps in {:.0} s", trained.env_steps, trained.seconds);
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn train(options: &TrainOptions, observer: &Observer) -> Result<Trained, Failure> {
    let start = Instant::now();
    options.check()?;
    let started = options.started()?;
    let out = &options.out;
    std::fs::create_dir_all(out).map_err(|cause| folder_error(out, cause))?;
    twinstep_files::write(out.join("config.toml"), &started.text).map_err(|cause| folder_error(out, cause))?;
    let mut session = TrainSession::new(options, started)?;
    let ended = session.train(observer, start);
    let saved = session.save();
    if ended.is_ok() {
        saved?;
    } else if let Err(Failure::Other(report) | Failure::Input(report)) = saved {
        observer.note(format_args!("error: the checkpoint is not saved: {report}"));
    }
    match ended {
        Ok(()) => {
            // The trainer is dropped, so that robots of servers are free for an evaluation.
            let (policy, config, env_steps) = session.ended();
            let (endpoints, seconds) = (options.endpoints.clone(), start.elapsed().as_secs_f64());
            Ok(Trained { policy, config, out: out.clone(), endpoints, env_steps, seconds })
        }
        Err(Failure::Interrupted) => {
            observer.note(format_args!("interrupted; continue with: twinstep train --out {} --resume", out.display()));
            Err(Failure::Interrupted)
        }
        Err(failure) => {
            observer.note(format_args!("the policy before the failure is in {}", out.display()));
            Err(failure)
        }
    }
}

impl Trained {
    /// Fails with [`Failure::Interrupted`] if steps are left.
    pub fn complete(self) -> Result<Self, Failure> {
        if self.env_steps >= self.config.train.total_steps { Ok(self) } else { Err(Failure::Interrupted) }
    }

    /// Evaluates the policy on fresh robots. Writes `evaluation.json` to the folder, and returns it with a table.
    pub fn evaluate(&self, observer: &Observer) -> Result<(String, String), Failure> {
        let (json, table) = train_evaluation::evaluate_trained(&self.policy, &self.config, &self.endpoints, observer)?;
        twinstep_files::write(self.out.join("evaluation.json"), &json).map_err(other)?;
        Ok((json, table))
    }
}
