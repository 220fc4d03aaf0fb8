//! A policy that follows command sequences in a simulator, recorded as logs.

use twinstep_envs::{ConfigError, GaitConfig, GaitTask, Task, TaskEnv, TaskEnvConfig, Walk, WalkConfig};
use twinstep_logs::{Gain, Log, LogError, Meta, Segment, TorqueSensor};
use twinstep_model::{
    AutoresetMode, Backend, BaseMount, EnvError, EnvSpec, JOINT_NAMES, NUM_JOINTS, PerJoint, ResetRequest, RobotStates,
    Simulator, VecEnv,
};
use twinstep_policy::{Policy, PolicyRunner};

use crate::sequence::CommandSequence;

/// Share of the torque limit from which a motor counts as saturated.
const SATURATED: f32 = 0.95;

/// What a run may do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Largest horizontal distance of the base from its start [m].
    pub room_m: f64,
    /// Largest share of the steps in which a motor is at its torque limit.
    pub max_saturated: f64,
    /// Largest root mean square of the torque of a motor, which heats it [N·m].
    pub max_rms_torque_nm: f64,
}

/// What a run did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Motion {
    /// Time of the fall [s]; `None` if the robot did not fall.
    pub fell_at_s: Option<f64>,
    /// Largest horizontal distance of the base from its start [m].
    pub farthest_m: f64,
    /// Share of the steps in which a motor is at its torque limit.
    pub saturated: f64,
    /// Root mean square of the torque of the motor with the largest one [N·m].
    pub rms_torque_nm: f64,
}

impl std::fmt::Display for Motion {
    fn fmt(&self, text: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(fell_at_s) = self.fell_at_s {
            write!(text, "it fell after {fell_at_s:.1} s, ")?;
        }
        let Self { farthest_m, saturated, rms_torque_nm, .. } = self;
        let share = 100.0 * saturated;
        write!(text, "{farthest_m:.1} m from the start, motors at their limit in {share:.1} % of the steps, ")?;
        write!(text, "{rms_torque_nm:.1} N·m RMS")
    }
}

/// A limit that a run does not keep, with the number by which it is exceeded relative to the limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Violation {
    /// The robot fell, with this share of the run left.
    Fall(f64),
    /// It left the room.
    Room(f64),
    /// Its motors were at their limit for too long.
    Torque(f64),
    /// Its motors were loaded too much for too long.
    Heat(f64),
}

impl Violation {
    /// Returns the name of the limit.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fall(_) => "fall",
            Self::Room(_) => "room",
            Self::Torque(_) => "torque limit",
            Self::Heat(_) => "RMS torque",
        }
    }

    /// Returns the number by which the limit is exceeded.
    pub fn excess(self) -> f64 {
        let (Self::Fall(excess) | Self::Room(excess) | Self::Torque(excess) | Self::Heat(excess)) = self;
        excess
    }
}

impl Limits {
    /// Returns the worst violation.
    pub fn violation(&self, motion: &Motion, duration_s: f64) -> Option<Violation> {
        if let Some(fell_at_s) = motion.fell_at_s {
            return Some(Violation::Fall(1.0 - fell_at_s / duration_s));
        }
        let excess = |value: f64, limit: f64| value / limit - 1.0;
        [
            Violation::Room(excess(motion.farthest_m, self.room_m)),
            Violation::Torque(excess(motion.saturated, self.max_saturated)),
            Violation::Heat(excess(motion.rms_torque_nm, self.max_rms_torque_nm)),
        ]
        .into_iter()
        .filter(|violation| violation.excess() > 0.0)
        .max_by(|one, other| one.excess().total_cmp(&other.excess()))
    }
}

/// A simulated run.
pub struct Trial {
    /// Log with the columns of `twinstep run`, until the end or the fall. `None` if the robot fell at once.
    pub log: Option<Log>,
    /// What the robot did.
    pub motion: Motion,
}

/// Rows of a run.
struct Recording {
    rows: Vec<Vec<f64>>,
    start: [f32; 3],
    motion: Motion,
    saturated_steps: usize,
    torque_squares: [f64; NUM_JOINTS],
}

/// Returns the environments of the task `walk` without noise, randomisation and time limit, one for each robot.
pub fn walking_env<B: Backend>(backend: B, seed: u64) -> Result<TaskEnv<B, Walk>, ConfigError> {
    let walk = Walk::new(WalkConfig::default(), backend.robot(), true)?;
    TaskEnv::new(backend, walk, calm(seed))
}

/// Returns the environments of the task `gait` without noise, randomisation and time limit, one for each robot.
pub fn gait_env<B: Backend>(backend: B, seed: u64) -> Result<TaskEnv<B, GaitTask>, ConfigError> {
    let gait = GaitTask::new(GaitConfig::default(), backend.robot(), true)?;
    TaskEnv::new(backend, gait, calm(seed))
}

fn calm(seed: u64) -> TaskEnvConfig {
    TaskEnvConfig { max_episode_steps: Some(u32::MAX), ..TaskEnvConfig::new(AutoresetMode::NextStep, seed) }
}

/// Lets `policy` follow one sequence on each robot of `env`, all of which start in the same state, drawn from `seed`.
///
/// The sequences must have one duration, all of them gait commands or none, and `env` one robot for each. `policy` must be one of the environment's task.
pub fn simulate<B: Simulator, T: Task>(
    env: &mut TaskEnv<B, T>,
    policy: &Policy,
    sequences: &[CommandSequence],
    seed: u64,
) -> Result<Vec<Trial>, TrialError> {
    let spec = env.spec().clone();
    let command = spec.observation_field("velocity_command").map(|(start, _)| start);
    let mut runner = PolicyRunner::new(policy);
    let mut obs = Vec::new();
    let mut actions = vec![0.0; sequences.len() * spec.action_len()];
    env.reset(&ResetRequest { seeds: Some(vec![seed; sequences.len()]), ..ResetRequest::default() })?;
    let torque_limits = env.backend().robot().torque_limits();
    let start = |robot: usize| env.backend().states().truth.base_position[robot];
    let mut recordings: Vec<Recording> = (0..sequences.len()).map(|robot| Recording::new(start(robot))).collect();
    let steps = (sequences.first().map_or(0.0, CommandSequence::duration_s) / spec.policy_dt).round() as usize;
    for step in 0..steps {
        let t = step as f64 * spec.policy_dt;
        let commands: Vec<[f32; 3]> = sequences.iter().map(|sequence| sequence.at(t)).collect();
        env.set_velocity_commands(&commands)?;
        // The policy observes a new gait one period later, with the phases of the feet that belong to it.
        let gaits: Vec<_> = sequences.iter().filter_map(|sequence| sequence.gait_at(t)).collect();
        if !gaits.is_empty() {
            env.set_gait_commands(&gaits)?;
        }
        obs.clear();
        obs.extend_from_slice(env.obs());
        // As in `twinstep run`, the policy observes the command that is wanted now.
        if let Some(start) = command {
            for (row, wanted) in obs.chunks_exact_mut(spec.obs_len()).zip(&commands) {
                row[start..start + 3].copy_from_slice(wanted);
            }
        }
        runner.run(&obs, &mut actions);
        let states = env.backend().states();
        for ((robot, recording), action) in
            recordings.iter_mut().enumerate().zip(actions.chunks_exact(spec.action_len()))
        {
            recording.add(t, states, robot, action, &spec, &torque_limits);
        }
        let batch = env.step(&actions)?;
        let ended = batch.terminated.iter().zip(&batch.truncated);
        for (recording, (terminated, truncated)) in recordings.iter_mut().zip(ended) {
            if (*terminated || *truncated) && recording.motion.fell_at_s.is_none() {
                recording.motion.fell_at_s = Some(t);
            }
        }
    }
    recordings.into_iter().map(|recording| recording.trial(&spec)).collect()
}

/// A policy cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum TrialError {
    /// The environment refused a request.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The recording is not a valid log.
    #[error(transparent)]
    Log(#[from] LogError),
}

impl Recording {
    fn new(start: [f32; 3]) -> Self {
        let motion = Motion::default();
        Self { rows: Vec::new(), start, motion, saturated_steps: 0, torque_squares: [0.0; NUM_JOINTS] }
    }

    /// Adds the state before a step, and the command of the step.
    fn add(
        &mut self,
        t: f64,
        states: &RobotStates,
        robot: usize,
        action: &[f32],
        spec: &EnvSpec,
        torque_limits: &PerJoint,
    ) {
        if self.motion.fell_at_s.is_some() {
            return;
        }
        let (measured, truth) = (&states.measured, &states.truth);
        let target = |(action, pose): (&f32, &f64)| pose + spec.action_scale * f64::from(action.clamp(-1.0, 1.0));
        let sensors: [&[f32]; 6] = [
            &measured.q[robot],
            &measured.dq[robot],
            &measured.gyro[robot],
            &measured.orientation[robot],
            &truth.base_position[robot],
            &truth.base_linear_velocity[robot],
        ];
        let mut row = vec![t];
        row.extend(sensors.into_iter().flatten().map(|value| f64::from(*value)));
        row.extend(action.iter().zip(&spec.default_pose).map(target));
        self.rows.push(row);
        let [x, y, _] = truth.base_position[robot];
        let distance = f64::from((x - self.start[0]).hypot(y - self.start[1]));
        self.motion.farthest_m = self.motion.farthest_m.max(distance);
        let mut torques = measured.tau[robot].iter().zip(torque_limits);
        let saturated = torques.any(|(tau, limit)| tau.abs() >= SATURATED * limit);
        self.saturated_steps += usize::from(saturated);
        for (sum, tau) in self.torque_squares.iter_mut().zip(measured.tau[robot]) {
            *sum += f64::from(tau * tau);
        }
    }

    fn trial(self, spec: &EnvSpec) -> Result<Trial, TrialError> {
        let rows = self.rows.len().max(1) as f64;
        let hottest = self.torque_squares.into_iter().fold(0.0, f64::max);
        let saturated = self.saturated_steps as f64 / rows;
        let motion = Motion { saturated, rms_torque_nm: (hottest / rows).sqrt(), ..self.motion };
        let log = if self.rows.len() > 1 { Some(log(&self.rows, spec)?) } else { None };
        Ok(Trial { log, motion })
    }
}

fn log(rows: &[Vec<f64>], spec: &EnvSpec) -> Result<Log, LogError> {
    let of_joints = |quantity: &'static str| JOINT_NAMES.iter().map(move |joint| format!("{quantity}_{joint}"));
    let of_axes =
        |quantity: &'static str, axes: &'static str| axes.chars().map(move |axis| format!("{quantity}_{axis}"));
    let names = std::iter::once("t".to_owned())
        .chain(of_joints("q"))
        .chain(of_joints("dq"))
        .chain(of_axes("gyro", "xyz"))
        .chain(of_axes("quat", "wxyz"))
        .chain(of_axes("pos", "xyz"))
        .chain(of_axes("vel", "xyz"))
        .chain(of_joints("q_cmd"));
    let column = |(index, name): (usize, String)| (name, rows.iter().map(|row| row[index]).collect());
    let policy_hz = 1.0 / spec.policy_dt;
    let segments = vec![Segment { name: "run".to_owned(), base: BaseMount::Floating }];
    let meta = Meta {
        policy_hz: Some(policy_hz),
        joints: spec.joint_order.clone(),
        kp: Some(Gain::by_joint((0..spec.joint_order.len()).map(|joint| spec.gains(joint)[0]))),
        kd: Some(Gain::by_joint((0..spec.joint_order.len()).map(|joint| spec.gains(joint)[1]))),
        source: Some("simulated run of twinstep excite".to_owned()),
        ..Meta::new(policy_hz, TorqueSensor::None, segments)
    };
    Log::new(meta, names.enumerate().map(column))
}
