//! `twinstep run`: runs a policy on a robot and records a log.

use std::path::PathBuf;

use serde::Serialize;
use twinstep_agent::{Control, RunSummary, Status, WantedCommands};
use twinstep_client::RemoteVecEnv;
use twinstep_model::{ResetRequest, VecEnv};
use twinstep_workflows::record::{Pilot, record_with};
use twinstep_workflows::{Observer, RecordOptions, Recording, Velocity};

use crate::exit::{CommandResult, Failure, other};
use crate::run_view::RunView;
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

/// Runs the policy and prints the summary.
pub fn run(args: &Args) -> CommandResult {
    let observer = Observer::terminal()?;
    // Read and checked before anything moves.
    args.view.check()?;
    let options = args.options()?;
    let open = |env: &mut RemoteVecEnv| args.driver(env, options.velocity.clone(), &observer);
    let Recording { robot, task, summary } = record_with(&options, open, &observer)?;
    if args.json {
        let report =
            Report { policy: &args.policy, endpoint: &args.endpoint, robot: &robot, task: &task, summary: &summary };
        println!("{}", serde_json::to_string(&report).map_err(other)?);
    } else {
        print!("{}", summary_text(&summary));
    }
    Ok(())
}

/// Commands the run and shows it.
struct Driver {
    velocity: Velocity,
    person: Option<VelocityInput>,
    view: Option<RunView>,
}

impl Pilot for Driver {
    fn control(&mut self, status: &Status, env: &dyn VecEnv) -> Control {
        if let Some(view) = &self.view {
            view.show(status, env);
        }
        let step = |velocity| Control::Step(WantedCommands::velocity(Some(velocity)));
        if let Some(person) = &self.person {
            return person.command().map_or(Control::End, step);
        }
        // The page has sliders only if there is no other source.
        self.view.as_ref().and_then(RunView::velocity).map_or_else(|| self.velocity.at(status.seconds), step)
    }

    fn failure(&self) -> Option<String> {
        self.person.as_ref().and_then(VelocityInput::failure)
    }
}

impl Args {
    fn options(&self) -> Result<RecordOptions, Failure> {
        let velocity = match (&self.velocity, &self.commands) {
            (Some(velocity), _) => Velocity::Constant(*velocity),
            (None, Some(path)) => Velocity::from_file(path)?,
            (None, None) => Velocity::Endpoint,
        };
        Ok(RecordOptions {
            mapping: self.mapping.clone(),
            robot: self.robot.clone(),
            zenoh: self.zenoh.clone(),
            log: self.log.clone(),
            torque: self.torque,
            velocity,
            seconds: self.seconds,
            action_noise: self.action_noise,
            go_on: self.go_on,
            fast: self.fast,
            seed: self.seed,
            ..RecordOptions::new(&self.policy, &self.endpoint)
        })
    }

    /// Opens the source of commands and the view.
    fn driver(&self, env: &mut RemoteVecEnv, velocity: Velocity, observer: &Observer) -> Result<Driver, Failure> {
        let person = match &self.gamepad {
            Some(device) => Some(VelocityInput::gamepad(device)?),
            None if self.keyboard => Some(VelocityInput::keyboard()?),
            None => None,
        };
        if self.view.is_wanted() && self.log.is_none() {
            let reset = env.reset(&ResetRequest::seeded(self.seed, 1)).map(drop);
            reset.map_err(|error| observer.check().err().unwrap_or_else(|| other(error)))?;
        }
        let steers = person.is_none() && velocity == Velocity::Endpoint;
        let view = RunView::open(&self.view, env, steers)?;
        Ok(Driver { velocity, person, view })
    }
}

/// Parses `VX,VY,WZ`.
fn velocity(text: &str) -> Result<[f32; 3], String> {
    let numbers: Result<Vec<f32>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    numbers.ok().and_then(|numbers| <[f32; 3]>::try_from(numbers).ok()).ok_or_else(|| {
        "three numbers are expected: forward [m/s], left [m/s], yaw rate [rad/s], such as 0.5,0,0".to_owned()
    })
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
