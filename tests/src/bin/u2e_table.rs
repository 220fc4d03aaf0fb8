//! U2E on a hidden robot in MuJoCo: actuator models for equal robot time, then two tasks on the models, judged on the robot.
//!
//! `cargo build --release --workspace && target/release/u2e_table --out u2e-table`. Needs Python with the package's extra
//! `mujoco`; `TWINSTEP_PYTHON` is its interpreter. Each step is a command of `twinstep` whose result is kept, so that the
//! same command continues after an interruption. `ledger.csv` has the command and the time of each step.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use twinstep_effects::ModelFile;
use twinstep_ensemble::check_effects;
use twinstep_logs::TorqueSensor;
use twinstep_tests::mujoco_ground_truth::{record_jumps, serve};
use twinstep_tests::python::root;
use twinstep_tests::resumable::{Resumable, Step, number, print_result, read, text};

/// Compare methods on a hidden robot, for one seed.
#[derive(Parser)]
struct Args {
    /// Folder of all results.
    #[arg(long)]
    out: PathBuf,
    /// Model file of the hidden robot. Default: examples/u2e/hidden.toml.
    #[arg(long)]
    hidden: Option<PathBuf>,
    /// Seed of commands, networks and trainings.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Logs after the first one.
    #[arg(long, default_value_t = 2)]
    iterations: usize,
    /// Duration of each log [s].
    #[arg(long, default_value_t = 40)]
    seconds: u64,
    /// Members of the ensembles.
    #[arg(long, default_value_t = 4)]
    members: usize,
    /// Maximum number of epochs of a fit.
    #[arg(long, default_value_t = 20)]
    epochs: usize,
    /// Environment steps of the training of an exploration policy.
    #[arg(long, default_value_t = 1_000_000)]
    explore_steps: u64,
    /// Environment steps of the fine-tuning of each method.
    #[arg(long, default_value_t = 2_000_000)]
    tune_steps: u64,
    /// Engine of the evaluation of `track`; MuJoCo takes some minutes for each policy.
    #[arg(long, default_value = "mujoco")]
    track_engine: String,
    /// Duration of the evaluation of `track` [s].
    #[arg(long, default_value_t = 20)]
    track_seconds: u32,
    /// Robots of each evaluation.
    #[arg(long, default_value_t = 4)]
    robots: u32,
    /// End after the logs and their ensembles, without methods and tasks.
    #[arg(long)]
    collect_only: bool,
}

/// Ways of collecting logs that are compared on the held-out log.
const COLLECTIONS: [&str; 3] = ["explore", "random", "base"];
/// Methods whose policies are compared.
const METHODS: [&str; 5] = ["vanilla", "single", "u2e", "laws", "ours"];
/// Tasks, with the settings of their fine-tuning.
const TASKS: [(&str, &str); 2] = [("jump", "target_x_m = [0.6, 0.6]\n"), ("track", "")];
/// Jumps in the held-out log.
const JUMPS: u64 = 12;
/// Effects that the method `laws` identifies.
const LAWS: &str = "command_delay@all,drive_lag@all,torque_saturation@all,torque_speed_limit@all,torque_gain@all,\
                    viscous_friction@all,coulomb_friction@all,payload@base";
/// Rows from which they are identified [s].
const LAWS_UNTIL: &str = "12";

fn main() -> ExitCode {
    print_result(Campaign::new(Args::parse()).and_then(|campaign| campaign.run()))
}

/// The steps and their folder.
struct Campaign {
    args: Args,
    commands: Resumable,
    hidden: PathBuf,
}

impl Campaign {
    fn new(mut args: Args) -> Step<Self> {
        args.hidden = args.hidden.map(std::path::absolute).transpose().map_err(text)?;
        let commands = Resumable::new(&args.out)?;
        let hidden = args.hidden.clone().unwrap_or_else(|| root().join("examples/u2e/hidden.toml"));
        Ok(Self { args, commands, hidden })
    }

    fn run(&self) -> Step<String> {
        self.collect()?;
        if self.args.collect_only {
            return self.table_of_logs();
        }
        self.models()?;
        for (task, settings) in TASKS {
            let start = self.commands.nominal(task)?;
            self.evaluate(task, "start", &start.join("policy.safetensors"))?;
            for method in METHODS {
                self.tune(task, settings, method, &start)?;
                let policy = self.path(&format!("{method}-{task}/policy.safetensors"));
                self.evaluate(task, method, &policy)?;
            }
        }
        Ok(self.table_of_logs()? + &self.table_of_tasks()?)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.commands.path(name)
    }

    fn seed(&self) -> String {
        self.args.seed.to_string()
    }

    /// Records the held-out jumps, then runs the loop for each way of collecting logs.
    fn collect(&self) -> Step {
        if !self.path("held-out").exists() {
            let (_server, endpoint) = serve(&self.commands, "jump", &self.hidden)?;
            record_jumps(&self.commands, &endpoint, JUMPS)?;
        }
        let (_server, endpoint) = serve(&self.commands, "walk", &self.hidden)?;
        for method in COLLECTIONS {
            let config = self.path(&format!("{method}.toml"));
            std::fs::write(&config, self.config(method, &endpoint)).map_err(text)?;
            self.commands.run(&["u2e", &config.display().to_string()])?;
        }
        Ok(())
    }

    fn config(&self, method: &str, endpoint: &str) -> String {
        let Args { seed, iterations, seconds, members, epochs, explore_steps, .. } = &self.args;
        let held_out = self.path("held-out").display().to_string();
        format!(
            "policy = \"data/policies/walk.safetensors\"\nendpoint = \"{endpoint}\"\nmethod = \"{method}\"\nstop = \"never\"\n\
             held_out = {held_out:?}\nfast = true\nseed = {seed}\niterations = {iterations}\nseconds = {seconds}.0\n\
             [fit]\nmembers = {members}\nepochs = {epochs}\n[explore]\nmax_residual = 0.5\nuncertainty_weight = 40.0\n[train]\ntotal_steps = {explore_steps}\n"
        )
    }

    /// Writes the models on which the methods train; that of U2E is there.
    ///
    /// `laws` has identified effects alone. `ours` has those behind the torque sensor, and the networks of U2E before it.
    fn models(&self) -> Step {
        let logs = |method: &str| -> Vec<String> {
            let name = |iteration: usize| if iteration == 0 { "base" } else { method };
            let log = |iteration: usize| self.path(method).join(format!("{iteration}-{}/log", name(iteration)));
            (0..=self.args.iterations).map(|iteration| log(iteration).display().to_string()).collect()
        };
        let single = self.path("single.safetensors");
        let (logs_of_random, epochs) = (logs("random"), self.args.epochs.to_string());
        let mut fit: Vec<&str> = vec!["fit"];
        fit.extend(logs_of_random.iter().map(String::as_str));
        let seed = self.seed();
        fit.extend(["--members", "1", "--epochs", &epochs, "--seed", &seed]);
        self.commands.step(&single, &fit, &single)?;
        std::fs::write(self.path("single.toml"), "robot = \"go2\"\n[actuator]\nensemble = \"single.safetensors\"\n")
            .map_err(text)?;
        let (laws, partial) = (self.path("laws.toml"), self.path("laws.partial.toml"));
        if !laws.exists() {
            let log = logs("explore").pop().ok_or("there is a log")?;
            let out = partial.display().to_string();
            let seed = self.seed();
            self.commands.run(&[
                "identify",
                &log,
                "--until",
                LAWS_UNTIL,
                "--effects",
                LAWS,
                "--seed",
                &seed,
                "--out",
                &out,
            ])?;
            std::fs::rename(&partial, &laws).map_err(text)?;
        }
        let mut ours = ModelFile::load(&laws).map_err(text)?;
        ours.effects.retain(|entry| {
            let alone = ModelFile { effects: vec![entry.clone()], ..ModelFile::default() };
            check_effects(&alone, TorqueSensor::MotorCurrent).is_ok()
        });
        ours.actuator = ModelFile::load(self.path("explore/robot.toml")).map_err(text)?.actuator;
        std::fs::write(self.path("ours.toml"), ours.to_toml()).map_err(text)
    }

    /// Continues a training on the model of a method.
    fn tune(&self, task: &str, settings: &str, method: &str, start: &Path) -> Step {
        let out = self.path(&format!("{method}-{task}"));
        let config = self.path(&format!("{method}-{task}.toml"));
        let vanilla = std::fs::read_to_string(root().join("examples/u2e/vanilla.toml")).map_err(text)?;
        let randomise = if method == "vanilla" { vanilla } else { String::new() };
        std::fs::write(&config, format!("[task]\nname = \"{task}\"\n{settings}{randomise}")).map_err(text)?;
        let model = match method {
            "single" => Some(self.path("single.toml")),
            "u2e" => Some(self.path("explore/robot.toml")),
            "laws" | "ours" => Some(self.path(&format!("{method}.toml"))),
            _ => None,
        };
        let from = start.join("checkpoint.safetensors").display().to_string();
        let (config, steps, seed) = (config.display().to_string(), self.args.tune_steps.to_string(), self.seed());
        let mut arguments =
            vec!["train", task, "--config", &config, "--from", &from, "--steps", &steps, "--seed", &seed];
        let model = model.map(|path| path.display().to_string());
        arguments.extend(model.iter().flat_map(|model| ["--model", model.as_str()]));
        self.commands.step(&out.join("evaluation.json"), &arguments, &out)
    }

    /// Evaluates a policy on the hidden robot.
    fn evaluate(&self, task: &str, method: &str, policy: &Path) -> Step {
        let result = self.path(&format!("{method}-{task}.json"));
        if result.exists() {
            return Ok(());
        }
        let [policy, hidden] = [policy, &self.hidden].map(|path| path.display().to_string());
        let (engine, seconds) = match task {
            "track" => (self.args.track_engine.as_str(), self.args.track_seconds),
            _ => ("mujoco", 3),
        };
        let (robots, seconds) = (self.args.robots.to_string(), seconds.to_string());
        let json = self.commands.run(&[
            "evaluate-policy",
            &policy,
            "--engine",
            engine,
            "--model",
            &hidden,
            "--condition",
            "nominal",
            "--robots",
            &robots,
            "--seconds",
            &seconds,
            "--json",
        ])?;
        std::fs::write(&result, json).map_err(text)
    }

    /// Returns the errors of the ensembles after each log.
    fn table_of_logs(&self) -> Step<String> {
        let mut table =
            "| collection | robot time [min] | falls | torques at the limit | uncertainty of the new log [nat] | \
                         held-out jumps: torque RMSE [N·m] | uncertainty [nat] |\n|---|---|---|---|---|---|---|\n"
                .to_owned();
        for method in COLLECTIONS {
            for iteration in 0..=self.args.iterations {
                let name = if iteration == 0 { "base" } else { method };
                let found = read(&self.path(method).join(format!("{iteration}-{name}/evaluation.json")))?;
                let minutes = (iteration as u64 + 1) as f64 * self.args.seconds as f64 / 60.0;
                let (collection, held_out) = (&found["collection"], &found["held_out"]);
                let _ = writeln!(
                    table,
                    "| {method} | {minutes:.2} | {} | {:.2} % | {} | {:.3} | {:.4} |",
                    collection["falls"],
                    100.0 * number(&collection["torque_limit_share"]),
                    found["uncertainty"].as_f64().map_or("-".to_owned(), |value| format!("{value:.4}")),
                    number(&held_out["torque_rmse_nm"]),
                    number(&held_out["uncertainty_nat"])
                );
            }
        }
        Ok(table)
    }

    /// Returns the results of the policies.
    fn table_of_tasks(&self) -> Step<String> {
        let mut table = String::from(
            "\n| method | L_track, circle | without motion capture | up | jump of 0.6 m: landing error [m] | mean error [m] | landed |\n|---|---|---|---|---|---|---|\n",
        );
        for method in ["start"].iter().chain(&METHODS) {
            let track = read(&self.path(&format!("{method}-track.json")))?;
            let jump = read(&self.path(&format!("{method}-jump.json")))?;
            // The middle of the trained range of the start; the others have one target.
            let targets = jump["rows"][0]["targets"].as_array().ok_or("an evaluation of jumps")?;
            let (paths, jumps) = (&track["rows"][0]["paths"], &targets[targets.len() / 2]);
            let _ = writeln!(
                table,
                "| {method} | {:.3} | {:.3} | {:.0} % | {:.3} | {:+.3} | {:.0} % |",
                number(&paths[0]["l_track"]),
                number(&paths[3]["l_track"]),
                100.0 * number(&paths[0]["up"]),
                number(&jumps["l_jump"]),
                number(&jumps["mean_error"]),
                100.0 * number(&jumps["landed"])
            );
        }
        Ok(table)
    }
}
