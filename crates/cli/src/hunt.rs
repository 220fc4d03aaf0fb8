//! `twinstep hunt`: a blind test of diagnosis.

use std::path::{Path, PathBuf};
use std::process::Command;

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_hunt::{HuntConfig, HuntError, hunt};

use crate::exit::{CommandResult, Failure, Signals, input, other};

/// Hide effects in simulated robots, let `twinstep diagnose` look for them, and judge what it says.
///
/// Every case is drawn from the seed and its number: two sevenths hide nothing, a seventh hides two effects, a seventh
/// something that the catalogue does not have, the rest one effect, half of them at a fifth of its plausible range and
/// half from one half to all of it. The robot runs in rapier at 4 kHz with masses off by up to 1 % and lengths by up to
/// 2 mm; sensors have noise. The diagnosis is another process: it sees the log and the model of the ideal Go2.
///
/// Prints a table of rates with their 95 % intervals (Wilson) and which name was given for which effect, and writes it to
/// OUT/hunt.md. OUT/cases.jsonl has a line a case as soon as it is judged; the same command with --resume goes on from
/// there, also with more cases. OUT/<case> keeps the case's log, what the diagnosis said of it, and truth.toml.
///
/// Keep the seeds that you develop with and those that you report apart.
///
/// Example: `twinstep hunt --cases 28 --seed 1 --out hunt-1`
#[derive(clap::Args)]
pub struct Args {
    /// Number of cases; multiples of 28 have the mix of kinds exactly.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    cases: u64,
    /// Seed of the game.
    #[arg(long, value_name = "S")]
    seed: u64,
    /// Folder of the results.
    #[arg(long, value_name = "DIR", default_value = "twinstep-hunt")]
    out: PathBuf,
    /// Go on with the game in OUT.
    #[arg(long)]
    resume: bool,
}

/// Runs all cases and prints the table.
pub fn run(args: &Args) -> CommandResult {
    let program = std::env::current_exe().map_err(other)?;
    let diagnose = move |log: &Path, model: &Path, out: &Path| {
        let mut command = Command::new(&program);
        command.arg("diagnose").arg(log).arg("--model").arg(model).arg("--out").arg(out).arg("--json");
        command
    };
    let signals = Signals::listen()?;
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} cases, {per_sec}, ETA {eta}  {msg}");
    let bar = ProgressBar::new(args.cases).with_style(style.expect("a template"));
    let config = HuntConfig { cases: args.cases, seed: args.seed, out: args.out.clone(), resume: args.resume };
    let interrupted = || signals.check().unwrap_or(true);
    let table = hunt(&config, &diagnose, &interrupted, &mut |cases| bar.set_position(cases));
    bar.finish_and_clear();
    print!("{}", table.map_err(failure)?);
    Ok(())
}

fn failure(error: HuntError) -> Failure {
    match error {
        HuntError::Interrupted => Failure::Interrupted,
        error @ (HuntError::Failed(_) | HuntError::NoDiagnosis { .. }) => other(error),
        error => input(error),
    }
}
