//! `twinstep hunt`: hide effects, diagnose, judge.

mod draw;
mod game;
mod judge;
mod motion;
mod outside;
mod plant;
mod table;

use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};
use twinstep_model::go2;
use twinstep_sysid::RmsErrors;

use crate::evaluate::simulator;
use crate::exit::{Failure, CommandResult, Signals, input, other};
use draw::{Case, CaseKind, LogSetup};
use game::BlindTest;
use judge::Score;
use outside::UnmodelledEffect;

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

/// A line of `cases.jsonl`: a case and what came of it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct CaseResult {
    /// Of the game.
    seed: u64,
    /// Of the case.
    case: u64,
    kind: CaseKind,
    setting: LogSetup,
    outside: Option<UnmodelledEffect>,
    /// Errors on the log of the model that the diagnosis was given.
    nominal: RmsErrors,
    /// Errors on the log of the true effects in our own model.
    truth: RmsErrors,
    verdict: Score,
    /// What the diagnosis complained of, if it gave no answer.
    error: Option<String>,
    /// Time of the diagnosis [s].
    seconds: f64,
}

/// Why a game cannot be played.
#[derive(Debug, thiserror::Error)]
enum HuntError {
    #[error("{} has a game already\n  --resume goes on with it; or name another --out", .0.display())]
    Played(PathBuf),
    #[error("{}:{line}: {cause}", path.display())]
    Line { path: PathBuf, line: usize, cause: serde_json::Error },
    #[error("{} is the game of seed {theirs}, not {ours}\n  name another --out", path.display())]
    OtherSeed { path: PathBuf, theirs: u64, ours: u64 },
    #[error("{}: {cause}", path.display())]
    File { path: PathBuf, cause: std::io::Error },
    #[error("the diagnosis of {} does not start: {said}", log.display())]
    NoDiagnosis { log: PathBuf, said: String },
}

/// An error of this file.
fn at(path: &Path) -> impl FnOnce(std::io::Error) -> Failure {
    let path = path.to_owned();
    move |cause| input(HuntError::File { path, cause })
}

/// Plays all cases and prints the table.
pub fn run(args: &Args) -> CommandResult {
    let program = std::env::current_exe().map_err(other)?;
    let diagnose = move |log: &Path, model: &Path, out: &Path| {
        let mut command = Command::new(&program);
        command.arg("diagnose").arg(log).arg("--model").arg(model).arg("--out").arg(out).arg("--json");
        command
    };
    print!("{}", play(args, &diagnose)?);
    Ok(())
}

/// A command that diagnoses the first path, a log, with the second, a model, and may write to the third, a folder.
type Diagnose = dyn Fn(&Path, &Path, &Path) -> Command;

/// Plays all cases with a diagnosing program, and returns the table.
fn play(args: &Args, diagnose: &Diagnose) -> Result<String, Failure> {
    let ledger = args.out.join("cases.jsonl");
    let mut rounds = if args.resume { played(&ledger, args.seed).map_err(input)? } else { Vec::new() };
    if !args.resume && ledger.metadata().is_ok_and(|file| file.len() > 0) {
        return Err(input(HuntError::Played(args.out.clone())));
    }
    std::fs::create_dir_all(&args.out).map_err(at(&args.out))?;
    let mut lines = OpenOptions::new().append(true).create(true).open(&ledger).map_err(at(&ledger))?;
    let mut game = BlindTest { out: &args.out, diagnose, signals: Signals::listen()?, simulator: simulator(&go2())? };
    let bar = progress_bar(args.cases);
    for number in 0..args.cases {
        if !rounds.iter().any(|round| round.case == number) {
            let round = game.run_case(&Case::draw(args.seed, number))?;
            let line = serde_json::to_string(&round).map_err(other)?;
            writeln!(lines, "{line}").map_err(at(&ledger))?;
            rounds.push(round);
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    rounds.retain(|round| round.case < args.cases);
    let text = table::text(&rounds);
    let report = args.out.join("hunt.md");
    std::fs::write(&report, &text).map_err(at(&report))?;
    Ok(text)
}

fn progress_bar(cases: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} cases, {per_sec}, ETA {eta}  {msg}");
    ProgressBar::new(cases).with_style(style.expect("a template"))
}

/// The cases that were judged before.
fn played(ledger: &Path, seed: u64) -> Result<Vec<CaseResult>, HuntError> {
    let path = || ledger.to_owned();
    let text = std::fs::read_to_string(ledger).map_err(|cause| HuntError::File { path: path(), cause })?;
    let round = |(index, line): (usize, &str)| {
        let round: CaseResult =
            serde_json::from_str(line).map_err(|cause| HuntError::Line { path: path(), line: index + 1, cause })?;
        if round.seed == seed {
            Ok(round)
        } else {
            Err(HuntError::OtherSeed { path: path(), theirs: round.seed, ours: seed })
        }
    };
    text.lines().enumerate().map(round).collect()
}

#[cfg(test)]
mod tests {
    use super::draw::BaseSchedule;
    use super::*;

    /// Finds nothing, and notes what it was given.
    fn nothing(log: &Path, model: &Path, out: &Path) -> Command {
        assert!(log.join("meta.json").exists() && model.exists());
        assert!(!out.with_file_name("truth.toml").exists(), "the truth is not told");
        let errors = r#"{"torque_rmse_nm": null, "q_rmse_rad": 0.01}"#;
        let unexplained = r#"{"fraction": 0.0, "depends_on": [], "text": ""}"#;
        let said = format!(
            r#"{{"baseline": {errors}, "extended": {errors}, "noise_floor": {errors}, "findings": [], "confusable": [],
                 "unexplained": {unexplained}, "extended_model": "extended.toml"}}"#
        );
        let mut command = Command::new("echo");
        command.arg(said);
        command
    }

    fn args(cases: u64, seed: u64, out: &Path, resume: bool) -> Args {
        Args { cases, seed, out: out.to_owned(), resume }
    }

    fn complaint(outcome: Result<String, Failure>) -> String {
        match outcome {
            Err(Failure::Input(report) | Failure::Other(report)) => report.to_string(),
            other => format!("{other:?}"),
        }
    }

    #[test]
    fn game_goes_on_where_it_ended_and_is_not_overwritten() {
        let folder = tempfile::tempdir().expect("a folder");
        let out = folder.path().join("game");
        play(&args(1, 4, &out, false), &nothing).expect("played");
        assert!(complaint(play(&args(2, 4, &out, false), &nothing)).contains("has a game already"));
        assert!(complaint(play(&args(2, 5, &out, true), &nothing)).contains("is the game of seed 4, not 5"));
        let dies = |_: &Path, _: &Path, _: &Path| {
            let mut command = Command::new("sh");
            command.args(["-c", "echo it broke >&2; exit 1"]);
            command
        };
        let text = play(&args(2, 4, &out, true), &dies).expect("a diagnosis that dies does not end the game");
        assert!(text.contains("| the diagnosis died | none | 1 of 2: 50 % |"), "{text}");
        let rounds = played(&out.join("cases.jsonl"), 4).expect("lines");
        assert_eq!(rounds.iter().map(|round| round.case).collect::<Vec<_>>(), [0, 1]);
        assert!(rounds[1].error.as_ref().is_some_and(|died| died.contains("it broke")));
        assert!(out.join("hunt.md").exists() && out.join("0000/truth.toml").exists());
    }

    /// What the table of needs in `draw.rs` promises, and what hides nothing is all but perfect.
    #[test]
    #[ignore = "minutes: plays 28 cases"]
    fn what_is_hidden_shows_in_the_log_and_the_truth_explains_it() {
        let folder = tempfile::tempdir().expect("a folder");
        play(&args(28, 100, folder.path(), false), &nothing).expect("played");
        let rounds = played(&folder.path().join("cases.jsonl"), 100).expect("lines");
        for CaseResult { case, kind, setting, outside, nominal, truth, verdict, .. } in &rounds {
            let hidden: Vec<_> = verdict.hits.iter().map(|hit| format!("{}@{}", hit.effect, hit.scope)).collect();
            println!("{case} {kind:?} {:?} {hidden:?} {outside:?} {nominal:?} {truth:?}", setting.place);
        }
        for CaseResult { case, kind, setting, nominal, truth, verdict, .. } in rounds {
            let [before, after] = [nominal, truth].map(|errors| errors.q_rmse_rad.expect("q is in every log"));
            // What no error of motion can show.
            let unseen = verdict.hits.iter().any(|hit| ["gyro_bias", "torque_sensor_delay"].contains(&&*hit.effect));
            match kind {
                CaseKind::Healthy if setting.place == BaseSchedule::Fixed => assert!(before < 0.003, "case {case}: {before} rad"),
                CaseKind::Healthy => assert!(before < 0.012, "case {case}: {before} rad"),
                CaseKind::LargeEffect | CaseKind::TwoEffects => assert!(unseen || after < before, "case {case}: {before} -> {after} rad"),
                CaseKind::SmallEffect | CaseKind::UnmodelledEffect => {}
            }
        }
    }

    #[test]
    fn game_without_a_diagnosis_ends_at_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let refuses = |_: &Path, _: &Path, _: &Path| {
            let mut command = Command::new("sh");
            command.args(["-c", "echo no such verb >&2; exit 2"]);
            command
        };
        let said = complaint(play(&args(1, 0, folder.path(), false), &refuses));
        assert!(said.contains("does not start: no such verb"), "{said}");
    }
}
