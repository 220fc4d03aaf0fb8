//! Error of identified models, and of policies that are fine-tuned on them, against robot time, for several ways of choosing the
//! motions.
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
use twinstep_tests::fine_tuning::{FineTuning, TASKS};
use twinstep_tests::mujoco_ground_truth::{Collection, EffectSet, MujocoGroundTruth, record_jumps};
use twinstep_tests::resumable::{Resumable, Step, number, print_result, read, text};

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
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Duration of each log [s].
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Command sequences that each design simulates.
    #[arg(long, default_value_t = 300)]
    candidates: u32,
    /// Environment steps of the fine-tuning of the policy `jump` on the first and the last model of each method; 0: none.
    #[arg(long, default_value_t = 5_000_000)]
    tune_steps: u64,
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
/// Simulated robots of the evaluation of a policy.
const EVALUATED: u32 = 8;
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
        let of_method = |method: &String| {
            let models = models(args, &hidden, method, seed, &endpoint)?;
            Ok(Errors {
                q_rmse: models.iter().map(|model| held_out_errors(&hidden, model)).collect::<Step<_>>()?,
                landing: landings(args, &hidden, method, seed, &models)?,
            })
        };
        errors.push(args.methods.iter().map(of_method).collect::<Step<Vec<_>>>()?);
        std::fs::write(args.out.join("robot-time.svg"), figure(args, &errors)?).map_err(text)?;
    }
    Ok(table(args, &errors))
}

/// Errors of a method on a robot.
struct Errors {
    /// Error of the joint position of the model after each log, by held-out log [rad].
    q_rmse: Vec<[f64; 2]>,
    /// Landings of the policies that were fine-tuned on the first and the last model; empty without fine-tuning.
    landing: Vec<Landing>,
}

/// Landings of a policy on the robot.
struct Landing {
    /// Mean error of those that landed [m].
    error: f64,
    /// Share of the jumps that landed.
    landed: f64,
}

/// Collects logs with a method and identifies the robot after each of them. Returns the models.
fn models(args: &Args, hidden: &MujocoGroundTruth, method: &str, seed: u64, endpoint: &str) -> Step<Vec<PathBuf>> {
    if method == "uncertainty" {
        return explored(args, hidden, seed, endpoint);
    }
    hidden.identify(method, args.collection(), seed, endpoint)?;
    let later = if method == "random" { "random" } else { "active" };
    let stage = |number: u32| format!("{number}-{}", if number == 1 { "random" } else { later });
    let model = |number| hidden.commands.path(method).join(stage(number)).join("model.toml");
    Ok((1..=args.rounds + 1).map(model).collect())
}

/// Returns the error of the joint position on both held-out logs [rad].
fn held_out_errors(hidden: &MujocoGroundTruth, model: &Path) -> Step<[f64; 2]> {
    let logs = [hidden.commands.path("random/held-out/log"), hidden.commands.path("held-out")];
    let error = |log: usize| -> Step<f64> {
        let result = model.with_extension(format!("{}.json", LOGS[log]));
        if !result.exists() {
            let [model, log] = [model, &logs[log]].map(|path| path.display().to_string());
            let json = hidden.commands.run(&["evaluate", "--model", &model, &log, "--json"])?;
            std::fs::write(&result, json).map_err(text)?;
        }
        Ok(number(&read(&result)?["q_rmse_rad"]))
    };
    Ok([error(0)?, error(1)?])
}

/// Continues the training of the nominal policy `jump` on the first and the last model. Returns the landings on the robot.
fn landings(
    args: &Args,
    hidden: &MujocoGroundTruth,
    method: &str,
    seed: u64,
    models: &[PathBuf],
) -> Step<Vec<Landing>> {
    if args.tune_steps == 0 {
        return Ok(Vec::new());
    }
    let task = TASKS.iter().find(|task| task.name == "jump").expect("a task");
    let tuning = FineTuning { robot: hidden, steps: args.tune_steps, evaluated: EVALUATED, seed };
    let start = Resumable::new(&args.out)?.nominal(task.name)?;
    let landing = |name: &str, model: &Path| -> Step<Landing> {
        let policy = tuning.train(task, name, Some(model), "", &start)?;
        let target = &tuning.evaluate(task, name, &policy)?["rows"][0]["targets"][0];
        Ok(Landing { error: number(&target["l_jump"]), landed: number(&target["landed"]) })
    };
    // All but `uncertainty` have the first log of `random`, and its model.
    let of_first = if method == "uncertainty" { method } else { "random" };
    let [first, last] = [&models[0], &models[models.len() - 1]];
    Ok(vec![landing(&format!("{of_first}-first-jump"), first)?, landing(&format!("{method}-last-jump"), last)?])
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

/// Returns an error of a method by robot.
fn by_robot(errors: &[Vec<Errors>], method: usize, error: impl Fn(&Errors) -> f64) -> Vec<f64> {
    errors.iter().map(|robot| error(&robot[method])).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Returns the tables: for each held-out log, the mean error by method and robot time, with the errors by robot at the end, and the
/// landing errors of the policies.
fn table(args: &Args, errors: &[Vec<Errors>]) -> String {
    let mut table = String::new();
    for (log, name) in LOGS.iter().enumerate() {
        let times: Vec<String> =
            (1..=args.rounds + 1).map(|stage| format!("{:.0} s", f64::from(stage) * args.seconds)).collect();
        let _ = writeln!(table, "\nHeld-out {name}, joint position, RMSE [mrad]");
        rows(args, errors, &times, &mut table, |errors, stage| 1e3 * errors.q_rmse[stage][log]);
    }
    if args.tune_steps > 0 {
        let ends = ["first model", "last model"].map(str::to_owned);
        let _ = writeln!(table, "\nLanding error of a jump of 0.85 m after fine-tuning [mm]");
        rows(args, errors, &ends, &mut table, |errors, end| 1e3 * errors.landing[end].error);
        let landed = errors.iter().flatten().flat_map(|errors| &errors.landing).map(|landing| landing.landed);
        let _ = writeln!(
            table,
            "\nLanded: at least {:.0} % of the jumps of each policy",
            100.0 * landed.fold(1.0, f64::min)
        );
    }
    table
}

/// Adds a table with a row for each method: the mean error in each column, and the errors by robot in the last one.
fn rows(
    args: &Args,
    errors: &[Vec<Errors>],
    columns: &[String],
    table: &mut String,
    error: impl Fn(&Errors, usize) -> f64,
) {
    let _ = writeln!(table, "\n| method | {} | by robot, at the end |", columns.join(" | "));
    let _ = writeln!(table, "|---|{}---|", "---|".repeat(columns.len()));
    let list = |values: &[f64], separator: &str| {
        values.iter().map(|value| format!("{value:.1}")).collect::<Vec<_>>().join(separator)
    };
    for (method, name) in args.methods.iter().enumerate() {
        let columns: Vec<Vec<f64>> =
            (0..columns.len()).map(|column| by_robot(errors, method, |errors| error(errors, column))).collect();
        let means: Vec<f64> = columns.iter().map(|values| mean(values)).collect();
        let _ = writeln!(table, "| {name} | {} | {} |", list(&means, " | "), list(&columns[columns.len() - 1], ", "));
    }
}

/// Returns the figure: the mean errors over robot time, a panel for each held-out log and one for the policies, and a line for
/// each method.
fn figure(args: &Args, errors: &[Vec<Errors>]) -> Step<String> {
    let stages = args.rounds as usize + 1;
    let panel = |caption: String, y_label, columns: &[usize], error: &dyn Fn(&Errors, usize) -> f64| {
        let line = |method: usize| {
            let point = |(index, stage): (usize, &usize)| {
                let values = by_robot(errors, method, |errors| error(errors, index));
                ((stage + 1) as f64 * args.seconds, 1e3 * mean(&values))
            };
            let pieces = vec![columns.iter().enumerate().map(point).filter(|(_, error)| error.is_finite()).collect()];
            Line { colour: COLOURS[method % COLOURS.len()], width: 5, pieces }
        };
        let lines: Vec<Line> = (0..args.methods.len()).map(line).collect();
        let highest = lines.iter().flat_map(|line| &line.pieces[0]).map(|(_, error)| *error).fold(0.0, f64::max);
        let (x, y) = (0.0..stages as f64 * args.seconds, 0.0..1.1 * highest);
        Panel { caption, x_label: "robot time [s]", y_label, x, y, lines }
    };
    let all: Vec<usize> = (0..stages).collect();
    let mut panels: Vec<Panel> = (0..LOGS.len())
        .map(|log| {
            let caption = format!("held-out {}", LOGS[log]);
            panel(caption, "joint position, RMSE [mrad]", &all, &|errors, stage| errors.q_rmse[stage][log])
        })
        .collect();
    if args.tune_steps > 0 {
        let caption = "jump of 0.85 m, fine-tuned policy".to_owned();
        panels.push(panel(caption, "landing error [mm]", &[0, stages - 1], &|errors, end| errors.landing[end].error));
    }
    let names: Vec<(&str, RGBColor)> =
        args.methods.iter().map(String::as_str).zip(COLOURS.into_iter().cycle()).collect();
    let svg = chart::picture((600 * panels.len() as u32, 480), |root| {
        let (header, rest) = root.split_vertically(90);
        chart::legend(&header, &names, 440, (160, 50))?;
        for (panel, area) in panels.iter().zip(rest.split_evenly((1, panels.len()))) {
            panel.draw(&area)?;
        }
        Ok(())
    });
    svg.map_err(text)
}
