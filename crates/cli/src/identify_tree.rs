//! `twinstep identify` for a robot of any tree.

use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_effects::TreeModelFile;
use twinstep_inference::{
    Candidate, Estimate, Identification, IdentifyOptions, JointLog, ParameterRequest, evaluate, identify,
};
use twinstep_logs::Log;

use crate::exit::{CommandResult, Failure, Signals, input};
use crate::tree_model::{actuator_hz, note_assumptions};

/// The output file cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", path.display())]
pub struct Unwritable {
    pub path: PathBuf,
    pub source: std::io::Error,
}

/// Estimates the parameters that are requested, or the default ones, prints them and writes the model to `out`.
pub fn run(
    file: &TreeModelFile,
    log: &Log,
    rows: &[bool],
    requests: Option<&[String]>,
    out: &Path,
    signals: &Signals,
) -> CommandResult {
    let joint_log = JointLog::new(log, &file.nominal.tree, |row| rows[row]).map_err(input)?;
    note_assumptions(file, &joint_log);
    let unwritable = |source| input(Unwritable { path: out.to_owned(), source });
    std::fs::OpenOptions::new().append(true).create(true).open(out).map_err(unwritable)?;
    let requests = match requests {
        Some(given) => given.iter().map(|request| ParameterRequest(request.clone())).collect(),
        None => ParameterRequest::DEFAULT.map(|request| ParameterRequest(request.to_owned())).to_vec(),
    };
    let options = IdentifyOptions { requests, actuator_hz: actuator_hz(file), stop: signals.flag() };
    let bar = ProgressBar::new_spinner()
        .with_style(ProgressStyle::with_template("{spinner} {elapsed}  {msg}").expect("a template"));
    let found = identify(file, &joint_log, &options, &mut |round, rounds, cost| {
        bar.set_message(format!("round {round} of {rounds}, cost {cost:.4e}"));
        bar.tick();
    });
    bar.finish_and_clear();
    let found = found.map_err(input)?;
    twinstep_files::write(out, found.model.to_toml()).map_err(unwritable)?;
    print!("{}", text(&found));
    if found.interrupted {
        println!("interrupted: the values are the best so far, the intervals those of the priors");
        return Err(Failure::Interrupted);
    }
    let error = |file: &TreeModelFile| {
        let candidate = Candidate::of(file).map_err(input)?;
        Ok(evaluate(&joint_log, &candidate, options.actuator_hz).map_err(input)?.0.q_rmse_rad)
    };
    if let (Some(before), Some(after)) = (error(file)?, error(&found.model)?) {
        println!("closed-loop joint RMSE {before:.4} -> {after:.4} rad on the rows it was fitted to");
    }
    Ok(())
}

/// Returns a table with one line per parameter, and the highly correlated pairs.
fn text(found: &Identification) -> String {
    let mut lines = vec![format!("{:<36}  {:>10}  95 % interval", "", "value")];
    for Estimate { parameter, value, interval: [low, high], is_wide } in &found.estimates {
        let remark = if *is_wide { "the log says little: nearly the prior" } else { "" };
        let [value, low, high] = [value, low, high].map(|number| significant(*number));
        let interval = format!("{low} to {high}");
        let line = format!("{:<36}  {value:>10}  {interval:<22} {:<10} {remark}", parameter.name(), parameter.unit);
        lines.push(line.trim_end().to_owned());
    }
    for (one, other, correlation) in &found.correlated {
        lines.push(format!("not separated by this log: {one} and {other} (correlation {correlation:.2})"));
    }
    lines.join("\n") + "\n"
}

/// Returns a positive number with three significant digits.
fn significant(value: f64) -> String {
    if value < 1e-3 {
        return format!("{value:.2e}");
    }
    let decimals = (2 - value.log10().floor() as i32).clamp(0, 9) as usize;
    format!("{value:.decimals$}")
}
