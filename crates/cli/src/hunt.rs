//! `twinstep hunt`: a blind test of diagnosis.

use std::path::{Path, PathBuf};
use std::process::Command;

use indicatif::ProgressBar;
use twinstep_hunt::{HuntConfig, HuntError, Plant, Suite, hunt};
use twinstep_workflows::progress_lines;

use crate::exit::{CommandResult, Failure, Signals, input, other};

/// Run a blind test of `twinstep diagnose` on simulated robots with hidden effects.
///
/// Each case is sampled from the seed and its number. Two sevenths of the cases hide no effect, one seventh two effects
/// and one seventh an effect outside the catalogue. The other cases hide one effect: half of them at a fifth of its
/// prior range, half from one half to all of the range. The robot's masses have errors of up to 1 %, its leg mounts of up
/// to 2 mm, and its sensors have noise. The diagnosis runs in another process, which receives only the log and the model
/// of the ideal Go2.
///
/// --suite selects other cases: healthy robots with eight families of errors, in logs of three lengths; walking robots
/// without motion capture, with a payload of a tenth of the trunk's mass, Coulomb friction or a delay; effects with
/// confounders in logs without torques; effects outside the catalogue.
///
/// With --plant mujoco the robot runs in MuJoCo, with actuators by equations of their own. It hangs, stands, sways, trots
/// and hops for a minute. Of 24 cases, 10 hide one effect of half its range or more, 6 one of a fifth, 4 four effects, and 4
/// an effect outside the catalogue. Set TWINSTEP_PYTHON to a Python interpreter with the packages twinstep and mujoco.
///
/// A hidden effect is evident if its true law, refitted with everything else known, gains at least 10 nat on the log. Others
/// are listed below the tables, and left out of the rates of names and scopes. A case of several effects is left out of "all
/// reported" if one of them is not evident.
///
/// Prints a table of rates with 95 % intervals (Wilson) and the confusion matrix, and writes both to OUT/hunt.md. Each
/// case is scored and appended to OUT/cases.jsonl as soon as it is complete. The same command with --resume continues
/// from there, also with more cases. OUT/<case> has the log, the diagnosis, and the ground truth in truth.toml.
///
/// Use different seeds for development and for reported results.
///
/// Example: `twinstep hunt --cases 28 --seed 1 --out hunt-1`
#[derive(clap::Args)]
pub struct Args {
    /// Number of cases. Multiples of 28, or of 24 in MuJoCo, have exactly the mix above.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    cases: u64,
    /// Simulation that takes the place of the robot.
    #[arg(long, value_enum, default_value_t = PlantName::Rapier)]
    plant: PlantName,
    /// What the cases hide.
    #[arg(long, value_enum, default_value_t = SuiteName::Mixed)]
    suite: SuiteName,
    /// Seed of the cases.
    #[arg(long, value_name = "S")]
    seed: u64,
    /// Folder to write.
    #[arg(long, value_name = "DIR", default_value = "twinstep-hunt")]
    out: PathBuf,
    /// Continue the blind test in OUT.
    #[arg(long)]
    resume: bool,
}

/// Value of `--plant`.
#[derive(Clone, Copy, clap::ValueEnum)]
enum PlantName {
    /// rapier at 4 kHz, logs of 20 to 25 s.
    Rapier,
    /// MuJoCo at 2 kHz, logs of a minute.
    Mujoco,
}

/// Value of `--suite`.
#[derive(Clone, Copy, clap::ValueEnum)]
enum SuiteName {
    /// One effect, several, one outside the catalogue, or none.
    Mixed,
    /// Nothing; multiples of 72 cases have all families and lengths.
    Healthy,
    /// One effect of a walking robot without motion capture; multiples of 3 cases have all effects.
    Walking,
    /// One effect with confounders, positions only.
    Confusable,
    /// One effect outside the catalogue.
    Unmodelled,
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
    let style = progress_lines::style("{bar:30} {pos}/{len} cases, {per_sec}, ETA {eta}  {msg}");
    let bar = ProgressBar::with_draw_target(Some(args.cases), progress_lines::target()).with_style(style);
    let plant = match args.plant {
        PlantName::Rapier => Plant::Rapier,
        PlantName::Mujoco => Plant::Mujoco,
    };
    let suite = match args.suite {
        SuiteName::Mixed => Suite::Mixed,
        SuiteName::Healthy => Suite::Healthy,
        SuiteName::Walking => Suite::Walking,
        SuiteName::Confusable => Suite::Confusable,
        SuiteName::Unmodelled => Suite::Unmodelled,
    };
    let (cases, seed, out, resume) = (args.cases, args.seed, args.out.clone(), args.resume);
    let config = HuntConfig { plant, suite, cases, seed, out, resume };
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
