//! `twinstep adapt`: a policy for the robot of a log, and its gain.

use std::path::PathBuf;

use twinstep_workflows::{AdaptOptions, Adapted, Comparison, Observer, adapt};

use crate::exit::{CommandResult, other};

/// Adapt a policy to the robot of a log: cause, corrected model, fine-tuned policy, gain.
///
/// Diagnoses the logs, fine-tunes the policy on the corrected model, whose parameters are drawn from
/// their intervals, and predicts the gain in the policy's task: the error of both policies on robots of
/// the corrected model. With --endpoint both policies then run on the robot, one after the other with
/// the same commands, and the gain is measured. DIR receives:
///
///   diagnosis            findings, report and corrected model, as of `twinstep diagnose`
///   training             the fine-tuning, as of `twinstep train`
///   tuned.safetensors    the fine-tuned policy
///   policy.safetensors   the better one of the two policies: on the robot, or else on the model
///   adapt.json           causes, errors before and after: predicted and found
///
/// The error is, by task: `walk` and `gait`, the velocity error from 1 s after each new command;
/// `track`, the distance from the path; `jump`, the distance of the landing from the target;
/// `attitude`, the errors of roll and pitch. Of `track` and `jump` the gain is predicted only.
///
/// The same command continues after Ctrl-C. For a measured gain a real robot must know its velocity;
/// where it does not, compare two logs of `twinstep run`.
///
/// Example: `twinstep adapt data/policies/walk.safetensors hanging walking --out adapted --endpoint
/// tcp/127.0.0.1:7447`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Args {
    /// Policy file (safetensors).
    policy: PathBuf,
    /// Logs of the robot: data files, or folders that contain one.
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// Model file of the robot that the policy was trained on. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Zenoh endpoint of the robot, on which both policies are compared. Default: the gain is predicted only.
    #[arg(long, value_name = "ENDPOINT")]
    endpoint: Option<String>,
    /// Environment steps of the fine-tuning.
    #[arg(long, value_name = "N", default_value_t = 12_000_000)]
    steps: u64,
    /// Number of simulated robots on which the policies are compared.
    #[arg(long, value_name = "N", default_value_t = 24)]
    robots: usize,
    /// Number of runs of the robot at the endpoint with each policy.
    #[arg(long, value_name = "N", default_value_t = 2)]
    runs: usize,
    /// Duration of a run [s]. A jump takes 3 s.
    #[arg(long, value_name = "S", default_value_t = 20.0)]
    seconds: f64,
    /// Seed of the fine-tuning and of the runs.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder to write.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print adapt.json to stdout, and nothing else.
    #[arg(long)]
    json: bool,
}

/// Adapts the policy and prints its gain.
pub fn run(args: &Args) -> CommandResult {
    let adapted = adapt(&args.options(), &Observer::terminal()?)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&adapted).map_err(other)?);
    } else {
        print!("{}", text(&adapted));
        println!("written to {}", args.out.join("policy.safetensors").display());
    }
    Ok(())
}

impl Args {
    fn options(&self) -> AdaptOptions {
        AdaptOptions {
            model: self.model.clone(),
            endpoint: self.endpoint.clone(),
            steps: self.steps,
            robots: self.robots,
            runs: self.runs,
            seconds: self.seconds,
            seed: self.seed,
            ..AdaptOptions::new(&self.policy, self.logs.clone(), &self.out)
        }
    }
}

/// Returns the summary.
fn text(adapted: &Adapted) -> String {
    let Adapted { causes, error, unit, predicted, found, is_adapted } = adapted;
    let causes = if causes.is_empty() { "no cause identified".to_owned() } else { causes.join(", ") };
    let line = |name: &str, Comparison { mean: [before, after], reduction, falls, .. }: &Comparison| {
        let [fell_before, fell_after] = falls;
        let share = 100.0 * reduction;
        format!(
            "{name:<10} {before:>7.3} -> {after:.3} {unit}, {share:.0} % less; falls {fell_before} -> {fell_after}\n"
        )
    };
    let [low, high] = predicted.interval.map(|share| 100.0 * share);
    let range = format!("{:<10} {low:.0} to {high:.0} % for 90 % of the robots\n", "");
    let found = found.as_ref().map_or_else(String::new, |found| line("found", found));
    let kept = if *is_adapted {
        "the fine-tuned policy is kept"
    } else {
        "the policy as it was is kept: the new one is not better"
    };
    format!("{causes}\n{error}:\n{}{range}{found}{kept}\n", line("predicted", predicted))
}
