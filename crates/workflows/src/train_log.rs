//! Files that a training writes while it runs: progress as CSV and TensorBoard events, learning curve as SVG.

use std::fs::File;
use std::io::Write;
use std::path::Path;

use twinstep_learning::{EventFile, Iteration};
use twinstep_policy::CurvePoint;
use twinstep_report::chart::{self, GREY, HPos, INK, Line, ORANGE, Panel, PlotError};

/// Width and height of the plot of the learning curve [px].
const SIZE: (u32, u32) = (900, 560);

/// Progress of a training in its folder.
pub struct TrainLog {
    table: File,
    events: EventFile,
    terms: Vec<String>,
}

impl TrainLog {
    /// Creates the files in `folder`. The table of a training that was resumed at `resumed_at` environment steps keeps its
    /// rows up to there: those after the last checkpoint are written again.
    pub fn open(folder: &Path, terms: &[String], resumed_at: Option<u64>) -> std::io::Result<Self> {
        let path = folder.join("progress.csv");
        let earlier = resumed_at.map(|steps| rows_until(&path, steps)).transpose()?.unwrap_or_default();
        let mut table = File::create(&path)?;
        let columns: Vec<&str> = NAMES.iter().copied().chain(terms.iter().map(String::as_str)).collect();
        writeln!(table, "{}", columns.join(","))?;
        table.write_all(earlier.as_bytes())?;
        Ok(Self { table, events: EventFile::create(folder)?, terms: terms.to_vec() })
    }

    /// Writes an iteration. Reward terms are means per step of the episodes that ended in it; empty if none did.
    pub fn write(&mut self, iteration: &Iteration, point: &CurvePoint) -> std::io::Result<()> {
        let length = iteration.statistics.length;
        let term = |sum: &f64| if length == 0 { f64::NAN } else { sum / length as f64 };
        let values: Vec<f64> =
            values(iteration, point).into_iter().chain(iteration.statistics.terms.iter().map(term)).collect();
        let cell = |value: &f64| if value.is_finite() { value.to_string() } else { String::new() };
        writeln!(self.table, "{}", values.iter().map(cell).collect::<Vec<_>>().join(","))?;
        let names = NAMES.iter().copied().chain(self.terms.iter().map(String::as_str));
        let scalars: Vec<_> = names.zip(values).filter(|(_, value)| value.is_finite()).collect();
        self.events.write(iteration.env_steps, &scalars)
    }
}

/// Returns the rows of an earlier table up to `env_steps` environment steps.
fn rows_until(path: &Path, env_steps: u64) -> std::io::Result<String> {
    let text = match std::fs::read_to_string(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(String::new()),
        result => result?,
    };
    let column = NAMES.iter().position(|name| *name == "env_steps").expect("a column of the table");
    // A row that a crash cut off has no end of line.
    let rows = text.split_inclusive('\n').skip(1).filter(|row| row.ends_with('\n'));
    let is_kept = |row: &&str| {
        row.split(',').nth(column).and_then(|cell| cell.parse().ok()).is_some_and(|steps: u64| steps <= env_steps)
    };
    Ok(rows.filter(is_kept).collect())
}

/// Names of the columns before the reward terms.
const NAMES: [&str; 16] = [
    "iteration",
    "env_steps",
    "seconds",
    "reward",
    "velocity_rms",
    "yaw_rate_rms",
    "falls_per_minute",
    "mean_level",
    "surrogate",
    "value_loss",
    "kl",
    "clipped_share",
    "learning_rate",
    "action_std",
    "rollout_s",
    "update_s",
];

fn values(iteration: &Iteration, point: &CurvePoint) -> [f64; 16] {
    [
        iteration.iteration as f64,
        iteration.env_steps as f64,
        point.seconds,
        point.reward,
        point.velocity_rms.unwrap_or(f64::NAN),
        point.yaw_rate_rms.unwrap_or(f64::NAN),
        point.falls_per_minute,
        point.mean_level.unwrap_or(f64::NAN),
        iteration.surrogate,
        iteration.value_loss,
        iteration.kl,
        iteration.clipped_share,
        f64::from(iteration.learning_rate),
        f64::from(iteration.action_std),
        iteration.rollout_time.as_secs_f64(),
        iteration.update_time.as_secs_f64(),
    ]
}

/// Returns the point of the learning curve of an iteration after `seconds` of training.
pub fn curve_point(iteration: &Iteration, policy_dt: f64, seconds: f64) -> CurvePoint {
    let statistics = &iteration.statistics;
    let steps = statistics.steps as f64;
    let rms = statistics.velocity_rms();
    CurvePoint {
        env_steps: iteration.env_steps,
        seconds,
        reward: statistics.reward / steps,
        velocity_rms: rms.map(|[velocity, _]| velocity),
        yaw_rate_rms: rms.map(|[_, yaw_rate]| yaw_rate),
        falls_per_minute: statistics.falls as f64 / (steps * policy_dt / 60.0),
        mean_level: statistics.mean_level(),
    }
}

/// Writes the learning curve: velocity errors and reward over environment steps.
pub fn write_curve(curve: &[CurvePoint], path: &Path) -> Result<(), PlotError> {
    let steps = |point: &CurvePoint| point.env_steps as f64 / 1e6;
    let line = |colour, value: &dyn Fn(&CurvePoint) -> f64| Line {
        colour,
        width: 4,
        pieces: vec![curve.iter().map(|point| (steps(point), value(point))).filter(|(_, y)| y.is_finite()).collect()],
    };
    let errors = vec![
        line(ORANGE, &|point| point.velocity_rms.unwrap_or(f64::NAN)),
        line(INK, &|point| point.yaw_rate_rms.unwrap_or(f64::NAN)),
    ];
    let reward = vec![line(GREY, &|point| point.reward)];
    let end = curve.last().map_or(1.0, steps).max(1e-6);
    let panel = |caption: &str, x_label, y_label, lines: Vec<Line>| {
        let y = chart::range(lines.iter().flat_map(|line| &line.pieces).flatten().map(|(_, y)| *y));
        Panel { caption: caption.to_owned(), x_label, y_label, x: 0.0..end, y, lines }
    };
    let svg = chart::picture(SIZE, |area| {
        let (top, bottom) = area.split_vertically(640);
        let names = [("velocity [m/s]", ORANGE), ("yaw rate [rad/s]", INK)];
        panel("RMS error during training, with exploration noise", "", "", errors).draw(&top)?;
        chart::legend(&top, &names, 520, (520, 110))?;
        chart::text(&bottom, "mean reward per step", 40, HPos::Left, (180, 30))?;
        panel("", "environment steps [million]", "", reward).draw(&bottom)
    })?;
    chart::write(&svg, path)
}
