//! Error of identified models against robot time, for several ways of choosing the motions.
//!
//! `cargo build --release --workspace && target/release/robot_time --out robot-time`. Needs Python with the package's extra
//! `mujoco`; `TWINSTEP_PYTHON` is its interpreter. Each step is a command of `twinstep` whose result is kept, so that the
//! same command continues after an interruption. `robot-time.svg` in the folder is the figure.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use twinstep_logs::{Log, Meta, TorqueSensor};
use twinstep_report::chart::{self, Line, Panel, RGBColor};
use twinstep_tests::mujoco_ground_truth::{Collection, EffectSet, MujocoGroundTruth, record_jumps};
use twinstep_tests::resumable::{Step, number, print_result, read, text};

/// Compare ways of collecting data on hidden robots, by the error of the models on two held-out logs.
#[derive(Parser)]
struct Args {
    /// Folder of all results.
    #[arg(long)]
    out: PathBuf,
    /// Number of hidden robots.
    #[arg(long, default_value_t = 3)]
    robots: u64,
    /// Number of logs after the first one.
    #[arg(long, default_value_t = 4)]
    rounds: u32,
    /// Duration of each log [s].
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Command sequences that each design simulates.
    #[arg(long, default_value_t = 300)]
    candidates: u32,
    /// Methods: `random`, a criterion of `twinstep excite`, and `uncertainty`: the exploration policy of U2E.
    #[arg(long, value_delimiter = ',', default_value = "random,trace,d-optimal,qoed,uncertainty")]
    methods: Vec<String>,
}

impl Args {
    fn collection(&self) -> Collection {
        let Self { rounds, seconds, candidates, .. } = *self;
        Collection { rounds, seconds, segment_s: SEGMENT_S, candidates }
    }
}

/// Duration of a velocity command [s].
const SEGMENT_S: f64 = 2.5;
/// Jumps in a held-out log.
const JUMPS: u64 = 12;
/// Held-out logs.
const LOGS: [&str; 2] = ["walking", "jumps"];
/// Settings of the ensembles and exploration policies of `uncertainty`.
const U2E: &str = "[fit]\nmembers = 4\nepochs = 20\n[explore]\nmax_residual = 0.5\nuncertainty_weight = 40.0\n\
                   [train]\ntotal_steps = 1000000\n";
/// Width and height of the figure [px].
const SIZE: (u32, u32) = (1200, 480);
const COLOURS: [RGBColor; 5] = [
    RGBColor(0x26, 0x26, 0x26),
    RGBColor(0xff, 0x6a, 0x13),
    RGBColor(0x1f, 0x77, 0xb4),
    RGBColor(0x2c, 0xa0, 0x2c),
    RGBColor(0x94, 0x67, 0xbd),
];

fn main() -> ExitCode {
    print_result(campaign(&Args::parse()))
}

fn campaign(args: &Args) -> Step<String> {
    let mut errors = Vec::new();
    for seed in 1..=args.robots {
        let hidden = MujocoGroundTruth::new(&args.out, seed, EffectSet::A)?;
        if !hidden.commands.path("held-out").exists() {
            let (_server, endpoint) = hidden.serve("jump")?;
            record_jumps(&hidden.commands, &endpoint, JUMPS)?;
        }
        let (_server, endpoint) = hidden.serve("walk")?;
        // The other methods use its first log and its held-out log.
        hidden.identify("random", args.collection(), seed, &endpoint)?;
        let of_method = |method: &String| robot_errors(args, &hidden, method, seed, &endpoint);
        errors.push(args.methods.iter().map(of_method).collect::<Step<Vec<_>>>()?);
        std::fs::write(args.out.join("robot-time.svg"), figure(args, &errors)?).map_err(text)?;
    }
    Ok(table(args, &errors))
}

/// Errors of the models after each log, by held-out log [rad].
type Errors = Vec<[f64; 2]>;

/// Collects logs with a method and identifies the robot after each of them. Returns the errors of the models.
fn robot_errors(args: &Args, hidden: &MujocoGroundTruth, method: &str, seed: u64, endpoint: &str) -> Step<Errors> {
    let models = if method == "uncertainty" {
        explored(args, hidden, seed, endpoint)?
    } else {
        hidden.identify(method, args.collection(), seed, endpoint)?;
        let later = if method == "random" { "random" } else { "active" };
        let stage = |number: u32| format!("{number}-{}", if number == 1 { "random" } else { later });
        (1..=args.rounds + 1)
            .map(|number| hidden.commands.path(method).join(stage(number)).join("model.toml"))
            .collect()
    };
    let logs = [hidden.commands.path("random/held-out/log"), hidden.commands.path("held-out")];
    let error = |model: &Path, log: usize| -> Step<f64> {
        let result = model.with_extension(format!("{}.json", LOGS[log]));
        if !result.exists() {
            let [model, log] = [model, &logs[log]].map(|path| path.display().to_string());
            let json = hidden.commands.run(&["evaluate", "--model", &model, &log, "--json"])?;
            std::fs::write(&result, json).map_err(text)?;
        }
        Ok(number(&read(&result)?["q_rmse_rad"]))
    };
    models.iter().map(|model| Ok([error(model, 0)?, error(model, 1)?])).collect()
}

/// Collects logs with exploration policies of U2E, and identifies the same unknowns from them. Returns the models.
fn explored(args: &Args, hidden: &MujocoGroundTruth, seed: u64, endpoint: &str) -> Step<Vec<PathBuf>> {
    let config = hidden.commands.path("uncertainty.toml");
    let Args { rounds, seconds, .. } = args;
    let settings = format!(
        "policy = \"data/policies/walk.safetensors\"\nendpoint = \"{endpoint}\"\nmethod = \"explore\"\nstop = \"never\"\n\
         fast = true\nseed = {seed}\niterations = {rounds}\nseconds = {seconds:?}\nsegment_s = {SEGMENT_S:?}\n{U2E}"
    );
    std::fs::write(&config, settings).map_err(text)?;
    hidden.commands.run(&["u2e", &config.display().to_string()])?;
    let folder = hidden.commands.path("uncertainty");
    let (mut logs, mut models) = (Vec::new(), Vec::<PathBuf>::new());
    for log in 0..=*rounds {
        let name = if log == 0 { "base" } else { "explore" };
        let without = folder.join(format!("log-{log}-without-torques.parquet"));
        write_without_torques(&folder.join(format!("{log}-{name}/log")), &without)?;
        logs.push(without.display().to_string());
        let model = folder.join(format!("model-{log}.toml"));
        if !model.exists() {
            let partial = folder.join(format!("model-{log}.partial.toml"));
            let (effects, out, seed) =
                (EffectSet::A.unknowns().join(","), partial.display().to_string(), seed.to_string());
            let mut arguments = vec!["identify"];
            arguments.extend(logs.iter().map(String::as_str));
            arguments.extend(["--effects", &effects, "--seed", &seed, "--out", &out]);
            let start = models.last().map(|model| model.display().to_string());
            arguments.extend(start.iter().flat_map(|start| ["--start", start]));
            hidden.commands.run(&arguments)?;
            std::fs::rename(&partial, &model).map_err(text)?;
        }
        models.push(model);
    }
    Ok(models)
}

/// Writes a log without its torques, which the logs of the other methods do not have.
fn write_without_torques(from: &Path, to: &Path) -> Step {
    if to.exists() {
        return Ok(());
    }
    let log = Log::open(from).map_err(text)?;
    let meta = Meta { tau_sensor: TorqueSensor::None, ..log.meta().clone() };
    let column = |name: &str, cells: Vec<f64>| (name.to_owned(), cells);
    let segment = log.segment().iter().map(|segment| f64::from(*segment)).collect();
    let times = [column("t", log.t().to_vec()), column("segment", segment)];
    let others = log.channels().filter(|(name, _)| !name.starts_with("tau_measured"));
    let columns = times.into_iter().chain(others.map(|(name, cells)| column(name, cells.to_vec())));
    Log::new(meta, columns).map_err(text)?.write(to).map_err(text)
}

/// Returns the errors of a method after a log, by robot [rad].
fn by_robot(errors: &[Vec<Errors>], method: usize, stage: usize, log: usize) -> Vec<f64> {
    errors.iter().map(|robot| robot[method][stage][log]).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Returns the table: for each held-out log, the mean error by method and robot time, with the errors by robot at the end.
fn table(args: &Args, errors: &[Vec<Errors>]) -> String {
    let mut table = String::new();
    for (log, name) in LOGS.iter().enumerate() {
        let times = (1..=args.rounds + 1).map(|stage| format!(" {:.0} s |", f64::from(stage) * args.seconds));
        let _ = writeln!(
            table,
            "\nHeld-out {name}, joint position, RMSE [mrad]\n\n| method |{} by robot, at the end |",
            times.collect::<String>()
        );
        let _ = writeln!(table, "|---|{}---|", "---|".repeat(args.rounds as usize + 1));
        for (method, name) in args.methods.iter().enumerate() {
            let stages = (0..=args.rounds as usize).map(|stage| by_robot(errors, method, stage, log));
            let cells: Vec<String> = stages.map(|values| format!("{:.1}", 1e3 * mean(&values))).collect();
            let last = by_robot(errors, method, args.rounds as usize, log);
            let last: Vec<String> = last.iter().map(|error| format!("{:.1}", 1e3 * error)).collect();
            let _ = writeln!(table, "| {name} | {} | {} |", cells.join(" | "), last.join(", "));
        }
    }
    table
}

/// Returns the figure: the mean error over robot time, a panel for each held-out log and a line for each method.
fn figure(args: &Args, errors: &[Vec<Errors>]) -> Step<String> {
    let stages = args.rounds as usize + 1;
    let panel = |log: usize| {
        let line = |method: usize| {
            let point =
                |stage: usize| ((stage + 1) as f64 * args.seconds, 1e3 * mean(&by_robot(errors, method, stage, log)));
            Line { colour: COLOURS[method % COLOURS.len()], width: 5, pieces: vec![(0..stages).map(point).collect()] }
        };
        let lines: Vec<Line> = (0..args.methods.len()).map(line).collect();
        let highest = lines.iter().flat_map(|line| &line.pieces[0]).map(|(_, error)| *error).fold(0.0, f64::max);
        Panel {
            caption: format!("held-out {}", LOGS[log]),
            x_label: "robot time [s]",
            y_label: "joint position, RMSE [mrad]",
            x: 0.0..stages as f64 * args.seconds,
            y: 0.0..1.1 * highest,
            lines,
        }
    };
    let names: Vec<(&str, RGBColor)> =
        args.methods.iter().map(String::as_str).zip(COLOURS.into_iter().cycle()).collect();
    let svg = chart::picture(SIZE, |root| {
        let (header, rest) = root.split_vertically(90);
        chart::legend(&header, &names, 440, (160, 50))?;
        for (log, area) in rest.split_evenly((1, LOGS.len())).iter().enumerate() {
            panel(log).draw(area)?;
        }
        Ok(())
    });
    svg.map_err(text)
}
