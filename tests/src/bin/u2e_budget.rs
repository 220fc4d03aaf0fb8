//! Error of actuator models on held-out motion, and falls, against robot time, for three ways of collecting logs.
//!
//! `target/release/u2e_budget u2e-table/1 u2e-table/2 u2e-table/3 --out budget.svg` draws the logs of `u2e_table`, one folder for
//! each seed, and prints the table. Bold lines are means over the seeds, thin ones the seeds.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use twinstep_report::chart::{self, Line, Panel, RGBColor};
use twinstep_tests::resumable::{Step, number, print_result, read, text};

/// Draw error and falls against robot time.
#[derive(Parser)]
struct Args {
    /// Folders of `u2e_table`, one for each seed, with equal numbers and durations of logs.
    #[arg(required = true)]
    folders: Vec<PathBuf>,
    /// SVG file.
    #[arg(long)]
    out: PathBuf,
}

/// Ways of collecting logs: folder, name and colour.
const COLLECTIONS: [(&str, &str, RGBColor); 3] = [
    ("base", "base policy", RGBColor(0x26, 0x26, 0x26)),
    ("random", "base policy with action noise", RGBColor(0x1f, 0x77, 0xb4)),
    ("explore", "exploration by uncertainty", RGBColor(0xff, 0x6a, 0x13)),
];
/// Width and height of the figure [px].
const SIZE: (u32, u32) = (1200, 480);

/// What is known after a log.
#[derive(Clone, Copy)]
struct Stage {
    /// Robot time since the start [min].
    minutes: f64,
    /// Torque RMSE on held-out motion [N·m].
    error: f64,
    /// Falls since the start.
    falls: f64,
}

/// Stages of a seed, one after each log.
type Seed = Vec<Stage>;

fn main() -> ExitCode {
    print_result(run(&Args::parse()))
}

fn run(args: &Args) -> Step<String> {
    let of_collection = |collection: &str| args.folders.iter().map(|folder| seed(folder, collection)).collect();
    let seeds = COLLECTIONS.iter().map(|(name, ..)| of_collection(name)).collect::<Step<Vec<Vec<Seed>>>>()?;
    let stages = seeds[0][0].len();
    if stages == 0 || seeds.iter().flatten().any(|seed| seed.len() != stages) {
        return Err("the folders have no logs, or different numbers of them".to_owned());
    }
    chart::write(&figure(&seeds)?, &args.out).map_err(text)?;
    Ok(table(&seeds))
}

/// Reads the logs of one folder that were collected in one way.
fn seed(folder: &Path, collection: &str) -> Step<Seed> {
    let (mut minutes, mut falls, mut stages) = (0.0, 0.0, Seed::new());
    loop {
        let name = if stages.is_empty() { "base" } else { collection };
        let path = folder.join(collection).join(format!("{}-{name}/evaluation.json", stages.len()));
        if !path.exists() {
            return Ok(stages);
        }
        let found = read(&path)?;
        minutes += number(&found["collection"]["seconds"]) / 60.0;
        falls += number(&found["collection"]["falls"]);
        stages.push(Stage { minutes, error: number(&found["held_out"]["torque_rmse_nm"]), falls });
    }
}

fn mean(seeds: &[Seed], stage: usize, of: fn(Stage) -> f64) -> f64 {
    seeds.iter().map(|seed| of(seed[stage])).sum::<f64>() / seeds.len() as f64
}

/// Returns error and falls by robot time and collection, with those of each seed.
fn table(collections: &[Vec<Seed>]) -> String {
    let mut table =
        "| robot time [min] | collected by | held-out motion, torque RMSE by seed [N·m] | mean | falls by seed |\n\
                     |---|---|---|---|---|\n"
            .to_owned();
    for stage in 0..collections[0][0].len() {
        for ((_, name, _), seeds) in COLLECTIONS.iter().zip(collections) {
            let cells = |of: &dyn Fn(Stage) -> String| {
                seeds.iter().map(|seed| of(seed[stage])).collect::<Vec<String>>().join(", ")
            };
            let _ = writeln!(
                table,
                "| {:.2} | {name} | {} | {:.3} | {} |",
                seeds[0][stage].minutes,
                cells(&|stage| format!("{:.3}", stage.error)),
                mean(seeds, stage, |stage| stage.error),
                cells(&|stage| format!("{:.0}", stage.falls))
            );
        }
    }
    table
}

/// Returns the figure: error and falls over robot time.
fn figure(collections: &[Vec<Seed>]) -> Step<String> {
    let panel = |caption: &str, y_label: &'static str, of: fn(Stage) -> f64| {
        let of_collection = |((_, _, colour), seeds): (&(&str, &str, RGBColor), &Vec<Seed>)| {
            let each = seeds.iter().map(|seed| seed.iter().map(|stage| (stage.minutes, of(*stage))).collect());
            let stages = 0..seeds[0].len();
            let means = stages.map(|stage| (seeds[0][stage].minutes, mean(seeds, stage, of))).collect();
            [
                Line { colour: *colour, width: 2, pieces: each.collect() },
                Line { colour: *colour, width: 7, pieces: vec![means] },
            ]
        };
        let lines: Vec<Line> = COLLECTIONS.iter().zip(collections).flat_map(of_collection).collect();
        let points = || lines.iter().flat_map(|line| line.pieces.iter().flatten());
        Panel {
            caption: caption.to_owned(),
            x_label: "robot time [min]",
            y_label,
            x: 0.0..1.05 * points().map(|(minutes, _)| *minutes).fold(0.0, f64::max),
            y: 0.0..(1.1 * points().map(|(_, value)| *value).fold(0.0, f64::max)).max(0.1),
            lines,
        }
    };
    let panels = [
        panel("held-out motion", "torque, RMSE [N·m]", |stage| stage.error),
        panel("falls since the start", "falls", |stage| stage.falls),
    ];
    let names = COLLECTIONS.map(|(_, name, colour)| (name, colour));
    let svg = chart::picture(SIZE, |root| {
        let (header, rest) = root.split_vertically(90);
        chart::legend(&header, &names, 740, (160, 50))?;
        for (panel, area) in panels.iter().zip(rest.split_evenly((1, 2))) {
            panel.draw(&area)?;
        }
        Ok(())
    });
    svg.map_err(text)
}
