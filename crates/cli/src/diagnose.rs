//! `twinstep diagnose`: what a model gets wrong, by name.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_logs::Log;
use twinstep_model::Joint;
use twinstep_effects::ModelFile;
use twinstep_diagnose::{DiagnoseError, DiagnosisOutput, Diagnosis, RmsErrors, ParameterValue, diagnose, diagnose_torques};

use crate::evaluate::simulator;
use crate::exit::{Failure, CommandResult, Signals, input, other};
use twinstep_report::report_data::{ReportData, LogFacts, Provenance};
use twinstep_report::write_report;

/// Show what the simulation gets wrong, name the cause, extend the model, and measure the gain.
///
/// Simulations of the log's commands are compared with what was measured. Every effect of the catalogue is tried on every
/// joint, leg, side and type of joint; what explains most is fitted on one half of the log's seconds and judged on the other,
/// and is named only if its evidence is above a threshold and it explains a good part of the error. Then the search goes on
/// from there. A name is not given when nothing is wrong, or when the cause is not in the catalogue: then the report says what
/// the error depends on.
///
/// DIR gets report.html to read, findings.json for programs, and extended.toml, which `twinstep serve --model` loads. Where
/// causes are left that the log cannot tell apart, it also gets next_experiment, the safe motion that parts them best: play it
/// and diagnose both logs.
///
/// Logs of another robot, with joints of other names, are looked at by the torques of their actuators alone, beside ideal actuators
/// with the log's gains: they need `q_*`, `dq_*`, `q_cmd_*` and `tau_measured_*`, and DIR gets findings.json.
///
/// Example: `twinstep diagnose data/go2_air_chirp --out diagnosis`
#[derive(clap::Args)]
pub struct Args {
    /// Logs of one robot: data files, or folders that hold one.
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// The model that is to be corrected; the ideal Go2 without.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// The folder to write.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print findings.json on stdout too, and nothing else there.
    #[arg(long)]
    json: bool,
}

impl Args {
    /// Diagnoses `log` with the ideal Go2 and writes to `out`.
    pub fn new(log: PathBuf, out: PathBuf) -> Self {
        Self { logs: vec![log], model: None, out, json: false }
    }
}

/// The folder of the motion that is to be played next, in the folder that is written.
const NEXT_EXPERIMENT: &str = "next_experiment";

/// The folder cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", path.display())]
struct Unwritable {
    path: PathBuf,
    source: std::io::Error,
}

/// A model is of a Go2.
#[derive(Debug, thiserror::Error)]
#[error(
    "--model {}: a model file is of a Go2, and the log's joint `{joint}` is none of its joints\n  without --model its actuators \
     are compared with ideal ones", model.display()
)]
struct UnsupportedRobot {
    model: PathBuf,
    joint: String,
}

/// Diagnoses, writes and prints.
pub fn run(args: &Args) -> CommandResult {
    let model = args.model.as_ref().map_or(Ok(ModelFile::default()), ModelFile::load_without_actuator_network).map_err(input)?;
    let logs = args.logs.iter().map(|path| Log::open(path).map_err(input)).collect::<Result<Vec<_>, _>>()?;
    // Before the search, not after it: what it finds must not be lost.
    std::fs::create_dir_all(&args.out).map_err(|source| input(Unwritable { path: args.out.clone(), source }))?;
    let other_joint = logs[0].joints().iter().find(|name| name.parse::<Joint>().is_err());
    if let Some(joint) = other_joint {
        let model = args.model.clone();
        let refused = model.map_or(Ok(()), |model| Err(UnsupportedRobot { model, joint: joint.clone() }));
        refused.map_err(input)?;
        let diagnosis = with_progress(|progress| diagnose_torques(&logs, progress))?;
        return print_findings(&diagnosis, args);
    }
    let robot = model.robot_model().map_err(input)?;
    let mut simulator = simulator(&robot)?;
    let DiagnosisOutput { mut diagnosis, extended, next } =
        with_progress(|progress| diagnose(logs.clone(), &model, &mut simulator, progress))?;
    diagnosis.extended_model = "extended.toml".to_owned();
    let motion = args.out.join(NEXT_EXPERIMENT);
    // One of an earlier diagnosis would be taken for this one's.
    if motion.exists() {
        std::fs::remove_dir_all(&motion).map_err(|source| input(Unwritable { path: motion.clone(), source }))?;
    }
    if let Some((said, next)) = diagnosis.next_experiment.as_mut().zip(next) {
        next.motion.write(&motion).map_err(input)?;
        NEXT_EXPERIMENT.clone_into(&mut said.motion);
    }
    written(args, "extended.toml", &extended.to_toml())?;
    let provenance = Provenance {
        command: std::env::args().collect::<Vec<_>>().join(" "),
        date: today(),
        model: args.model.as_ref().map_or("the ideal go2".to_owned(), |path| path.display().to_string()),
        logs: args.logs.iter().zip(&logs).map(|(path, log)| LogFacts::of(&path.display().to_string(), log)).collect(),
    };
    let evidence = ReportData::gather(&logs[0], &model, &extended, &mut simulator, provenance).map_err(other)?;
    let report = args.out.join("report.html");
    write_report(&diagnosis, &evidence, &report).map_err(input)?;
    print_findings(&diagnosis, args)?;
    if !args.json {
        println!("report: {}", report.display());
    }
    Ok(())
}

/// What a diagnosis gives that says what it is doing, and ends with Ctrl-C.
fn with_progress<T>(
    diagnose: impl FnOnce(&mut dyn FnMut(&str) -> bool) -> Result<T, DiagnoseError>,
) -> Result<T, Failure> {
    let signals = Signals::listen()?;
    let bar = ProgressBar::new_spinner();
    bar.set_style(ProgressStyle::with_template("{spinner} {elapsed} {msg}").expect("a template"));
    let found = diagnose(&mut |text| {
        bar.set_message(text.to_owned());
        bar.tick();
        !signals.check().unwrap_or(true)
    });
    bar.finish_and_clear();
    found.map_err(|error| match error {
        DiagnoseError::Interrupted => Failure::Interrupted,
        error => input(error),
    })
}

/// Writes findings.json, and prints it or what a terminal shows.
fn print_findings(diagnosis: &Diagnosis, args: &Args) -> CommandResult {
    let json = serde_json::to_string_pretty(diagnosis).map_err(other)?;
    written(args, "findings.json", &json)?;
    if args.json {
        println!("{json}");
    } else {
        print!("{}", text(diagnosis, &args.out));
    }
    Ok(())
}

/// Writes a file of the folder.
fn written(args: &Args, name: &str, text: &str) -> CommandResult {
    let path = args.out.join(name);
    std::fs::write(&path, text).map_err(|source| input(Unwritable { path, source }))
}

/// What a terminal shows.
fn text(diagnosis: &Diagnosis, out: &Path) -> String {
    let mut lines = Vec::new();
    for cause in &diagnosis.findings {
        let sizes = cause.parameters.iter().map(|(name, estimate)| {
            let numbers = [&estimate.value, &estimate.low, &estimate.high].map(number);
            format!("{name} {} ({} to {})", numbers[0], numbers[1], numbers[2])
        });
        lines.push(format!("{}@{}  {}", cause.effect, cause.scope, sizes.collect::<Vec<_>>().join(", ")));
        lines.push(format!("    {}", cause.evidence));
        if !cause.ambiguous_with.is_empty() {
            lines.push(format!("    or {}: this log cannot tell", cause.ambiguous_with.join(", or ")));
        }
    }
    if diagnosis.findings.is_empty() {
        lines.push("no cause is named".to_owned());
    }
    lines.push(diagnosis.unexplained.text.clone());
    if let Some(next) = &diagnosis.next_experiment {
        lines.push(format!("next experiment: {}", out.join(&next.motion).display()));
        lines.push(format!("    {}", next.text));
    }
    lines.push(error_line("closed-loop joint RMSE [rad]", diagnosis, |errors| errors.q_rmse_rad));
    lines.push(error_line("torque RMSE [N·m]", diagnosis, |errors| errors.torque_rmse_nm));
    lines.join("\n") + "\n"
}

fn error_line(name: &str, diagnosis: &Diagnosis, of: fn(&RmsErrors) -> Option<f64>) -> String {
    let errors = [&diagnosis.baseline, &diagnosis.extended, &diagnosis.noise_floor];
    let [before, after, floor] = errors.map(|errors| of(errors).map_or("-".to_owned(), |value| format!("{value:.4}")));
    format!("{name}, held-out seconds: {before} -> {after} (noise {floor})")
}

fn number(value: &ParameterValue) -> String {
    match value {
        ParameterValue::Number(value) => format!("{value:.4}"),
        ParameterValue::Vector(values) => {
            format!("[{}]", values.iter().map(|value| format!("{value:.4}")).collect::<Vec<_>>().join(", "))
        }
    }
}

/// The date in UTC, as in 2026-11-21 (days to a civil date, Howard Hinnant's algorithm).
fn today() -> String {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    civil_date(seconds / 86_400)
}

fn civil_date(days: u64) -> String {
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 { shifted_month + 3 } else { shifted_month - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    format!("{year}-{month:02}-{day:02}")
}

#[cfg(test)]
mod tests {
    #[test]
    fn days_are_dates() {
        let dates = [0, 11_016, 20_778].map(super::civil_date);
        assert_eq!(dates, ["1970-01-01", "2000-02-29", "2026-11-21"]);
    }
}
