//! Runs of a policy on a robot, simulated or real, with a log.

use std::path::{Path, PathBuf};

use twinstep_agent::{
    AgentError, BoundPolicy, Control, JointRecorder, LoadedPolicy, Recorder, Recorders, RunPlan, RunSummary, Status,
    WantedCommands, run as run_policy,
};
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_excite::CommandSequence;
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv};

use crate::failure::{Failure, input, other};
use crate::observer::Observer;
use crate::status_line::StatusLine;

/// Settings of [`record`].
#[derive(Clone, Debug)]
pub struct RecordOptions {
    /// Policy: *.safetensors or *.onnx.
    pub policy: PathBuf,
    /// Mapping of the ONNX file of another program (TOML).
    pub mapping: Option<PathBuf>,
    /// Zenoh endpoint of the robot or of a server.
    pub endpoint: String,
    /// Name of the robot, if several are visible.
    pub robot: Option<String>,
    /// Zenoh configuration file (JSON5) for TLS, user and password.
    pub zenoh: Option<PathBuf>,
    /// Folder of the log, which must not exist or be empty. `None`: no log.
    pub log: Option<PathBuf>,
    /// True for a log at the rate of the actuators, with the measured torques.
    pub torque: bool,
    /// Source of the velocity command.
    pub velocity: Velocity,
    /// Time after which the run ends [s]. `None`: when the pilot or an interruption ends it.
    pub seconds: Option<f64>,
    /// Standard deviation of Gaussian noise on every action, in units of `action_scale`.
    pub action_noise: f64,
    /// True to continue after a fault of a real robot, once its operator says so.
    pub go_on: bool,
    /// True to step as fast as the endpoint answers. False: in real time.
    pub fast: bool,
    /// Seed of the robot's random numbers: initial pose, own commands.
    pub seed: u64,
}

/// Source of the velocity command of a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Velocity {
    /// The endpoint's own commands.
    Endpoint,
    /// Forward [m/s], left [m/s], yaw rate [rad/s].
    Constant([f32; 3]),
    /// Commands one after the other. Their end is that of the run.
    Sequence(CommandSequence),
}

impl Velocity {
    /// Reads a file of commands (CSV), as [`design`](crate::design) writes it.
    pub fn from_file(path: &Path) -> Result<Self, Failure> {
        let wrong = |cause: String| Failure::Input(miette::miette!("`--commands` = {}: {cause}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        CommandSequence::parse(&text).map(Self::Sequence).map_err(|error| wrong(error.to_string()))
    }

    /// Returns what is commanded at a time of the run [s].
    pub fn at(&self, seconds: f64) -> Control {
        match self {
            Self::Endpoint => Control::Step(WantedCommands::velocity(None)),
            Self::Constant(velocity) => Control::Step(WantedCommands::velocity(Some(*velocity))),
            Self::Sequence(commands) if seconds > commands.duration_s() - 1e-6 => Control::End,
            Self::Sequence(commands) => {
                Control::Step(WantedCommands { velocity: Some(commands.at(seconds)), gait: commands.gait_at(seconds) })
            }
        }
    }
}

/// Commands a run before each of its steps.
pub trait Pilot {
    /// Returns what is commanded in the next step, or the end of the run.
    fn control(&mut self, status: &Status, env: &dyn VecEnv) -> Control;

    /// Returns why the run had to end, if it had to.
    fn failure(&self) -> Option<String> {
        None
    }
}

/// Result of [`record`].
pub struct Recording {
    /// Name of the robot.
    pub robot: String,
    /// Its task.
    pub task: String,
    /// What the robot did.
    pub summary: RunSummary,
}

impl RecordOptions {
    /// Returns the options of a run in real time with the endpoint's own commands and without a log.
    pub fn new(policy: impl Into<PathBuf>, endpoint: impl Into<String>) -> Self {
        Self {
            policy: policy.into(),
            mapping: None,
            endpoint: endpoint.into(),
            robot: None,
            zenoh: None,
            log: None,
            torque: false,
            velocity: Velocity::Endpoint,
            seconds: None,
            action_noise: 0.0,
            go_on: false,
            fast: false,
            seed: 1,
        }
    }
}

/// Runs a policy on the robot at an endpoint, and records the log.
///
/// The policy is compared with the robot before anything moves.
///
/// ```no_run
/// use twinstep_workflows::{Observer, RecordOptions, Velocity, record};
///
/// let options = RecordOptions {
///     log: Some("walk-log".into()),
///     velocity: Velocity::Constant([0.5, 0.0, 0.0]),
///     seconds: Some(20.0),
///     ..RecordOptions::new("data/policies/walk.safetensors", "tcp/127.0.0.1:7447")
/// };
/// let recording = record(&options, &Observer::silent())?;
/// println!("{} falls", recording.summary.falls);
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn record(options: &RecordOptions, observer: &Observer) -> Result<Recording, Failure> {
    record_with(options, |_| Ok(Script(options.velocity.clone())), observer)
}

/// Commands that are known before the run.
struct Script(Velocity);

impl Pilot for Script {
    fn control(&mut self, status: &Status, _env: &dyn VecEnv) -> Control {
        self.0.at(status.seconds)
    }
}

/// Runs a policy as [`record`] does, with the commands of a pilot. `open` makes it once the robot is there.
pub fn record_with<P: Pilot>(
    options: &RecordOptions,
    open: impl FnOnce(&mut RemoteVecEnv) -> Result<P, Failure>,
    observer: &Observer,
) -> Result<Recording, Failure> {
    if let Some(seconds) = options.seconds.filter(|seconds| !(seconds.is_finite() && *seconds > 0.0)) {
        return Err(Failure::Input(miette::miette!("`--seconds` = {seconds} is not allowed: it must be positive")));
    }
    if !(0.0..=1.0).contains(&options.action_noise) {
        let noise = options.action_noise;
        return Err(Failure::Input(miette::miette!("`--action-noise` = {noise} is not allowed: 0 to 1")));
    }
    let loaded = LoadedPolicy::read(&options.policy, options.mapping.as_deref()).map_err(input)?;
    let mut env = RemoteVecEnv::connect(&options.connection(observer)).map_err(|error| interrupted(observer, error))?;
    let Prepared { mut policy, mut recorder, mut joints, mut pilot } =
        match options.prepared(&mut env, loaded, open, observer) {
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
    let result = options.steps(&mut env, &mut policy, recorders, &mut pilot, observer);
    let pilot_failure = pilot.failure();
    // Restores the terminal before anything is printed.
    drop(pilot);
    if let Some(folder) = &options.log {
        let rows = recorder.map_or(0, |recorder| recorder.rows()) + joints.map_or(0, |joints| joints.rows());
        observer.note(format_args!("{rows} rows in {}", folder.display()));
    }
    let (robot, task) = (env.spec().robot.clone(), env.spec().task.clone());
    // Otherwise the robot is taken until the grace period has passed. After another error the server may be gone.
    if matches!(result, Ok(_) | Err(AgentError::RobotStopped { .. })) {
        // Its error is of no interest any more: the run has ended.
        let _ = env.close();
    }
    let summary = result.map_err(|error| interrupted(observer, error))?;
    if let Some(reason) = pilot_failure {
        return Err(Failure::Other(miette::Report::msg(reason)));
    }
    if options.seconds.is_some() {
        // Ctrl-C before the end is an interruption; without a duration it is the end.
        observer.check()?;
    }
    Ok(Recording { robot, task, summary })
}

/// What a run needs beside the robot.
struct Prepared<P> {
    policy: BoundPolicy,
    recorder: Option<Recorder>,
    joints: Option<JointRecorder>,
    pilot: P,
}

impl RecordOptions {
    fn connection(&self, observer: &Observer) -> ConnectOptions {
        ConnectOptions {
            interrupted: observer.flag(),
            robot: self.robot.clone(),
            zenoh: self.zenoh.clone(),
            autoreset: AutoresetMode::Disabled,
            // No time limit: SPEC.md.
            max_episode_steps: Some(u32::MAX),
            critic: true,
            ..ConnectOptions::new(self.endpoint.as_str(), 1)
        }
    }

    /// Compares the policy with the robot, and opens the log and the pilot.
    fn prepared<P>(
        &self,
        env: &mut RemoteVecEnv,
        loaded: LoadedPolicy,
        open: impl FnOnce(&mut RemoteVecEnv) -> Result<P, Failure>,
        observer: &Observer,
    ) -> Result<Prepared<P>, Failure> {
        let policy = loaded.bind(env.spec()).map_err(input)?;
        if let Velocity::Constant(velocity) = self.velocity {
            env.set_velocity_commands(&[velocity]).map_err(input)?;
        }
        let (recorder, joints) = self.recorders(env, observer)?;
        Ok(Prepared { policy, recorder, joints, pilot: open(env)? })
    }

    /// Creates the log, if there is to be one.
    fn recorders(
        &self,
        env: &mut RemoteVecEnv,
        observer: &Observer,
    ) -> Result<(Option<Recorder>, Option<JointRecorder>), Failure> {
        let Some(folder) = &self.log else { return Ok((None, None)) };
        env.reset(&ResetRequest::seeded(self.seed, 1)).map_err(|error| interrupted(observer, error))?;
        let has_scene = match env.scene(0) {
            Ok(_) => true,
            Err(error) => {
                observer.note(format_args!("the log has no orientation, because the endpoint gives no scene: {error}"));
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

    fn steps(
        &self,
        env: &mut RemoteVecEnv,
        policy: &mut BoundPolicy,
        recorders: Recorders,
        pilot: &mut dyn Pilot,
        observer: &Observer,
    ) -> Result<RunSummary, AgentError> {
        let (mut line, mut falls) = (StatusLine::new(observer.is_silent()), 0);
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
            let wanted = pilot.control(status, env);
            if matches!(observer.check(), Ok(false)) { wanted } else { Control::End }
        };
        let result = run_policy(env, policy, recorders, plan, &mut control);
        line.clear();
        result
    }
}

/// Returns the failure of an error, which an interruption may have caused.
fn interrupted(observer: &Observer, error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    observer.check().err().unwrap_or_else(|| other(error))
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
