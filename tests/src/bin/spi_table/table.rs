//! Tables of the robots whose results are complete.

use std::fmt::Write as _;
use std::path::Path;

use twinstep_effects::ModelFile;
use twinstep_tests::fine_tuning::{TASKS, Task};
use twinstep_tests::resumable::{Step, number, read};

use crate::{Args, FROM_RANDOM_LOGS};

/// Two-sided 95 % quantile of Student's distribution by degrees of freedom, from 1.
const T_95: [f64; 9] = [12.71, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262];

/// Returns the tables.
pub fn text(args: &Args) -> Step<String> {
    let mut text =
        "| robot | commands of the second log | robot time [s] | error of the trunk's mass | joint position on a \
                    held-out log, RMSE [rad] | falls |\n|---|---|---|---|---|---|\n"
            .to_owned();
    let collections = args.collections();
    let is_complete = |seed: &u64| collections.iter().all(|method| exists(args, *seed, &format!("{method}/report.md")));
    for seed in seeds(args).filter(is_complete) {
        identification(args, seed, &mut text)?;
    }
    for task in TASKS {
        let is_complete = |seed: &u64| {
            methods(args, &task).all(|method| exists(args, *seed, &format!("{method}-{}.json", task.name)))
        };
        let done: Vec<u64> = seeds(args).filter(is_complete).collect();
        if !done.is_empty() {
            task.errors.iter().try_for_each(|error| downstream(args, &task, *error, &done, &mut text))?;
        }
    }
    Ok(text)
}

/// Returns the rows of a task's table.
fn methods<'a>(args: &'a Args, task: &Task) -> impl Iterator<Item = &'a str> {
    task.has_start().then_some("start").into_iter().chain(args.methods.iter().map(String::as_str))
}

fn seeds(args: &Args) -> std::ops::Range<u64> {
    args.first..args.first + args.robots
}

fn exists(args: &Args, seed: u64, name: &str) -> bool {
    args.out.join(seed.to_string()).join(name).exists()
}

/// Adds the rows of a robot: the model after the first log, and after the second one of each kind.
fn identification(args: &Args, seed: u64, text: &mut String) -> Step {
    let folder = args.out.join(seed.to_string());
    let truth = trunk_kg(&folder.join("hidden.toml"))?;
    for (index, method) in args.collections().into_iter().enumerate() {
        let report =
            std::fs::read_to_string(folder.join(method).join("report.md")).map_err(|error| error.to_string())?;
        let second = if index == 0 { "2-random" } else { "2-active" };
        for (name, stage) in [("none", "1-random"), (method, second)].iter().skip(usize::from(index > 0)) {
            let row = report.lines().find(|line| line.starts_with(&format!("| {stage} |")));
            let cells: Vec<&str> = row.map_or(Vec::new(), |row| row.split('|').map(str::trim).collect());
            let [_, _, seconds, falls, rmse, ..] = cells[..] else { return Err(format!("{method} has no {stage}")) };
            let mass = trunk_kg(&folder.join(method).join(stage).join("model.toml"))? / truth - 1.0;
            let _ = writeln!(text, "| {seed} | {name} | {seconds} | {:+.2} % | {rmse} | {falls} |", 100.0 * mass);
        }
    }
    let identified = FROM_RANDOM_LOGS.iter().filter(|method| args.methods.iter().any(|one| one == *method));
    for method in identified.filter(|method| exists(args, seed, &format!("{method}-held-out.json"))) {
        let mass = trunk_kg(&folder.join(format!("{method}.toml")))? / truth - 1.0;
        let rmse = read(&folder.join(format!("{method}-held-out.json")))?["q_rmse_rad"].as_f64().unwrap_or(f64::NAN);
        let _ = writeln!(text, "| {seed} | random, {method} | | {:+.2} % | {rmse:.4} | |", 100.0 * mass);
    }
    Ok(())
}

/// Returns the mass of the trunk with its payload [kg].
fn trunk_kg(model: &Path) -> Step<f64> {
    let model = ModelFile::load(model).map_err(|error| error.to_string())?;
    Ok(model.robot_model().map_err(|error| error.to_string())?.trunk.mass)
}

/// Adds the table of an error of a task.
fn downstream(args: &Args, task: &Task, (error, pointer): (&str, &str), seeds: &[u64], text: &mut String) -> Step {
    let errors = |method: &str| -> Step<Vec<[f64; 2]>> {
        let of = |seed: &u64| {
            let found = read(&args.out.join(seed.to_string()).join(format!("{method}-{}.json", task.name)))?;
            let value = found.pointer(pointer).map_or(f64::NAN, number);
            Ok([value, found.pointer(task.up).map_or(f64::NAN, number)])
        };
        seeds.iter().map(of).collect()
    };
    let compared = |method: &str| args.methods.iter().any(|other| other == method).then(|| errors(method)).transpose();
    let (vanilla, random) = (compared("vanilla")?, compared("spi-random")?);
    let _ = writeln!(
        text,
        "\n{}: {}, on {} robots\n\n| method | mean | by robot | did not fall | minus vanilla | minus spi-random |\n\
         |---|---|---|---|---|---|",
        task.name,
        error,
        seeds.len()
    );
    for method in methods(args, task) {
        let found = errors(method)?;
        let cells: Vec<String> = found.iter().map(|[error, _]| format!("{error:.4}")).collect();
        let up = mean(found.iter().map(|[_, up]| *up));
        let minus = |other: &Option<Vec<[f64; 2]>>| {
            let differences = |other: &Vec<[f64; 2]>| {
                found.iter().zip(other).map(|(one, other)| one[0] - other[0]).collect::<Vec<_>>()
            };
            other.as_ref().map_or("–".to_owned(), |other| interval(&differences(other)))
        };
        let _ = writeln!(
            text,
            "| {method} | {:.4} | {} | {:.0} % | {} | {} |",
            mean(found.iter().map(|[error, _]| *error)),
            cells.join(", "),
            100.0 * up,
            minus(&vanilla),
            minus(&random)
        );
    }
    Ok(())
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

/// Returns mean and 95 % interval of paired differences; the mean alone for less than three.
fn interval(differences: &[f64]) -> String {
    let mean = mean(differences.iter().copied());
    let count = differences.len();
    let Some(quantile) = T_95.get(count.wrapping_sub(2)).filter(|_| count > 2) else { return format!("{mean:+.4}") };
    let variance = differences.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1) as f64;
    let half = quantile * (variance / count as f64).sqrt();
    format!("{mean:+.4} ({:+.4} to {:+.4})", mean - half, mean + half)
}
