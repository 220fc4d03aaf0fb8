//! `twinstep run`: runs a policy on a robot and records a log.

use std::path::{Path, PathBuf};

use serde::Serialize;
use twinstep_agent::{
    AgentError, BoundPolicy, Control, JointRecorder, LoadedPolicy, Recorder, Recorders, RunPlan, RunSummary, Status,
    WantedCommands, run as run_policy,
};
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_excite::CommandSequence;
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv};

use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::run_view::RunView;
use crate::status_line::StatusLine;
use crate::velocity_input::VelocityInput;
use crate::web_view::ViewArgs;

/// Run a policy on a robot, simulated or real, and record a log.
///
/// POLICY is a policy of `twinstep train` (policy.safetensors or policy.onnx), or the ONNX file of another program with a
/// mapping: order of the joints, scales, default pose, history (docs/run.md). Before the first action it is compared with
/// the robot: observations, gains, rates, default pose. If they differ, nothing is sent.
///
/// Steps follow real time. After a fall the robot is reset and the run goes on. It ends after --seconds, with q or Esc on
/// the keyboard, or with Ctrl-C. The log in DIR (docs/logs.md) has the rate of the policy, and a row for every executed step
/// however the run ends.
///
/// Keys: W S or up down: forward, backward; A D: left, right; left right: turn; space: stop; q or Esc: end.
/// Gamepad: left stick forward, backward, left, right; right stick: turn. With --view and no other velocity command, the page
/// has sliders for it; before they are moved, the endpoint's own commands hold.
///
/// Examples: `twinstep run data/policies/walk.safetensors --velocity 0.5,0,0 --seconds 20 --log walk` and
/// `twinstep run policy.onnx --mapping data/policies/mappings/isaaclab_go2_flat.toml --keyboard`
#[derive(clap::Args)]
#[allow(clippy::struct_excessive_bools, reason = "each is a flag of the command")]
pub struct Args {
    /// Policy: *.safetensors or *.onnx.
    pub policy: PathBuf,
    /// Mapping of the ONNX file of another program (TOML).
    #[arg(long, value_name = "FILE")]
    pub mapping: Option<PathBuf>,
    /// Zenoh endpoint of the robot or of a server.
    #[arg(long, value_name = "ENDPOINT", default_value = "tcp/127.0.0.1:7447")]
    pub endpoint: String,
    /// Name of the robot, if several are visible.
    #[arg(long, value_name = "NAME")]
    pub robot: Option<String>,
    /// Zenoh configuration file (JSON5) for TLS, user and password.
    #[arg(long, value_name = "FILE")]
    pub zenoh: Option<PathBuf>,
    /// Folder of the log, which must not exist or be empty. Default: no log.
    #[arg(long, value_name = "DIR")]
    pub log: Option<PathBuf>,
    /// Record the log at the rate of the actuators (200 Hz) and with the measured torques, as `twinstep fit` needs it.
    #[arg(long, requires = "log")]
    pub torque: bool,
    /// Constant velocity command: forward [m/s], left [m/s], yaw rate [rad/s]. Default: the endpoint's own commands.
    #[arg(long, value_name = "VX,VY,WZ", value_parser = velocity, allow_hyphen_values = true)]
    pub velocity: Option<[f32; 3]>,
    /// Follow the commands in this file (CSV: start_s,end_s,vx,vy,wz), as `twinstep excite` writes it. For a policy of
    /// `gait` it may also have the columns step_frequency,phase_fr,phase_rl,phase_rr. The run ends with the last one.
    #[arg(long, value_name = "FILE", conflicts_with = "velocity")]
    pub commands: Option<PathBuf>,
    /// Take the velocity command from the keyboard.
    #[arg(long, conflicts_with_all = ["velocity", "commands"])]
    pub keyboard: bool,
    /// Take the velocity command from a gamepad. Default device: /dev/input/js0.
    #[arg(long, value_name = "DEVICE", num_args = 0..=1, default_missing_value = "/dev/input/js0", conflicts_with_all = ["velocity", "commands", "keyboard"])]
    pub gamepad: Option<PathBuf>,
    /// Time after which the run ends [s]. Default: when it is ended.
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub seconds: Option<f64>,
    /// Add Gaussian noise of this standard deviation to every action, in units of `action_scale`: random excitation of the
    /// joints.
    #[arg(long, value_name = "STD", default_value_t = 0.0)]
    pub action_noise: f64,
    /// After a fault of a real robot, wait until its operator makes it stand and says `go`, and continue. Default: the run
    /// ends with the fault.
    #[arg(long)]
    pub go_on: bool,
    /// Step as fast as the endpoint answers. Default: in real time.
    #[arg(long)]
    pub fast: bool,
    /// Seed of the robot's random numbers: initial pose, own commands.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Print the summary as one JSON object on stdout.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub view: ViewArgs,
}

/// Output of `--json`.
#[derive(Serialize)]
struct Report<'a> {
    policy: &'a PathBuf,
    endpoint: &'a str,
    robot: &'a str,
    task: &'a str,
    #[serde(flatten)]
    summary: &'a RunSummary,
}

/// Source of the velocity command.
enum Velocity {
    Endpoint,
    Constant([f32; 3]),
    Sequence(CommandSequence),
    Person(VelocityInput),
}

/// What a run needs beside the robot.
struct Prepared {
    policy: BoundPolicy,
    recorder: Option<Recorder>,
    joints: Option<JointRecorder>,
    velocity: Velocity,
    view: Option<RunView>,
}

/// Runs the policy and prints the summary.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen()?;
    let Recording { robot, task, summary } = record(args, &signals)?;
    if args.json {
        let report =
            Report { policy: &args.policy, endpoint: &args.endpoint, robot: &robot, task: &task, summary: &summary };
        println!("{}", serde_json::to_string(&report).map_err(other)?);
    } else {
        print!("{}", summary_text(&summary));
    }
    Ok(())
}

/// A run, which may have a log.
pub struct Recording {
    robot: String,
    task: String,
    /// What the robot did.
    pub summary: RunSummary,
}

/// Runs the policy and records the log.
pub fn record(args: &Args, signals: &Signals) -> Result<Recording, Failure> {
    if let Some(seconds) = args.seconds.filter(|seconds| !(seconds.is_finite() && *seconds > 0.0)) {
        return Err(Failure::Input(miette::miette!("`--seconds` = {seconds} is not allowed: it must be positive")));
    }
    if !(0.0..=1.0).contains(&args.action_noise) {
        let noise = args.action_noise;
        return Err(Failure::Input(miette::miette!("`--action-noise` = {noise} is not allowed: 0 to 1")));
    }
    // Read and checked before anything moves.
    args.view.check()?;
    let commands = args.commands.as_deref().map(read_commands).transpose()?;
    let loaded = LoadedPolicy::read(&args.policy, args.mapping.as_deref()).map_err(input)?;
    let mut env = RemoteVecEnv::connect(&args.options(signals)).map_err(|error| interrupted(signals, error))?;
    let Prepared { mut policy, mut recorder, mut joints, velocity, view } =
        match args.prepared(&mut env, loaded, commands, signals) {
            Ok(prepared) => prepared,
            Err(failure) => {
                if matches!(failure, Failure::Input(_)) {
                    // Otherwise the robot is taken until the grace period has passed.
                    let _ = env.close();
                }
                return Err(failure);
            }
        };
    let recorders = Recorders { steps: recorder.as_mut(), joints: joints.as_mut() };
    let result = args.steps(&mut env, &mut policy, recorders, (&velocity, view.as_ref()), signals);
    let device_failure = if let Velocity::Person(device) = &velocity { device.failure() } else { None };
    // Restores the terminal before anything is printed.
    drop(velocity);
    if let Some(folder) = &args.log {
        let rows = recorder.map_or(0, |recorder| recorder.rows()) + joints.map_or(0, |joints| joints.rows());
        eprintln!("{rows} rows in {}", folder.display());
    }
    let (robot, task) = (env.spec().robot.clone(), env.spec().task.clone());
    // Otherwise the robot is taken until the grace period has passed. After another error the server may be gone.
    if matches!(result, Ok(_) | Err(AgentError::RobotStopped { .. })) {
        // Its error is of no interest any more: the run has ended.
        let _ = env.close();
    }
    let summary = result.map_err(|error| interrupted(signals, error))?;
    if let Some(reason) = device_failure {
        return Err(Failure::Other(miette::Report::msg(reason)));
    }
    if args.seconds.is_some() {
        // Ctrl-C before the end is an interruption; without --seconds it is the end.
        signals.check()?;
    }
    Ok(Recording { robot, task, summary })
}

impl Args {
    /// Returns the arguments with which `policy` follows the commands in a file for some time [s] and records `log`.
    pub fn recording(policy: &Path, commands: &Path, log: &Path, seconds: f64) -> Self {
        Self {
            policy: policy.to_owned(),
            mapping: None,
            endpoint: String::new(),
            robot: None,
            zenoh: None,
            log: Some(log.to_owned()),
            torque: false,
            velocity: None,
            commands: Some(commands.to_owned()),
            keyboard: false,
            gamepad: None,
            seconds: Some(seconds),
            action_noise: 0.0,
            go_on: false,
            fast: false,
            seed: 1,
            json: false,
            view: ViewArgs::default(),
        }
    }

    fn options(&self, signals: &Signals) -> ConnectOptions {
        ConnectOptions {
            interrupted: signals.flag(),
            robot: self.robot.clone(),
            zenoh: self.zenoh.clone(),
            autoreset: AutoresetMode::Disabled,
            // No time limit: SPEC.md.
            max_episode_steps: Some(u32::MAX),
            critic: true,
            ..ConnectOptions::new(self.endpoint.as_str(), 1)
        }
    }

    /// Compares the policy with the robot, and opens the log, the source of commands and the view.
    fn prepared(
        &self,
        env: &mut RemoteVecEnv,
        loaded: LoadedPolicy,
        commands: Option<CommandSequence>,
        signals: &Signals,
    ) -> Result<Prepared, Failure> {
        let policy = loaded.bind(env.spec()).map_err(input)?;
        if let Some(velocity) = self.velocity {
            env.set_velocity_commands(&[velocity]).map_err(input)?;
        }
        let (recorder, joints) = self.recorders(env, signals)?;
        let velocity = self.velocity_source(commands)?;
        if self.view.is_wanted() && self.log.is_none() {
            env.reset(&ResetRequest::seeded(self.seed, 1)).map_err(|error| interrupted(signals, error))?;
        }
        let view = RunView::open(&self.view, env, matches!(velocity, Velocity::Endpoint))?;
        Ok(Prepared { policy, recorder, joints, velocity, view })
    }

    /// Creates the log, if there is to be one.
    fn recorders(
        &self,
        env: &mut RemoteVecEnv,
        signals: &Signals,
    ) -> Result<(Option<Recorder>, Option<JointRecorder>), Failure> {
        let Some(folder) = &self.log else { return Ok((None, None)) };
        env.reset(&ResetRequest::seeded(self.seed, 1)).map_err(|error| interrupted(signals, error))?;
        let has_scene = match env.scene(0) {
            Ok(_) => true,
            Err(error) => {
                eprintln!("the log has no orientation, because the endpoint gives no scene: {error}");
                false
            }
        };
        let (policy, spec) = (self.policy.display(), env.spec());
        let source = format!("twinstep run {policy} on `{}`, task `{}`, at {}", spec.robot, spec.task, self.endpoint);
        if self.torque {
            // A simulator alone gives what no sensor measures.
            let has_base = spec.critic_field("true_linear_velocity").is_some() && !env.is_real_time();
            return Ok((None, Some(JointRecorder::create(folder, env, has_base, &source).map_err(input)?)));
        }
        Ok((Some(Recorder::create(folder, spec, has_scene, &source).map_err(input)?), None))
    }

    fn velocity_source(&self, commands: Option<CommandSequence>) -> Result<Velocity, Failure> {
        if let Some(commands) = commands {
            return Ok(Velocity::Sequence(commands));
        }
        Ok(match (&self.velocity, &self.gamepad) {
            (Some(velocity), _) => Velocity::Constant(*velocity),
            (None, Some(device)) => Velocity::Person(VelocityInput::gamepad(device)?),
            (None, None) if self.keyboard => Velocity::Person(VelocityInput::keyboard()?),
            (None, None) => Velocity::Endpoint,
        })
    }

    fn steps(
        &self,
        env: &mut RemoteVecEnv,
        policy: &mut BoundPolicy,
        recorders: Recorders,
        (velocity, view): (&Velocity, Option<&RunView>),
        signals: &Signals,
    ) -> Result<RunSummary, AgentError> {
        let (mut line, mut falls) = (StatusLine::new(), 0);
        // A robot sets the pace itself.
        let real_time = !self.fast && !env.is_real_time();
        let plan = RunPlan {
            seconds: self.seconds,
            real_time,
            action_noise: self.action_noise,
            seed: self.seed,
            goes_on: self.go_on,
        };
        let mut control = |status: &Status, env: &dyn VecEnv| {
            if status.falls > falls {
                falls = status.falls;
                line.message(&format!("{:.2} s: the robot has fallen and is reset", status.seconds));
            }
            line.show(|| status_text(status));
            view.inspect(|view| view.show(status, env));
            if !matches!(signals.check(), Ok(false)) {
                return Control::End;
            }
            let step = |velocity| Control::Step(WantedCommands::velocity(velocity));
            match velocity {
                Velocity::Endpoint => step(view.and_then(RunView::velocity)),
                Velocity::Constant(command) => step(Some(*command)),
                Velocity::Sequence(sequence) if status.seconds > sequence.duration_s() - 1e-6 => Control::End,
                Velocity::Sequence(sequence) => Control::Step(WantedCommands {
                    velocity: Some(sequence.at(status.seconds)),
                    gait: sequence.gait_at(status.seconds),
                }),
                Velocity::Person(device) => device.command().map_or(Control::End, |command| step(Some(command))),
            }
        };
        let result = run_policy(env, policy, recorders, plan, &mut control);
        line.clear();
        result
    }
}

/// Returns the failure of an error, which an interruption may have caused.
fn interrupted(signals: &Signals, error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    signals.check().err().unwrap_or_else(|| other(error))
}

/// Parses `VX,VY,WZ`.
fn velocity(text: &str) -> Result<[f32; 3], String> {
    let numbers: Result<Vec<f32>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    numbers.ok().and_then(|numbers| <[f32; 3]>::try_from(numbers).ok()).ok_or_else(|| {
        "three numbers are expected: forward [m/s], left [m/s], yaw rate [rad/s], such as 0.5,0,0".to_owned()
    })
}

fn status_text(status: &Status) -> String {
    let vector = |name: &str, value: Option<[f32; 3]>| {
        value.map_or_else(String::new, |[x, y, yaw]| format!("{name} {x:+.2} {y:+.2} m/s {yaw:+.2} rad/s   "))
    };
    format!(
        "{:7.2} s   {}{}falls {}   step {:.1} ms, late {:.1} ms",
        status.seconds,
        vector("command", status.command),
        vector("is", status.velocity),
        status.falls,
        1e3 * status.step_time,
        1e3 * status.lateness
    )
}

/// Returns the summary for people.
fn summary_text(summary: &RunSummary) -> String {
    let RunSummary { seconds, steps, falls, step_time, lateness, .. } = summary;
    let mut lines = vec![format!("{seconds:.2} s, {steps} steps, {falls} falls")];
    if summary.diverged > 0 {
        lines.push(format!("{} episodes ended with a simulation that became NaN or infinite", summary.diverged));
    }
    for (name, value) in [("command ", summary.mean_command), ("velocity", summary.mean_velocity)] {
        lines.extend(value.map(|[x, y, yaw]| format!("mean {name}   {x:+.3}, {y:+.3} m/s, {yaw:+.3} rad/s")));
    }
    if let (Some(velocity), Some(yaw_rate)) = (summary.velocity_rms, summary.yaw_rate_rms) {
        lines.push(format!("RMS error       {velocity:.3} m/s, {yaw_rate:.3} rad/s"));
    }
    lines.push(format!("step time       {:.2} ms, at most {:.2} ms", step_time.mean_ms, step_time.max_ms));
    lines.push(format!("lateness        {:.2} ms, at most {:.2} ms", lateness.mean_ms, lateness.max_ms));
    lines.push(format!("clipped actions {:.2} %", 100.0 * summary.clipped_share));
    lines.join("\n") + "\n"
}

fn read_commands(path: &Path) -> Result<CommandSequence, Failure> {
    let wrong = |cause: String| Failure::Input(miette::miette!("`--commands` = {}: {cause}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    CommandSequence::parse(&text).map_err(|error| wrong(error.to_string()))
}
