//! Identification of a robot of any tree.

use std::path::PathBuf;

use twinstep_effects::TreeModelFile;
use twinstep_inference::{
    Candidate, Estimate, Identification, IdentifyOptions as FitOptions, JointLog, ParameterRequest, evaluate,
    identify as fit_parameters,
};
use twinstep_logs::Log;

use crate::failure::{Failure, input};
use crate::identify_options::{Estimated, Fit, Identified, IdentifyOptions};
use crate::observer::Observer;
use crate::tree_model::{actuator_hz, note_assumptions};

/// The output file cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", path.display())]
pub struct Unwritable {
    pub path: PathBuf,
    pub source: std::io::Error,
}

/// Estimates the parameters that are requested, or the default ones, and writes the model.
pub fn run(
    file: &TreeModelFile,
    log: &Log,
    rows: &[bool],
    options: &IdentifyOptions,
    observer: &Observer,
) -> Result<Identified, Failure> {
    let out = &options.out;
    let joint_log = JointLog::new(log, &file.nominal.tree, |row| rows[row]).map_err(input)?;
    note_assumptions(file, &joint_log, observer);
    let unwritable = |source| input(Unwritable { path: out.clone(), source });
    std::fs::OpenOptions::new().append(true).create(true).open(out).map_err(unwritable)?;
    let requests = match &options.effects {
        Some(given) => given.iter().map(|request| ParameterRequest(request.clone())).collect(),
        None => ParameterRequest::DEFAULT.map(|request| ParameterRequest(request.to_owned())).to_vec(),
    };
    let fit = FitOptions { requests, actuator_hz: actuator_hz(file), stop: observer.flag() };
    let bar = observer.spinner("{spinner} {elapsed}  {msg}");
    let found = fit_parameters(file, &joint_log, &fit, &mut |round, rounds, cost| {
        bar.set_message(format!("round {round} of {rounds}, cost {cost:.4e}"));
        bar.tick();
    });
    bar.finish_and_clear();
    let found = found.map_err(input)?;
    twinstep_files::write(out, found.model.to_toml()).map_err(unwritable)?;
    let error = |file: &TreeModelFile| {
        let candidate = Candidate::of(file).map_err(input)?;
        Ok::<_, Failure>(evaluate(&joint_log, &candidate, fit.actuator_hz).map_err(input)?.0.q_rmse_rad)
    };
    let mut fits = Vec::new();
    if !found.interrupted
        && let (Some(before), Some(after)) = (error(file)?, error(&found.model)?)
    {
        fits.push(Fit { log: options.logs[0].clone(), q_rmse_rad: [before, after] });
    }
    let estimates = found.estimates.iter().map(|estimate| Estimated {
        name: estimate.parameter.name(),
        unit: estimate.parameter.unit.to_string(),
        value: estimate.value,
        interval: Some(estimate.interval),
    });
    Ok(Identified { estimates: estimates.collect(), fits, table: table(&found), is_interrupted: found.interrupted })
}

/// Returns a table with one line per parameter, and the highly correlated pairs.
fn table(found: &Identification) -> String {
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
    if found.interrupted {
        lines.push("interrupted: the values are the best so far, the intervals those of the priors".to_owned());
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
