//! Gain of `twinstep adapt` on hidden robots: predicted, found on the robot, and on 64 robots like it.
//!
//! `target/release/adapt_table --robots 12 --seed 1 --out adapt-table` draws robots with payloads, weak motors, friction by joint type
//! and delays. The policy is adapted from two logs of each: one of 35 s in which the robot hangs and follows chirps, and one of 28 s in
//! which it stands and walks. What is complete is kept.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use rand::RngExt;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use twinstep_model::{Stream, stream};
use twinstep_tests::process::Process;
use twinstep_tests::resumable::{Resumable, Step, number, print_result, read, text};

/// Measure the gain of `twinstep adapt`.
#[derive(Parser)]
struct Args {
    /// Number of hidden robots.
    #[arg(long, default_value_t = 12)]
    robots: u64,
    /// Seed of the robots.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Physics engine of the hidden robots.
    #[arg(long, default_value = "batch")]
    engine: String,
    /// Policy to adapt.
    #[arg(long, default_value = "data/policies/walk.safetensors")]
    policy: PathBuf,
    /// Folder of the results.
    #[arg(long)]
    out: PathBuf,
}

/// An effect that a hidden robot may have: name, scopes, parameter, range, and its probability.
type Hidden = (&'static str, &'static [&'static str], &'static str, [f64; 2], f64);

const HIDDEN: [Hidden; 4] = [
    ("torque_gain", &["all"], "gain", [0.75, 0.95], 0.4),
    ("viscous_friction", &["hip", "thigh", "calf"], "coefficient_nms", [0.05, 0.5], 0.6),
    ("coulomb_friction", &["hip", "thigh", "calf"], "torque_nm", [0.2, 1.2], 0.6),
    ("command_delay", &["all"], "delay_s", [0.004, 0.016], 0.4),
];
/// Probability of a payload, and the ranges of its mass [kg] and place [m].
const PAYLOAD: f64 = 0.6;
const PAYLOAD_KG: [f64; 2] = [1.0, 5.0];
const PAYLOAD_M: [[f64; 2]; 3] = [[-0.1, 0.1], [-0.05, 0.05], [0.05, 0.1]];

/// Commands of the second log: the robot stands, then it walks [s, m/s, rad/s].
const COMMANDS: &str =
    "start_s,end_s,vx,vy,wz\n0,8,0,0,0\n8,13,0.6,0.2,0.3\n13,18,-0.5,0,-0.8\n18,23,0.9,0,0\n23,28,0.3,-0.4,0.6\n";

/// Result of a robot.
#[derive(Serialize, Deserialize)]
struct Row {
    hidden: Vec<String>,
    adapted: Value,
    /// Velocity error of 64 robots like the hidden one from 1 s after each command, under the policy before and after [m/s].
    error: [f64; 2],
    /// Share of them that did not fall, before and after.
    up: [f64; 2],
}

fn main() -> ExitCode {
    print_result(run(&Args::parse()))
}

fn run(args: &Args) -> Step<String> {
    let results = Resumable::new(&args.out)?;
    let rows = (0..args.robots).map(|robot| row(&results, args, robot)).collect::<Step<Vec<Row>>>()?;
    Ok(table(&rows))
}

/// Adapts the policy to a robot, unless that is done.
fn row(results: &Resumable, args: &Args, robot: u64) -> Step<Row> {
    let folder = results.path(&format!("robot-{robot}"));
    let path = folder.join("row.json");
    if path.exists() {
        return serde_json::from_value(read(&path)?).map_err(text);
    }
    std::fs::create_dir_all(&folder).map_err(text)?;
    let (toml, hidden) = hidden_robot(&mut stream(args.seed, "hidden robot", robot));
    let model = folder.join("hidden.toml");
    std::fs::write(&model, toml).map_err(text)?;
    let shown = |path: &Path| path.display().to_string();
    std::fs::write(folder.join("commands.csv"), COMMANDS).map_err(text)?;
    let [model, commands, hanging, walking, out] =
        ["hidden.toml", "commands.csv", "hanging.parquet", "walking", "adapt"].map(|name| shown(&folder.join(name)));
    let policy = shown(&args.policy);
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "2", "--engine", &args.engine, "--model", &model];
    let (_server, endpoint) = Process::listening(&results.twinstep, &serve.map(str::to_owned))?;
    let _ = std::fs::remove_dir_all(&walking);
    let seed = (args.seed + robot).to_string();
    let endpoint = ["--endpoint", &endpoint];
    let play = ["play", "data/go2_air_chirp", "--base", "fixed", "--engine", &args.engine, "--model", &model];
    results.run(&[&play[..], &["--out", &hanging]].concat())?;
    let record = ["--commands", &commands, "--fast", "--torque", "--log", &walking, "--seed", &seed];
    results.run(&[&["run", &policy][..], &endpoint, &record].concat())?;
    let adapt = ["--json", "--out", &out, "--seed", &seed];
    let adapted = results.run(&[&["adapt", &policy, &hanging, &walking][..], &endpoint, &adapt].concat())?;
    let adapted: Value = serde_json::from_str(&adapted).map_err(text)?;
    let evaluated = |policy: &str| {
        let like_it =
            ["--model", &model, "--condition", "nominal", "--engine", &args.engine, "--robots", "64", "--json"];
        let found = results.run(&[&["evaluate-policy", policy][..], &like_it].concat())?;
        serde_json::from_str::<Value>(&found).map_err(text)
    };
    let [before, after] = [evaluated(&policy)?, evaluated(&format!("{out}/policy.safetensors"))?];
    let of = |pointer: &str| [&before, &after].map(|found| number(found.pointer(pointer).unwrap_or(&Value::Null)));
    let row = Row { hidden, adapted, error: of("/rows/0/settled_velocity_rms"), up: of("/rows/0/up") };
    std::fs::write(&path, serde_json::to_string_pretty(&row).map_err(text)?).map_err(text)?;
    Ok(row)
}

/// Draws a robot. Returns its model file and the names of what it has.
fn hidden_robot(stream: &mut Stream) -> (String, Vec<String>) {
    let mut toml = "robot = \"go2\"\n".to_owned();
    let mut hidden = Vec::new();
    let mut uniform = |[low, high]: [f64; 2]| low + (high - low) * stream.random::<f64>();
    for (effect, scopes, parameter, range, probability) in HIDDEN {
        if uniform([0.0, 1.0]) > probability {
            continue;
        }
        for scope in scopes {
            let value = uniform(range);
            let _ = writeln!(toml, "[[effect]]\nname = \"{effect}\"\nscope = \"{scope}\"\n{parameter} = {value:.4}");
        }
        hidden.push(effect.to_owned());
    }
    if hidden.is_empty() || uniform([0.0, 1.0]) < PAYLOAD {
        let (mass, place) = (uniform(PAYLOAD_KG), PAYLOAD_M.map(&mut uniform));
        let [x, y, z] = place;
        let _ = writeln!(toml, "[[effect]]\nname = \"payload\"\nscope = \"base\"\nmass_kg = {mass:.3}");
        let _ = writeln!(toml, "position_m = [{x:.3}, {y:.3}, {z:.3}]");
        hidden.push(format!("payload {mass:.1} kg"));
    }
    (toml, hidden)
}

/// Returns the table, and what holds for all robots.
fn table(rows: &[Row]) -> String {
    let mut text = "| hidden | causes | error, 64 robots [m/s] | less | up [%] | predicted | found | kept |\n\
                    |---|---|---|---|---|---|---|---|\n"
        .to_owned();
    let (mut reductions, mut covered, mut covered_mean) = (Vec::new(), 0, 0);
    for Row { hidden, adapted, error: [before, after], up } in rows {
        let reduction = 1.0 - after / before;
        let predicted = &adapted["predicted"];
        let interval = [0, 1].map(|bound| number(&predicted["interval"][bound]));
        let found = number(&adapted["found"]["reduction"]);
        let is_adapted = adapted["is_adapted"] == true;
        let holds = |value: f64| interval[0] <= value && value <= interval[1];
        covered += usize::from(holds(found));
        covered_mean += usize::from(is_adapted && holds(reduction));
        reductions.push(reduction);
        let causes = adapted["causes"].as_array().into_iter().flatten().filter_map(Value::as_str);
        let _ = writeln!(
            text,
            "| {} | {} | {before:.3} -> {after:.3} | {:.0} % | {:.0} -> {:.0} | {:.0} % ({:.0} to {:.0}) | {:.0} % | {} |",
            hidden.join(", "),
            causes.collect::<Vec<_>>().join(", "),
            100.0 * reduction,
            100.0 * up[0],
            100.0 * up[1],
            100.0 * number(&predicted["reduction"]),
            100.0 * interval[0],
            100.0 * interval[1],
            100.0 * found,
            if is_adapted { "new" } else { "old" }
        );
    }
    reductions.sort_by(f64::total_cmp);
    let (count, middle) = (rows.len(), reductions.len() / 2);
    let _ = writeln!(
        text,
        "\nMedian reduction of the error: {:.0} %; least: {:.0} %. The predicted interval of a robot holds what was found in {covered} of \
         {count}, and the mean of the 64 robots in {covered_mean}.",
        100.0 * reductions[middle],
        100.0 * reductions[0]
    );
    text
}
