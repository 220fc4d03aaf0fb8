//! Promised and found error reduction of the corrected models of a blind test.
//!
//! Each robot with a reported cause makes a second log: the same phases with other random motions, gains and noise.
//! `twinstep evaluate` compares it with the given and with the corrected model. The promise is the reduction that the
//! report states for its held-out blocks. They have other motions than the whole log, so it is also compared with the
//! reduction on the blocks that a report on the second log would hold out (not for models with networks), and whole logs
//! with each other.
//!
//! `cargo build --release --workspace && target/release/hunt_pairs DIR`, where DIR is the `--out` of `twinstep hunt`. Logs and
//! evaluations are kept there, so that the same command continues after an interruption.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use serde::de::DeserializeOwned;
use serde_json::Value;
use twinstep_diagnose::held_out_rows;
use twinstep_effects::load_robot;
use twinstep_hunt::second_log;
use twinstep_identify::evaluate;
use twinstep_logs::Log;
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_tests::resumable::{Resumable, Step, number, print_result, read, text};

/// Compare the error reduction that reports promise with that on a second log of the same robots.
#[derive(Parser)]
struct Args {
    /// Results of `twinstep hunt`.
    hunt: PathBuf,
}

/// Relative difference within which a promise is kept.
const KEPT: f64 = 0.15;
/// Least promised or found reduction of a promise that is compared: noise decides on less.
const LEAST_REDUCTION: f64 = 0.1;
/// Error of `twinstep evaluate` and of `findings.json`, and its name.
const QUANTITIES: [[&str; 2]; 2] = [["torque_rmse_nm", "torque"], ["q_rmse_rad", "joint position"]];

fn main() -> ExitCode {
    print_result(table(&Args::parse().hunt))
}

/// Names of the comparisons: what promises, and the rows of the second log.
const COMPARISONS: [[&str; 2]; 3] =
    [["report", "whole"], ["report", "held-out blocks"], ["`evaluate`, whole first log", "whole"]];

/// Header of the table.
const HEADER: &str = "| error | promise | second log | robots | within 15 % of each other | promised, median | found, median |\n\
                      |---|---|---|---|---|---|---|\n";

/// Promised and found reduction of an error of one robot.
struct Pair {
    case: u64,
    /// Promise and finding of each comparison.
    reductions: [[Option<f64>; 2]; 3],
}

fn table(hunt: &Path) -> Step<String> {
    let lines = std::fs::read_to_string(hunt.join("cases.jsonl")).map_err(|error| {
        format!("{}: {error}\n  give the --out of `twinstep hunt`", hunt.join("cases.jsonl").display())
    })?;
    let cases = lines.lines().map(|line| serde_json::from_str(line).map_err(text)).collect::<Step<Vec<Value>>>()?;
    let program = Resumable::new(hunt)?;
    let named = |case: &&Value| case["verdict"]["named"].as_array().is_some_and(|names| !names.is_empty());
    let mut pairs = [Vec::new(), Vec::new()];
    for case in cases.iter().filter(named) {
        let [of_torque, of_position] = of_case(&program, case)?;
        pairs[0].push(of_torque);
        pairs[1].push(of_position);
    }
    let mut table = HEADER.to_owned();
    let mut others = String::new();
    for ([_, name], pairs) in QUANTITIES.into_iter().zip(&pairs) {
        for comparison in 0..COMPARISONS.len() {
            let [row, broken] = row(name, pairs, comparison);
            table += &row;
            others += &broken;
        }
    }
    Ok(table + "\nOthers:\n" + &others)
}

/// Returns the row of a comparison, and a line for each promise that is not kept.
fn row(name: &str, pairs: &[Pair], comparison: usize) -> [String; 2] {
    let [promise, rows] = COMPARISONS[comparison];
    let compared = |pair: &Pair| {
        let [promised, found] = pair.reductions[comparison];
        Some((pair.case, promised?, found?)).filter(|(_, one, other)| one.max(*other) >= LEAST_REDUCTION)
    };
    let compared: Vec<(u64, f64, f64)> = pairs.iter().filter_map(compared).collect();
    let promised = 100.0 * median(compared.iter().map(|(_, promised, _)| *promised).collect());
    let found = 100.0 * median(compared.iter().map(|(.., found)| *found).collect());
    let is_broken = |(_, promised, found): &&(u64, f64, f64)| !is_kept(*promised, *found);
    let line = |(case, promised, found): &(u64, f64, f64)| {
        let [promised, found] = [promised, found].map(|reduction| 100.0 * reduction);
        format!("- case {case}, {name}, {promise}, {rows}: promised {promised:.0} %, found {found:.0} %\n")
    };
    let broken: Vec<String> = compared.iter().filter(is_broken).map(line).collect();
    let [all, kept] = [compared.len(), compared.len() - broken.len()];
    let row = format!("| {name} | {promise} | {rows} | {all} | {kept} | {promised:.0} % | {found:.0} % |\n");
    [row, broken.concat()]
}

/// Returns true if the difference is at most [`KEPT`] of the larger reduction.
fn is_kept(promised: f64, found: f64) -> bool {
    (promised - found).abs() <= KEPT * promised.max(found)
}

/// Returns promise and finding of one robot, by quantity.
fn of_case(program: &Resumable, case: &Value) -> Step<[Pair; 2]> {
    let index = case["case"].as_u64().ok_or("a case without a number")?;
    let folder = program.path(&format!("{index:04}"));
    let log = folder.join("second_log");
    if !log.exists() {
        let seed = case["seed"].as_u64().ok_or("a case without a seed")?;
        let simulated = second_log(seed, index, parsed(&case["plant"])?, parsed(&case["suite"])?);
        simulated.map_err(text)?.write(&log).map_err(text)?;
    }
    let findings = read(&folder.join("diagnosis.json"))?;
    let models = [program.path("nominal.toml"), folder.join("report").join("extended.toml")];
    let of_log = |log: &Path, name: &str| -> Step<[Value; 2]> {
        let of_model = |model: usize| {
            let result = folder.join(format!("{name}_{}.json", ["nominal", "extended"][model]));
            evaluation(program, log, &models[model], &result)
        };
        Ok([of_model(0)?, of_model(1)?])
    };
    let (first, second) = (of_log(&folder.join("log"), "first")?, of_log(&log, "second")?);
    let blocks = on_held_out_blocks(&log, &models)?;
    let reported = [&findings["baseline"], &findings["extended"]];
    let pair = |place: usize| {
        let [quantity, _] = QUANTITIES[place];
        let reduction = |errors: [f64; 2]| Some(1.0 - errors[1] / errors[0]).filter(|reduction| reduction.is_finite());
        let of = |errors: [&Value; 2]| reduction(errors.map(|errors| number(&errors[quantity])));
        let (promised, found) = (of(reported), of(second.each_ref()));
        let on_blocks = blocks.and_then(|errors| reduction(errors[place]));
        Pair { case: index, reductions: [[promised, found], [promised, on_blocks], [of(first.each_ref()), found]] }
    };
    Ok([0, 1].map(pair))
}

/// Returns the errors of two models, by quantity, on the blocks of a log that a report would hold out; `None` if one of them
/// has networks.
fn on_held_out_blocks(log: &Path, models: &[PathBuf; 2]) -> Step<Option<[[f64; 2]; 2]>> {
    let log = Log::open(log).map_err(text)?;
    let held_out = held_out_rows(&log);
    let [Ok(nominal), Ok(extended)] = models.each_ref().map(load_robot) else { return Ok(None) };
    let mut errors = [[f64::NAN; 2]; 2];
    for (model, robot) in [nominal, extended].iter().enumerate() {
        let mut simulator = BatchRollout::new(robot, &SimConfig::default()).map_err(text)?;
        let found = evaluate(&log, robot, &mut simulator, |row| held_out[row]).map_err(text)?;
        for (errors, found) in errors.iter_mut().zip([found.torque_rmse_nm, found.q_rmse_rad]) {
            errors[model] = found.unwrap_or(f64::NAN);
        }
    }
    Ok(Some(errors))
}

/// Returns the errors of a model on a log, which are kept in `result`.
fn evaluation(program: &Resumable, log: &Path, model: &Path, result: &Path) -> Step<Value> {
    if !result.exists() {
        let [log, model] = [log, model].map(|path| path.display().to_string());
        let errors = program.run(&["evaluate", &log, "--model", &model, "--json"])?;
        std::fs::write(result, errors).map_err(text)?;
    }
    read(result)
}

fn parsed<T: DeserializeOwned>(value: &Value) -> Step<T> {
    T::deserialize(value).map_err(text)
}

fn median(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    numbers.get(numbers.len() / 2).copied().unwrap_or(f64::NAN)
}
