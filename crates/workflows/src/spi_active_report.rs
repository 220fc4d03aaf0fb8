//! Report of `twinstep spi-active`: what was identified, and how well the models predict a log that none has seen.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use twinstep_effects::{Effect, ModelFile, Scope};
use twinstep_identify::{EffectAtScope, Evaluation, evaluate, free_parameters};

use crate::failure::{Failure, input};
use crate::observer::Observer;
use crate::open_log::open_log;
use crate::robot_file::{analytic_model, simulator};
use crate::spi_active_config::SpiActiveConfig;

/// What a recording cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RobotTime {
    /// Duration [s].
    pub seconds: f64,
    /// Number of falls.
    pub falls: u64,
}

/// A stage that is complete.
pub struct StageResult {
    /// Its name.
    pub name: String,
    /// What its log cost.
    pub robot_time: RobotTime,
    /// Model that was identified from the logs so far.
    pub model: PathBuf,
}

/// Returns the report as Markdown.
pub fn report(
    config: &SpiActiveConfig,
    stages: &[StageResult],
    held_out: &Path,
    robot_time: RobotTime,
    observer: &Observer,
) -> Result<String, Failure> {
    let start = analytic_model(config.model.as_deref())?;
    let mut models = vec![("start", start)];
    for stage in stages {
        models.push((&stage.name, analytic_model(Some(&stage.model))?));
    }
    let mut text = format!(
        "# SPI-Active\n\nErrors on the held-out log ({:.0} s, {} falls), which was not used for identification.\n\n\
         | model | robot time [s] | falls | joint position, RMSE [rad] |\n|---|---|---|---|\n",
        robot_time.seconds, robot_time.falls
    );
    let mut spent = RobotTime::default();
    for (index, (name, model)) in models.iter().enumerate() {
        if let Some(stage) = index.checked_sub(1).map(|stage| &stages[stage]) {
            spent.seconds += stage.robot_time.seconds;
            spent.falls += stage.robot_time.falls;
        }
        let q_rmse = error(held_out, model, observer)?.q_rmse_rad.map_or("-".to_owned(), |value| format!("{value:.4}"));
        let _ = writeln!(text, "| {name} | {:.0} | {} | {q_rmse} |", spent.seconds, spent.falls);
    }
    let names: Vec<&str> = models.iter().map(|(name, _)| *name).collect();
    let _ = writeln!(text, "\nParameters with 95 % intervals.\n\n| parameter | {} |", names.join(" | "));
    let _ = writeln!(text, "|---|{}", "---|".repeat(names.len()));
    for EffectAtScope(effect, scope) in config.unknowns() {
        let (_, parameters) = free_parameters(&models[0].1, &[(effect, scope)]).map_err(input)?;
        for (index, parameter) in parameters.iter().enumerate() {
            let cells: Vec<_> = models.iter().map(|(_, model)| value(model, effect, scope, index)).collect();
            let _ = writeln!(text, "| {} [{}] | {} |", parameter.name(), parameter.unit, cells.join(" | "));
        }
    }
    Ok(text)
}

/// Returns the errors of a model on a log.
fn error(log: &Path, model: &ModelFile, observer: &Observer) -> Result<Evaluation, Failure> {
    let (log, robot) = (open_log(log, observer)?, model.robot_model().map_err(input)?);
    evaluate(&log, &robot, &mut simulator(&robot)?, |_| true).map_err(input)
}

/// Returns a value of the last entry of this effect with its interval.
fn value(model: &ModelFile, effect: &Effect, scope: Scope, index: usize) -> String {
    let entry = model.effects.iter().rfind(|entry| entry.effect == effect && entry.scope == scope);
    entry.map_or("-".to_owned(), |entry| match entry.intervals[index] {
        Some([low, high]) => format!("{:.4} ({low:.4} to {high:.4})", entry.values[index]),
        None => format!("{:.4}", entry.values[index]),
    })
}
