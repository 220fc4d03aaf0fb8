//! `twinstep diagnose`: reports which effects a robot model lacks.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{SystemTime, UNIX_EPOCH};

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_diagnose::{
    Cause, DiagnoseError, Diagnosis, DiagnosisOutput, ParameterValue, RmsErrors, TreeDiagnosis, diagnose, diagnose_tree,
};
use twinstep_effects::{Effect, Scope, TreeModelFile};
use twinstep_logs::replay::check_gains;
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::Joint;

use crate::ambiguous_effects;
use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::learned_residual;
use crate::open_log::open_log;
use crate::robot_file::{SimulatedRobot, analytic_model, simulator};
use crate::tree_model::{actuator_hz, tree_model};
use crate::view_log;
use twinstep_report::report_data::{LogFacts, Provenance, ReportData};
use twinstep_report::write_report;

/// Find the effects that a robot model lacks, estimate their parameters and write the corrected model.
///
/// Logs with motor currents are compared with the equations of drives, joints and base, without simulation. Causes are the effects of
/// the catalogue with the highest evidence, beside everything that each robot has a little of. findings.json has each decision. If no
/// effect of the catalogue is the cause, the report states what the residual depends on. If the log shows torques, or its base is
/// fixed, an ensemble of networks then learns the missing torque. It is kept if it reduces the error on held-out blocks by a fifth;
/// extended.toml adds it to the laws (`[actuator] mode = "residual"`).
///
/// Logs of a Go2 without motor currents are searched in simulations: every effect is tested on every joint, leg, side and joint type,
/// fitted to one fold of the log and evaluated on the other. That takes minutes, and is less reliable.
///
/// DIR gets report.html for a browser, findings.json for programs and extended.toml, the corrected model, which
/// `twinstep serve --model` loads. motion_before.html and motion_after.html play the first 20 s of the log, with the
/// simulation of the given and of the corrected model as the robot's ghost. If some causes are not distinguishable with this log, DIR also gets next_experiment,
/// the safe motion that discriminates between them best. Execute it with `twinstep play` or on the robot, then diagnose
/// both logs together.
///
/// For a robot that is not like the Go2, give its URDF, MJCF or model file with --model: DIR gets findings.json and extended.toml.
/// Torques may be those of motors or at the output. Without torques, the base must be fixed: positions are compared. Gains that no
/// file states are estimated first. Without --model only the drives are compared: that needs torques.
///
/// Example: `twinstep diagnose data/go2_air_chirp --out diagnosis`
#[derive(clap::Args)]
pub struct Args {
    /// Logs of one robot: data files, or folders that contain one.
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// Model file to correct, or a robot file (URDF, MJCF). Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Folder to write.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print findings.json to stdout too, and nothing else.
    #[arg(long)]
    json: bool,
}

impl Args {
    /// Returns the arguments that diagnose `log` against the ideal Go2 and write to `out`.
    pub fn new(log: PathBuf, out: PathBuf) -> Self {
        Self { logs: vec![log], model: None, out, json: false }
    }
}

/// Folder of the proposed experiment, in the output folder.
const NEXT_EXPERIMENT: &str = "next_experiment";

/// Pages of the robot and its simulation with the given and with the corrected model, in the output folder.
const MOTIONS: [&str; 2] = ["motion_before.html", "motion_after.html"];
/// Length of their motion [s].
const MOTION_S: f64 = 20.0;

/// The output folder cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", path.display())]
struct Unwritable {
    path: PathBuf,
    source: std::io::Error,
}

/// A log has only positions, and nothing says which robot it is.
#[derive(Debug, thiserror::Error)]
#[error(
    "the log has no torques, and `{joint}` is no joint of a Go2\n  give the robot's file with --model: positions are compared \
     with a simulation of the robot"
)]
struct NoRobot {
    joint: String,
}

/// Diagnoses the logs, writes the output folder and prints a summary.
pub fn run(args: &Args) -> CommandResult {
    let logs = args.logs.iter().map(|path| open_log(path)).collect::<Result<Vec<_>, _>>()?;
    // Checked before the search, so that its result cannot be lost.
    std::fs::create_dir_all(&args.out).map_err(|source| input(Unwritable { path: args.out.clone(), source }))?;
    if let Some(tree) = robot_of_tree(args, &logs)? {
        return run_tree(args, &logs, tree);
    }
    let model = analytic_model(args.model.as_deref())?;
    let robot = model.robot_model().map_err(input)?;
    let mut simulator = simulator(&robot)?;
    let (output, learned) = with_progress(|progress, stop| {
        let output = diagnose(logs.clone(), &model, &mut simulator, &stop, progress).map_err(failure)?;
        // What was found must not be lost with the networks.
        let learned = match learned_residual::learn(&logs, &output, progress) {
            Err(Failure::Input(error) | Failure::Other(error)) => {
                eprintln!("note: the torque that no cause explains was not learned: {error}");
                None
            }
            learned => learned?,
        };
        Ok((output, learned))
    })?;
    let DiagnosisOutput { mut diagnosis, mut extended, next, .. } = output;
    diagnosis.extended_model = "extended.toml".to_owned();
    let motion = args.out.join(NEXT_EXPERIMENT);
    // The folder of an earlier diagnosis must not be mistaken for the result of this one.
    if motion.exists() {
        std::fs::remove_dir_all(&motion).map_err(|source| input(Unwritable { path: motion.clone(), source }))?;
    }
    if let Some((entry, next)) = diagnosis.next_experiment.as_mut().zip(next) {
        next.motion.write(&motion).map_err(input)?;
        NEXT_EXPERIMENT.clone_into(&mut entry.motion);
    }
    // The networks of an earlier diagnosis must not be mistaken for the result of this one.
    let _ = std::fs::remove_file(args.out.join(learned_residual::FILE));
    let laws = extended.clone();
    let corrected = match &learned {
        Some(learned) => {
            diagnosis.extended = learned.summary.after;
            diagnosis.learned_residual = Some(learned.summary.clone());
            extended.actuator = Some(learned_residual::settings(learned_residual::FILE.into()));
            learned.ensemble.write(args.out.join(learned_residual::FILE)).map_err(other)?;
            learned_residual::simulated(&laws, learned)?
        }
        None => SimulatedRobot::analytic(laws.robot_model().map_err(input)?)?,
    };
    write_file(args, "extended.toml", &extended.to_toml())?;
    let motions = motion_pages(args, &logs[0], SimulatedRobot::analytic(robot)?, corrected)?;
    let provenance = Provenance {
        command: std::env::args().collect::<Vec<_>>().join(" "),
        date: today(),
        model: args.model.as_ref().map_or("the ideal go2".to_owned(), |path| path.display().to_string()),
        logs: args.logs.iter().zip(&logs).map(|(path, log)| LogFacts::of(&path.display().to_string(), log)).collect(),
        motions: motions.clone(),
    };
    let name = |cause: &Cause| Effect::named(&cause.effect).zip(cause.scope.parse().ok());
    let causes: Vec<(&Effect, Scope)> = diagnosis.findings.iter().filter_map(name).collect();
    let data = ReportData::gather(&logs[0], &model, &laws, &causes, &mut simulator, provenance).map_err(other)?;
    let report = args.out.join("report.html");
    write_report(&diagnosis, &data, &report).map_err(input)?;
    print_findings(&diagnosis, args)?;
    if !args.json {
        println!("report: {}", report.display());
        for motion in motions {
            println!("robot and simulation: {}", args.out.join(motion).display());
        }
    }
    Ok(())
}

/// Returns the robot if it is not like the Go2, or its gains are not known.
fn robot_of_tree(args: &Args, logs: &[Log]) -> Result<Option<TreeModelFile>, Failure> {
    let is_other = logs[0].joints().iter().any(|name| name.parse::<Joint>().is_err());
    if args.model.is_some() || !is_other {
        return tree_model(args.model.as_deref(), &logs[0]);
    }
    for log in logs {
        check_gains(log).map_err(input)?;
    }
    let largest = |joint: &String| {
        let torques = logs.iter().filter_map(|log| log.tau_measured(joint)).flatten();
        let largest = torques.filter(|torque| torque.is_finite()).fold(0.0_f64, |most, torque| most.max(torque.abs()));
        (joint.clone(), 2.0 * largest)
    };
    if logs[0].meta().tau_sensor == TorqueSensor::None {
        return Err(input(NoRobot { joint: logs[0].joints()[0].clone() }));
    }
    Ok(Some(TreeModelFile::of_drives(&logs[0].joints().iter().map(largest).collect::<Vec<_>>())))
}

/// Diagnoses a robot of any tree, writes findings and corrected model, and prints a summary.
fn run_tree(args: &Args, logs: &[Log], file: TreeModelFile) -> CommandResult {
    let rate = actuator_hz(&file);
    let found = with_progress(|progress, stop| diagnose_tree(logs, &file, rate, &stop, progress).map_err(failure))?;
    let TreeDiagnosis { mut diagnosis, extended } = found;
    // Drives without a robot have no model file.
    if args.model.is_some() || file.robot == TreeModelFile::go2().robot {
        diagnosis.extended_model = "extended.toml".to_owned();
        write_file(args, "extended.toml", &extended.to_toml())?;
    }
    print_findings(&diagnosis, args)
}

/// Writes the pages of the robot and its simulation with both models. Returns their names: none if the log cannot be played.
fn motion_pages(
    args: &Args,
    log: &Log,
    given: SimulatedRobot,
    extended: SimulatedRobot,
) -> Result<Vec<String>, Failure> {
    let mut written = Vec::new();
    for (file, robot) in MOTIONS.into_iter().zip(vec![given, extended]) {
        let title = format!("{} and {file}", args.logs[0].display());
        match view_log::page_with_ghost(log.clone(), title, robot, MOTION_S) {
            Ok(page) => {
                write_file(args, file, &page)?;
                written.push(file.to_owned());
            }
            // The page of an earlier diagnosis must not be mistaken for the result of this one.
            Err(_) => drop(std::fs::remove_file(args.out.join(file))),
        }
    }
    Ok(written)
}

/// Runs `diagnose` with a progress spinner. Ctrl-C interrupts it.
fn with_progress<T>(
    diagnose: impl FnOnce(&mut dyn FnMut(&str) -> bool, Arc<AtomicBool>) -> Result<T, Failure>,
) -> Result<T, Failure> {
    let signals = Signals::listen()?;
    let bar = ProgressBar::new_spinner();
    bar.set_style(ProgressStyle::with_template("{spinner} {elapsed} {msg}").expect("a template"));
    let stop = signals.flag();
    let mut progress = |text: &str| {
        bar.set_message(text.to_owned());
        bar.tick();
        !signals.check().unwrap_or(true)
    };
    let found = diagnose(&mut progress, stop);
    bar.finish_and_clear();
    found
}

fn failure(error: DiagnoseError) -> Failure {
    match error {
        DiagnoseError::Interrupted => Failure::Interrupted,
        error => input(error),
    }
}

/// Writes findings.json and prints it or, by default, a summary.
fn print_findings(diagnosis: &Diagnosis, args: &Args) -> CommandResult {
    let json = serde_json::to_string_pretty(diagnosis).map_err(other)?;
    write_file(args, "findings.json", &json)?;
    if args.json {
        println!("{json}");
    } else {
        print!("{}", text(diagnosis, &args.out));
    }
    Ok(())
}

/// Writes a file into the output folder.
fn write_file(args: &Args, name: &str, text: &str) -> CommandResult {
    let path = args.out.join(name);
    twinstep_files::write(&path, text).map_err(|source| input(Unwritable { path, source }))
}

/// Returns the summary for a terminal.
fn text(diagnosis: &Diagnosis, out: &Path) -> String {
    let mut lines = Vec::new();
    for cause in &diagnosis.findings {
        let sizes = cause.parameters.iter().map(|(name, estimate)| {
            let numbers = [&estimate.value, &estimate.low, &estimate.high].map(number);
            format!("{name} {} ({} to {})", numbers[0], numbers[1], numbers[2])
        });
        lines.push(format!("{}@{}  {}", cause.effect, cause.scope, sizes.collect::<Vec<_>>().join(", ")));
        lines.push(format!("    {}", cause.evidence));
        lines.push(format!("    {}", cause.remedy));
        if !cause.ambiguous_with.is_empty() {
            lines.push(format!("    not distinguishable from {} with this log", cause.ambiguous_with.join(" or ")));
        }
    }
    if diagnosis.findings.is_empty() {
        lines.push("no cause identified".to_owned());
    }
    lines.extend(joint_gains(diagnosis));
    if !diagnosis.also_fitted.is_empty() && !diagnosis.extended_model.is_empty() {
        lines.push(format!(
            "{} also has {} entries that are too small or too uncertain for a name: `also_fitted` in findings.json",
            diagnosis.extended_model,
            diagnosis.also_fitted.len()
        ));
    }
    lines.push(diagnosis.unexplained.text.clone());
    if let Some(learned) = &diagnosis.learned_residual {
        lines.push(format!(
            "{}  learned from {:.1} N·m and {:.1} rad/s at most; `extended.toml` adds its torque at `{}`",
            learned.ensemble, learned.max_torque_nm, learned.max_speed_rad_s, learned.tap
        ));
    }
    if let Some(next) = &diagnosis.next_experiment {
        lines.push(format!("next experiment: {}", out.join(&next.motion).display()));
        lines.push(format!("    {}", next.text));
    }
    let unknowns = ambiguous_effects::names(diagnosis);
    if !unknowns.is_empty() && diagnosis.findings.iter().any(|cause| !cause.ambiguous_with.is_empty()) {
        let command =
            format!("twinstep excite data/policies/walk.safetensors --findings {} --out design", out.display());
        lines.push(format!("next experiment of a walking robot, about {}: {command}", unknowns.join(", ")));
    }
    lines.push(error_line("closed-loop joint RMSE [rad]", diagnosis, |errors| errors.q_rmse_rad));
    lines.push(error_line("torque RMSE [N·m]", diagnosis, |errors| errors.torque_rmse_nm));
    lines.join("\n") + "\n"
}

/// Returns the line on gains that differ from joint to joint, if they do.
fn joint_gains(diagnosis: &Diagnosis) -> Option<String> {
    let [kp, kd] = diagnosis.joint_gain_ranges()?.map(|[low, high]| format!("{low:.3} to {high:.3}"));
    Some(format!(
        "the gains of the joints differ, kp by factors of {kp} and kd of {kd}: as those of equal motors, so no cause; \
         `extended.toml` has them"
    ))
}

fn error_line(name: &str, diagnosis: &Diagnosis, of: fn(&RmsErrors) -> Option<f64>) -> String {
    let errors = [&diagnosis.baseline, &diagnosis.extended, &diagnosis.noise_floor];
    let [before, after, floor] = errors.map(|errors| of(errors).map_or("-".to_owned(), |value| format!("{value:.4}")));
    format!("{name}, held-out blocks: {before} -> {after} (noise floor {floor})")
}

fn number(value: &ParameterValue) -> String {
    match value {
        ParameterValue::Number(value) => format!("{value:.4}"),
        ParameterValue::Vector(values) => {
            format!("[{}]", values.iter().map(|value| format!("{value:.4}")).collect::<Vec<_>>().join(", "))
        }
    }
}

/// Returns the date in UTC, as in 2026-11-21 (Howard Hinnant's algorithm `civil_from_days`).
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
    fn days_since_1970_are_converted_to_dates() {
        let dates = [0, 11_016, 20_778].map(super::civil_date);
        assert_eq!(dates, ["1970-01-01", "2000-02-29", "2026-11-21"]);
    }
}
