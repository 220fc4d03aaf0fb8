//! Evaluation of a walking policy: velocity errors, falls and the motion of the feet.
//!
//! A policy is judged by the measured velocity and by falls, never by its reward: policies that stand still collect
//! reward as well.

use glam::Vec3;
use serde::Serialize;
use twinstep_model::{EnvError, EnvSpec, FootKinematics, ResetRequest, RobotModel, SpecField, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};

use crate::statistics::VelocityLayout;

/// Time after a change of the command that is left out of the settled errors [s].
const TRANSIENT_S: f64 = 1.0;
/// Force above which a foot is on the ground [N].
const CONTACT_FORCE: f32 = 1.0;
/// Duration from which on a phase without contact is a swing [s].
const MIN_SWING_S: f64 = 0.04;

/// Measured motion of robots under a policy.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Evaluation {
    /// Number of robots.
    pub robots: usize,
    /// Simulated time of each robot [s].
    pub seconds: f64,
    /// Share of the robots that did not fall.
    pub up: f64,
    /// Root mean square of the norm of the horizontal velocity error, of robots that are up [m/s].
    ///
    /// The error of one axis is smaller by √2.
    pub velocity_rms: f64,
    /// The same, without the first second after each change of the command [m/s].
    pub settled_velocity_rms: f64,
    /// Root mean square error of the yaw rate [rad/s].
    pub yaw_rate_rms: f64,
    /// The same, without the first second after each change of the command [rad/s].
    pub settled_yaw_rate_rms: f64,
    /// Median over swing phases of the highest position of the sole above the ground [m].
    pub swing_height: f64,
    /// Share of the time in which a foot is on the ground, mean over the feet, while a motion is commanded.
    pub duty_factor: f64,
    /// Swing phases per second and foot, while a motion is commanded [1/s].
    pub swings_per_second: f64,
    /// Mean speed of feet on the ground [m/s].
    pub slip_speed: f64,
}

/// The environment does not observe what the evaluation needs.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// The policy is for other robots or observations.
    #[error(
        "the policy was trained with spec {policy}, the environment has {env}; they must agree on observation, action, \
         gains, action scale and default pose"
    )]
    OtherSpec {
        /// Hash of the policy's spec.
        policy: String,
        /// Hash of the environment's spec.
        env: String,
    },
    /// A part of the observation is missing.
    #[error("the environment does not observe `{0}`, which the evaluation needs")]
    Missing(&'static str),
    /// The caller stopped the evaluation.
    #[error("the evaluation was stopped")]
    Stopped,
    /// The environment failed.
    #[error(transparent)]
    Env(#[from] EnvError),
}

/// Positions of the quantities in the observations of both groups.
struct Layout {
    velocity: VelocityLayout,
    command: usize,
    gravity: usize,
    q: usize,
    dq: usize,
    angular_velocity: usize,
    linear_velocity: usize,
    height: usize,
    foot_force: usize,
}

impl Layout {
    fn new(spec: &EnvSpec) -> Result<Self, EvaluationError> {
        let find = |fields: &[SpecField], name: &'static str| {
            let index = fields.iter().position(|field| field.name == name).ok_or(EvaluationError::Missing(name))?;
            Ok::<_, EvaluationError>(fields[..index].iter().map(|field| field.size).sum::<usize>())
        };
        let (policy, critic) = (&spec.observation, &spec.critic_observation);
        Ok(Self {
            velocity: VelocityLayout::new(spec).ok_or(EvaluationError::Missing("true_linear_velocity"))?,
            command: find(policy, "velocity_command")?,
            gravity: find(policy, "projected_gravity")?,
            q: find(policy, "joint_position")?,
            dq: find(policy, "joint_velocity")?,
            angular_velocity: find(critic, "true_angular_velocity")?,
            linear_velocity: find(critic, "true_linear_velocity")?,
            height: find(critic, "base_height")?,
            foot_force: find(critic, "foot_force")?,
        })
    }
}

/// Motion of one robot so far.
#[derive(Clone, Default)]
struct Walker {
    has_fallen: bool,
    /// Steps since the command changed.
    steps_of_command: usize,
    command: [f32; 3],
    air_steps: [usize; 4],
    /// Highest position of each foot in its swing phase [m].
    peak: [f32; 4],
}

/// Sums over all robots.
#[derive(Default)]
struct Sums {
    steps: u64,
    settled_steps: u64,
    errors: [f64; 2],
    settled_errors: [f64; 2],
    moving_steps: u64,
    contacts: u64,
    slip: f64,
    swing_heights: Vec<f32>,
}

/// Robots of an evaluation.
#[derive(Clone, Copy, Debug)]
pub struct EvaluationPlan<'a> {
    /// Model of the robots, for the lengths of their legs.
    pub robot: &'a RobotModel,
    /// Simulated time of each robot [s].
    pub seconds: f64,
    /// Seed of robots and commands.
    pub seed: u64,
}

/// Runs the mean action of `policy` on all robots of `env`.
///
/// A robot that has fallen no longer counts for the errors. `proceed` is called after each step with the share that is
/// done; the evaluation stops if it returns false.
pub fn evaluate(
    policy: &Policy,
    env: &mut dyn VecEnv,
    plan: EvaluationPlan,
    mut proceed: impl FnMut(f64) -> bool,
) -> Result<Evaluation, EvaluationError> {
    let EvaluationPlan { robot, seconds, seed } = plan;
    let spec = env.spec().clone();
    if spec.hash() != policy.spec.hash() {
        return Err(EvaluationError::OtherSpec { policy: policy.spec.hash(), env: spec.hash() });
    }
    let layout = Layout::new(&spec)?;
    let feet = FootKinematics::new(robot);
    let num_envs = env.num_envs();
    let mut runner = PolicyRunner::new(policy);
    let mut obs = env.reset(&ResetRequest::seeded(seed, num_envs))?.to_vec();
    let mut actions = vec![0.0; num_envs * spec.action_len()];
    let mut walkers = vec![Walker::default(); num_envs];
    let mut sums = Sums::default();
    let steps = (seconds / spec.policy_dt).round() as usize;
    for step in 0..steps {
        runner.run(&obs, &mut actions);
        let batch = env.step(&actions)?;
        for (index, walker) in walkers.iter_mut().enumerate() {
            walker.has_fallen |=
                batch.terminated[index] || batch.ended.iter().any(|end| end.env == index && end.diverged);
            // The observation of a robot whose time is over is that of its next episode.
            if !walker.has_fallen && !batch.done(index) {
                let errors = layout.velocity.squared_errors(&obs, &batch.critic_obs, index);
                let command = &obs[index * spec.obs_len() + layout.command..][..3];
                walker.add_errors(&mut sums, errors, command, spec.policy_dt);
                let rows = [
                    &batch.obs[index * spec.obs_len()..][..spec.obs_len()],
                    &batch.critic_obs[index * spec.critic_obs_len()..][..spec.critic_obs_len()],
                ];
                walker.add_feet(&mut sums, &layout, &feet, robot, rows, spec.policy_dt);
            }
        }
        obs.copy_from_slice(&batch.obs);
        if !proceed((step + 1) as f64 / steps as f64) {
            return Err(EvaluationError::Stopped);
        }
    }
    let up = walkers.iter().filter(|walker| !walker.has_fallen).count();
    Ok(sums.evaluation(num_envs, up, seconds, spec.policy_dt))
}

impl Walker {
    fn add_errors(&mut self, sums: &mut Sums, errors: [f32; 2], command: &[f32], policy_dt: f64) {
        if command != self.command {
            (self.command, self.steps_of_command) = ([command[0], command[1], command[2]], 0);
        }
        self.steps_of_command += 1;
        sums.steps += 1;
        let is_settled = self.steps_of_command as f64 * policy_dt > TRANSIENT_S;
        sums.settled_steps += u64::from(is_settled);
        for (axis, error) in errors.into_iter().enumerate() {
            sums.errors[axis] += f64::from(error);
            sums.settled_errors[axis] += if is_settled { f64::from(error) } else { 0.0 };
        }
    }

    /// Adds the motion of the feet. `rows` are the observations of both groups after the step.
    fn add_feet(
        &mut self,
        sums: &mut Sums,
        layout: &Layout,
        kinematics: &FootKinematics,
        robot: &RobotModel,
        [obs, critic]: [&[f32]; 2],
        policy_dt: f64,
    ) {
        let is_moving = self.command.iter().any(|value| value.abs() > 0.1);
        let default_pose = robot.control.default_pose_f32();
        let q = std::array::from_fn(|joint| obs[layout.q + joint] + default_pose[joint]);
        let dq = std::array::from_fn(|joint| obs[layout.dq + joint]);
        let vector = |values: &[f32], start: usize| Vec3::from_slice(&values[start..start + 3]);
        // The gravity vector points down.
        let up = -vector(obs, layout.gravity);
        let (velocity, rotation) = (vector(critic, layout.linear_velocity), vector(critic, layout.angular_velocity));
        for (leg, foot) in kinematics.feet(&q, &dq).into_iter().enumerate() {
            let height = critic[layout.height] + up.dot(foot.position) - robot.shapes.foot_radius as f32;
            let touches = critic[layout.foot_force + leg] > CONTACT_FORCE;
            if touches {
                let motion = velocity + rotation.cross(foot.position) + foot.velocity;
                sums.slip += if is_moving { f64::from((motion - up * up.dot(motion)).length()) } else { 0.0 };
                if is_moving && self.air_steps[leg] as f64 * policy_dt >= MIN_SWING_S {
                    sums.swing_heights.push(self.peak[leg]);
                }
                (self.air_steps[leg], self.peak[leg]) = (0, 0.0);
            } else {
                self.air_steps[leg] += 1;
                self.peak[leg] = self.peak[leg].max(height);
            }
            sums.contacts += u64::from(touches && is_moving);
        }
        sums.moving_steps += u64::from(is_moving);
    }
}

impl Sums {
    fn evaluation(mut self, robots: usize, up: usize, seconds: f64, policy_dt: f64) -> Evaluation {
        let rms = |sum: f64, count: u64| (sum / count.max(1) as f64).sqrt();
        self.swing_heights.sort_by(f32::total_cmp);
        let foot_steps = 4.0 * self.moving_steps.max(1) as f64;
        Evaluation {
            robots,
            seconds,
            up: up as f64 / robots as f64,
            velocity_rms: rms(self.errors[0], self.steps),
            settled_velocity_rms: rms(self.settled_errors[0], self.settled_steps),
            yaw_rate_rms: rms(self.errors[1], self.steps),
            settled_yaw_rate_rms: rms(self.settled_errors[1], self.settled_steps),
            swing_height: self.swing_heights.get(self.swing_heights.len() / 2).map_or(0.0, |height| f64::from(*height)),
            duty_factor: self.contacts as f64 / foot_steps,
            swings_per_second: self.swing_heights.len() as f64 / (foot_steps * policy_dt),
            slip_speed: self.slip / self.contacts.max(1) as f64,
        }
    }
}
