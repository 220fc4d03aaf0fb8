//! `twinstep spi-active`: collect, identify, design, collect, identify, report, as one resumable command.

use std::path::{Path, PathBuf};

use crate::exit::{CommandResult, Failure, Signals};
use crate::spi_active_config::{Method, SpiActiveConfig};
use crate::spi_active_report::{self, RobotTime, StageResult};
use crate::{excite, identify, stages};

/// Identify a robot with the two stages of SPI-Active: ordinary commands first, then designed ones.
///
/// The policy walks the robot at the endpoint, simulated or real. The folder of CONFIG, without its
/// extension, receives:
///
///   1-random    random velocity commands, their log, and the model that is identified from it
///   2-active    commands designed with that model, their log, and the model that is identified from both logs,
///               starting from the model before
///   3-active    and so on, as often as `rounds` says
///   held-out    random commands whose log is not used for identification: the models are compared on it
///   report.md   parameters with intervals, errors on the held-out log, robot time and falls
///
/// The same command continues after Ctrl-C or a crash: what a stage has completed is kept, and a
/// log that was interrupted is recorded again. The robot walks without a question as soon as a
/// stage needs a log, `room_m` around where it then stands.
///
/// CONFIG (TOML); `policy` and `unknowns` are required, the others have these defaults:
///
///   policy = "data/policies/walk.safetensors"
///   unknowns = ["payload@base", "coulomb_friction@calf"]   as of `twinstep identify --effects`
///   endpoint = "tcp/127.0.0.1:7447"
///   method = "d-optimal"      trace, d-optimal, qoed, or random: the later stages are like the first (SPI-Random)
///   of_interest = []          unknowns that matter for qoed; default: what random commands identify
///   rounds = 1                number of stages after the first
///   seconds = 25.0            duration of each log
///   segment_s = 5.0           duration of a command
///   candidates = 1000         command sequences that a design simulates
///   room_m = 3.0              largest distance from the start
///   fast = false              step a simulated robot as fast as it answers
///   seed = 1
///   robot, zenoh              as of `twinstep run`; without a default
///   model                     model file to start from; default: the ideal Go2
///
/// Example: `twinstep serve --envs 1 --model hidden.toml` and, in another terminal, `twinstep
/// spi-active spi.toml`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
#[allow(clippy::doc_link_with_quotes, reason = "it is TOML")]
pub struct Args {
    /// Config file (TOML).
    config: PathBuf,
}

/// Seed of the held-out commands minus that of the config.
const HELD_OUT_SEED: u64 = 1_000_000;

/// Runs the stages that are not complete.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen()?;
    let config = SpiActiveConfig::load(&args.config)?;
    let out = stages::folder_of(&args.config)?;
    stages::keep_inputs(&out, config.inputs()?)?;
    stages::ended(all_stages(&config, &out, &signals))
}

fn all_stages(config: &SpiActiveConfig, out: &Path, signals: &Signals) -> CommandResult {
    let mut logs = Vec::new();
    let mut results = Vec::new();
    let mut model = config.model.clone();
    for round in 0..=config.rounds {
        let is_random = round == 0 || config.method == Method::Random;
        let stage = Stage::new(out, &format!("{}-{}", round + 1, if is_random { "random" } else { "active" }))?;
        eprintln!("\n{}: commands, log, model", stage.folder.display());
        let seed = config.seed + round as u64;
        stage.commands(|path| match config.method.criterion().filter(|_| !is_random) {
            Some(criterion) => {
                let folder = path.parent().expect("a folder");
                excite::write_design(&config.excitation(criterion, model.as_deref(), seed, folder), signals)
            }
            None => config.random_commands(model.as_deref(), seed).write(path, signals),
        })?;
        let robot_time = stage.collect(config, signals)?;
        logs.push(stage.log());
        stage.identify(config, &logs, results.last().map(|last: &StageResult| last.model.as_path()), signals)?;
        model = Some(stage.model());
        results.push(StageResult { name: stage.name.clone(), robot_time, model: stage.model() });
    }
    let held_out = Stage::new(out, "held-out")?;
    eprintln!("\n{}: commands, log", held_out.folder.display());
    let commands = config.random_commands(config.model.as_deref(), config.seed + HELD_OUT_SEED);
    held_out.commands(|path| commands.write(path, signals))?;
    let robot_time = held_out.collect(config, signals)?;
    let report = spi_active_report::report(config, &results, &held_out.log(), robot_time)?;
    stages::write(&out.join("report.md"), report.as_bytes())?;
    print!("{report}");
    println!("\nwritten to {}", out.join("report.md").display());
    Ok(())
}

/// A stage and its files. A file exists only when it is complete.
struct Stage {
    name: String,
    folder: PathBuf,
}

impl Stage {
    fn new(out: &Path, name: &str) -> Result<Self, Failure> {
        let folder = out.join(name);
        stages::create_folder(&folder)?;
        Ok(Self { name: name.to_owned(), folder })
    }

    fn log(&self) -> PathBuf {
        self.folder.join("log")
    }

    fn model(&self) -> PathBuf {
        self.folder.join("model.toml")
    }

    /// Chooses the commands with `choose`, which writes them to a path, unless they are there.
    fn commands(&self, choose: impl FnOnce(&Path) -> CommandResult) -> CommandResult {
        let path = self.folder.join("commands.csv");
        if path.exists() {
            return Ok(());
        }
        let partial = self.folder.join("design.partial");
        stages::create_folder(&partial)?;
        choose(&partial.join("commands.csv"))?;
        for name in ["design.json", "commands.csv"] {
            let (from, to) = (partial.join(name), self.folder.join(name));
            if from.exists() {
                stages::complete(&from, &to)?;
            }
        }
        stages::discard(&partial)
    }

    /// Records the log, unless it is there.
    fn collect(&self, config: &SpiActiveConfig, signals: &Signals) -> Result<RobotTime, Failure> {
        let (log, summary) = (self.log(), self.folder.join("run.json"));
        let commands = self.folder.join("commands.csv");
        let recording = |partial: &Path| config.recording(&commands, partial);
        stages::recorded((&log, &summary), config.seconds, recording, signals, |run, _| {
            Ok(RobotTime { seconds: run.seconds, falls: run.falls })
        })
    }

    /// Identifies the model from `logs`, unless it is there.
    fn identify(
        &self,
        config: &SpiActiveConfig,
        logs: &[PathBuf],
        earlier: Option<&Path>,
        signals: &Signals,
    ) -> CommandResult {
        let (model, partial) = (self.model(), self.folder.join("model.partial.toml"));
        if model.exists() {
            return Ok(());
        }
        let search = identify::search_file(&partial);
        identify::write_model(&config.identification(logs, earlier, &partial, search.exists()), signals)?;
        stages::complete(&partial, &model)
    }
}
