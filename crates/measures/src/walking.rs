//! Velocity errors, the motion of the feet and power of walking robots.

use glam::Vec3;
use serde::Serialize;
use twinstep_learning::VelocityLayout;
use twinstep_model::{EnvError, EnvSpec, Feet, SpecField};

use crate::{Measure, MeasureError, Step, share_up};

/// Time after a change of the command that is left out of the settled errors [s].
const TRANSIENT_S: f64 = 1.0;
/// Force above which a foot is on the ground [N].
const CONTACT_FORCE: f32 = 1.0;
/// Duration from which on a phase without contact is a swing [s].
const MIN_SWING_S: f64 = 0.04;
/// Entry of a command above which a motion is commanded [m/s, rad/s].
const MOVING: f32 = 0.1;

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
    /// Mean of the mechanical power of all motors while a motion is commanded [W]. Braking counts as 0.
    ///
    /// The torque is that of the PD loop with nominal gains at the end of each policy step.
    pub power: f64,
    /// Errors by the commanded speed. [`SPEED_BINS`] are its ranges.
    pub by_speed: Vec<SpeedBin>,
}

/// Limits of the ranges of commanded speed, above standing robots [m/s].
pub const SPEED_BINS: [f32; 3] = [0.05, 0.4, 0.8];

/// Errors in a range of commanded speed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SpeedBin {
    /// Lowest commanded horizontal speed [m/s].
    pub from: f32,
    /// Share of the steps.
    pub share: f64,
    /// Root mean square of the norm of the horizontal velocity error [m/s].
    pub velocity_rms: f64,
    /// Root mean square error of the yaw rate [rad/s].
    pub yaw_rate_rms: f64,
}

/// Measures how robots follow velocity commands.
pub struct Walking {
    robots: Robots,
    walkers: Vec<Walker>,
    sums: Sums,
    steps: usize,
}

impl Walking {
    /// Prepares the measure of robots with these feet and torque limits [N·m].
    pub fn new(spec: &EnvSpec, num_envs: usize, feet: &Feet, torque_limits: &[f64]) -> Result<Self, MeasureError> {
        let robots = Robots::new(spec, feet, torque_limits).map_err(MeasureError::Missing)?;
        Ok(Self { robots, walkers: vec![Walker::new(feet.len()); num_envs], sums: Sums::default(), steps: 0 })
    }
}

impl Measure for Walking {
    type Found = Evaluation;

    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError> {
        self.steps += 1;
        for robot in step.robots() {
            let observations = [step.before, &step.batch.obs, &step.batch.critic_obs];
            self.walkers[robot].add(&mut self.sums, &self.robots, robot, observations);
        }
        Ok(())
    }

    fn found(self, has_fallen: &[bool]) -> Evaluation {
        let seconds = self.steps as f64 * self.robots.policy_dt;
        self.sums.evaluation(has_fallen.len(), share_up(has_fallen), seconds, &self.robots)
    }
}

/// What the robots have in common: the layout of their observations, their gains and limbs.
struct Robots {
    obs_len: usize,
    critic_len: usize,
    policy_dt: f64,
    velocity: VelocityLayout,
    command: usize,
    gravity: usize,
    q: usize,
    dq: usize,
    action: usize,
    angular_velocity: usize,
    linear_velocity: usize,
    height: usize,
    foot_force: usize,
    feet: Feet,
    default_pose: Vec<f32>,
    torque_limits: Vec<f32>,
    action_scale: f32,
    /// Position and velocity gain by joint.
    gains: Vec<[f32; 2]>,
}

impl Robots {
    /// Returns the name of a quantity that is not observed, if there is one, as error.
    fn new(spec: &EnvSpec, feet: &Feet, torque_limits: &[f64]) -> Result<Self, &'static str> {
        let find = |fields: &[SpecField], name: &'static str| {
            let index = fields.iter().position(|field| field.name == name).ok_or(name)?;
            Ok::<_, &'static str>(fields[..index].iter().map(|field| field.size).sum::<usize>())
        };
        let single = |values: &[f64]| values.iter().map(|value| *value as f32).collect::<Vec<_>>();
        let (policy, critic) = (&spec.observation, &spec.critic_observation);
        Ok(Self {
            obs_len: spec.obs_len(),
            critic_len: spec.critic_obs_len(),
            policy_dt: spec.policy_dt,
            velocity: VelocityLayout::new(spec).ok_or("true_linear_velocity")?,
            command: find(policy, "velocity_command").or_else(|_| find(policy, "path_velocity"))?,
            gravity: find(policy, "projected_gravity")?,
            q: find(policy, "joint_position")?,
            dq: find(policy, "joint_velocity")?,
            action: find(policy, "previous_action")?,
            angular_velocity: find(critic, "true_angular_velocity")?,
            linear_velocity: find(critic, "true_linear_velocity")?,
            height: find(critic, "base_height")?,
            foot_force: find(critic, "foot_force")?,
            feet: feet.clone(),
            default_pose: single(&spec.default_pose),
            torque_limits: single(torque_limits),
            action_scale: spec.action_scale as f32,
            gains: (0..torque_limits.len()).map(|joint| spec.gains(joint).map(|gain| gain as f32)).collect(),
        })
    }

    /// Returns the mechanical power of all motors at the end of a step, without that of braking ones [W].
    fn power(&self, obs: &[f32]) -> f32 {
        let joints = self.torque_limits.len();
        let [q, dq, action] = [self.q, self.dq, self.action].map(|start| &obs[start..start + joints]);
        let joint_power = |joint: usize| {
            let [kp, kd] = self.gains[joint];
            let tau = kp * (self.action_scale * action[joint] - q[joint]) - kd * dq[joint];
            let limit = self.torque_limits[joint];
            (tau.clamp(-limit, limit) * dq[joint]).max(0.0)
        };
        (0..joints).map(joint_power).sum()
    }
}

/// Motion of one robot so far.
#[derive(Clone, Default)]
struct Walker {
    /// Steps since the command changed.
    steps_of_command: usize,
    command: [f32; 3],
    air_steps: Vec<usize>,
    /// Highest position of each foot in its swing phase [m].
    peak: Vec<f32>,
}

impl Walker {
    /// Returns a robot with this number of feet, before its first step.
    fn new(feet: usize) -> Self {
        Self { air_steps: vec![0; feet], peak: vec![0.0; feet], ..Self::default() }
    }

    /// Adds a step of robot `index` to `sums`.
    ///
    /// `observations` of all robots are those of group `policy` before and after the step, and of group `critic` after it.
    fn add(&mut self, sums: &mut Sums, robots: &Robots, index: usize, observations: [&[f32]; 3]) {
        let [before, after, critic] = observations;
        let errors = robots.velocity.squared_errors(before, critic, index).map(f64::from);
        let obs = &after[index * robots.obs_len..][..robots.obs_len];
        let critic = &critic[index * robots.critic_len..][..robots.critic_len];
        let command = &before[index * robots.obs_len + robots.command..][..3];
        self.add_errors(sums, errors, command, robots.policy_dt);
        let is_moving = self.command.iter().any(|value| value.abs() > MOVING);
        if is_moving {
            sums.moving_steps += 1;
            sums.power += f64::from(robots.power(obs));
        }
        self.add_feet(sums, robots, [obs, critic], is_moving);
    }

    fn add_errors(&mut self, sums: &mut Sums, errors: [f64; 2], command: &[f32], policy_dt: f64) {
        if command != self.command {
            (self.command, self.steps_of_command) = ([command[0], command[1], command[2]], 0);
        }
        self.steps_of_command += 1;
        sums.all.add(errors);
        if self.steps_of_command as f64 * policy_dt > TRANSIENT_S {
            sums.settled.add(errors);
        }
        let speed = command[0].hypot(command[1]);
        sums.by_speed[SPEED_BINS.iter().filter(|limit| speed >= **limit).count()].add(errors);
    }

    /// Adds the motion of the feet. `rows` are the observations of both groups after the step.
    fn add_feet(&mut self, sums: &mut Sums, robots: &Robots, [obs, critic]: [&[f32]; 2], is_moving: bool) {
        let joints = robots.default_pose.len();
        let q = obs[robots.q..].iter().zip(&robots.default_pose).map(|(q, pose)| q + pose).collect::<Vec<_>>();
        let dq = &obs[robots.dq..robots.dq + joints];
        let vector = |values: &[f32], start: usize| Vec3::from_slice(&values[start..start + 3]);
        // The gravity vector points down.
        let up = -vector(obs, robots.gravity);
        let (velocity, rotation) = (vector(critic, robots.linear_velocity), vector(critic, robots.angular_velocity));
        for (leg, foot) in robots.feet.motions(&q, dq).enumerate() {
            let height = critic[robots.height] + up.dot(foot.position) - robots.feet.feet()[leg].radius as f32;
            let touches = critic[robots.foot_force + leg] > CONTACT_FORCE;
            if touches {
                let motion = velocity + rotation.cross(foot.position) + foot.velocity;
                sums.slip += if is_moving { f64::from((motion - up * up.dot(motion)).length()) } else { 0.0 };
                if is_moving && self.air_steps[leg] as f64 * robots.policy_dt >= MIN_SWING_S {
                    sums.swing_heights.push(self.peak[leg]);
                }
                (self.air_steps[leg], self.peak[leg]) = (0, 0.0);
            } else {
                self.air_steps[leg] += 1;
                self.peak[leg] = self.peak[leg].max(height);
            }
            sums.contacts += u64::from(touches && is_moving);
        }
    }
}

/// Number of steps and their squared errors of velocity [m²/s²] and yaw rate [rad²/s²].
#[derive(Clone, Copy, Default)]
struct Errors {
    steps: u64,
    squared: [f64; 2],
}

impl Errors {
    fn add(&mut self, errors: [f64; 2]) {
        self.steps += 1;
        self.squared.iter_mut().zip(errors).for_each(|(sum, error)| *sum += error);
    }

    /// Returns the root mean squares.
    fn rms(&self) -> [f64; 2] {
        self.squared.map(|sum| (sum / self.steps.max(1) as f64).sqrt())
    }
}

/// Sums over all robots.
#[derive(Default)]
struct Sums {
    all: Errors,
    settled: Errors,
    by_speed: [Errors; SPEED_BINS.len() + 1],
    moving_steps: u64,
    contacts: u64,
    slip: f64,
    power: f64,
    swing_heights: Vec<f32>,
}

impl Sums {
    /// Returns the evaluation of `count` robots, of which a share `up` did not fall in `seconds` seconds.
    fn evaluation(mut self, count: usize, up: f64, seconds: f64, robots: &Robots) -> Evaluation {
        self.swing_heights.sort_by(f32::total_cmp);
        let moving_steps = self.moving_steps.max(1) as f64;
        let foot_steps = robots.feet.len() as f64 * moving_steps;
        let [velocity_rms, yaw_rate_rms] = self.all.rms();
        let [settled_velocity_rms, settled_yaw_rate_rms] = self.settled.rms();
        let limits = [0.0].into_iter().chain(SPEED_BINS);
        let bin = |(from, errors): (f32, &Errors)| {
            let [velocity_rms, yaw_rate_rms] = errors.rms();
            SpeedBin { from, share: errors.steps as f64 / self.all.steps.max(1) as f64, velocity_rms, yaw_rate_rms }
        };
        Evaluation {
            robots: count,
            seconds,
            up,
            velocity_rms,
            settled_velocity_rms,
            yaw_rate_rms,
            settled_yaw_rate_rms,
            swing_height: self.swing_heights.get(self.swing_heights.len() / 2).map_or(0.0, |height| f64::from(*height)),
            duty_factor: self.contacts as f64 / foot_steps,
            swings_per_second: self.swing_heights.len() as f64 / (foot_steps * robots.policy_dt),
            slip_speed: self.slip / self.contacts.max(1) as f64,
            power: self.power / moving_steps,
            by_speed: limits.zip(&self.by_speed).map(bin).collect(),
        }
    }
}
