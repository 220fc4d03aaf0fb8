//! SPI-Active: collect, identify, design, collect, identify, report, in stages that can be resumed.

use std::path::{Path, PathBuf};

use crate::design::design;
use crate::failure::Failure;
use crate::identify::{identify, search_file};
use crate::observer::Observer;
use crate::spi_active_config::{Method, SpiActiveConfig};
use crate::spi_active_report::{self, RobotTime, StageResult};
use crate::stages;

/// Seed of the held-out commands minus that of the config.
const HELD_OUT_SEED: u64 = 1_000_000;

/// Runs the two stages of SPI-Active with the settings of a config file, as far as they are not complete. Returns the report.
///
/// ```no_run
/// use twinstep_workflows::{Observer, spi_active};
///
/// print!("{}", spi_active("spi.toml".as_ref(), &Observer::silent())?);
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn spi_active(config: &Path, observer: &Observer) -> Result<String, Failure> {
    let settings = SpiActiveConfig::load(config)?;
    let out = stages::folder_of(config)?;
    stages::keep_inputs(&out, settings.inputs()?)?;
    stages::ended(all_stages(&settings, &out, observer), observer)
}

fn all_stages(config: &SpiActiveConfig, out: &Path, observer: &Observer) -> Result<String, Failure> {
    let mut logs = Vec::new();
    let mut results = Vec::new();
    let mut model = config.model.clone();
    for round in 0..=config.rounds {
        let is_random = round == 0 || config.method == Method::Random;
        let stage = Stage::new(out, &format!("{}-{}", round + 1, if is_random { "random" } else { "active" }))?;
        observer.note(format_args!("\n{}: commands, log, model", stage.folder.display()));
        let seed = config.seed + round as u64;
        stage.commands(|path| match config.method.criterion().filter(|_| !is_random) {
            Some(criterion) => {
                let folder = path.parent().expect("a folder");
                let options = config.excitation(criterion, model.as_deref(), seed, folder);
                let designed = design(&options, observer)?;
                observer.note(designed.report.table(options.segment_s));
                if designed.is_interrupted { Err(Failure::Interrupted) } else { Ok(()) }
            }
            None => config.random_commands(model.as_deref(), seed).write(path, observer),
        })?;
        let robot_time = stage.collect(config, observer)?;
        logs.push(stage.log());
        stage.identify(config, &logs, results.last().map(|last: &StageResult| last.model.as_path()), observer)?;
        model = Some(stage.model());
        results.push(StageResult { name: stage.name.clone(), robot_time, model: stage.model() });
    }
    let held_out = Stage::new(out, "held-out")?;
    observer.note(format_args!("\n{}: commands, log", held_out.folder.display()));
    let commands = config.random_commands(config.model.as_deref(), config.seed + HELD_OUT_SEED);
    held_out.commands(|path| commands.write(path, observer))?;
    let robot_time = held_out.collect(config, observer)?;
    let report = spi_active_report::report(config, &results, &held_out.log(), robot_time, observer)?;
    stages::write(&out.join("report.md"), report.as_bytes())?;
    Ok(report)
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
    fn commands(&self, choose: impl FnOnce(&Path) -> Result<(), Failure>) -> Result<(), Failure> {
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
    fn collect(&self, config: &SpiActiveConfig, observer: &Observer) -> Result<RobotTime, Failure> {
        let (log, summary) = (self.log(), self.folder.join("run.json"));
        let commands = self.folder.join("commands.csv");
        let recording = |partial: &Path| config.recording(&commands, partial);
        stages::recorded((&log, &summary), config.seconds, recording, observer, |run, _| {
            Ok(RobotTime { seconds: run.seconds, falls: run.falls })
        })
    }

    /// Identifies the model from `logs`, unless it is there.
    fn identify(
        &self,
        config: &SpiActiveConfig,
        logs: &[PathBuf],
        earlier: Option<&Path>,
        observer: &Observer,
    ) -> Result<(), Failure> {
        let (model, partial) = (self.model(), self.folder.join("model.partial.toml"));
        if model.exists() {
            return Ok(());
        }
        let search = search_file(&partial);
        let found = identify(&config.identification(logs, earlier, &partial, search.exists()), observer)?;
        observer.note(found.text());
        if found.is_interrupted {
            return Err(Failure::Interrupted);
        }
        stages::complete(&partial, &model)
    }
}
