//! Step frequency, phases of the feet and velocity errors of each gait, of a policy of the task `gait`.

use std::f64::consts::TAU;

use serde::Serialize;
use twinstep_envs::{Gait, GaitConfig, WalkConfig};
use twinstep_model::{EnvError, EnvSpec, SpecField};

use crate::{Measure, MeasureError, Step, share_up};

/// Normal force above which a foot is on the ground [N].
const CONTACT_FORCE: f32 = 1.0;
/// Duration from which on a phase without contact is a swing [s].
const MIN_SWING_S: f64 = 0.04;
/// Time after a change of the command that is left out of everything but velocity errors and falls [s].
const TRANSIENT_S: f64 = 1.0;
/// Error of the step frequency, relative to the command, up to which a gait is followed.
const MAX_FREQUENCY_ERROR: f64 = 0.05;
/// Error of each phase up to which a gait is followed [cycles].
const MAX_PHASE_ERROR: f64 = 0.1;
/// Measured motion of robots that were commanded one gait.
#[derive(Debug, Serialize)]
pub struct GaitMotion {
    /// Name of the gait.
    pub gait: &'static str,
    /// Share of the robots that did not fall.
    pub up: f64,
    /// Share of the commands whose step frequency was followed within 5 %, and each phase within 0.1 cycles.
    pub followed: f64,
    /// Mean error of the step frequency, without sign and relative to the command.
    pub frequency_error: f64,
    /// Mean error of the phases of FR, RL and RR relative to FL, without sign [cycles].
    pub phase_error: f64,
    /// Share of the time in which a foot is on the ground.
    pub duty_factor: f64,
    /// Root mean square of the norm of the horizontal velocity error [m/s].
    pub velocity_rms: f64,
    /// Root mean square error of the yaw rate [rad/s].
    pub yaw_rate_rms: f64,
}

/// Measures how robots follow one gait.
///
/// Contacts are those of the simulator, so that the measurement does not depend on the contact schedule of the task.
pub struct GaitFollowing {
    gait: Gait,
    layout: Layout,
    walkers: Vec<Walker>,
    sums: Sums,
}

impl GaitFollowing {
    /// Names of the conditions under which gaits are evaluated.
    pub const CONDITIONS: [&str; 4] = ["nominal", "robots", "pushes", "delay"];

    /// Returns the settings of the task for each gait. Episodes end by falls only.
    pub fn tasks() -> [(GaitConfig, Gait); 4] {
        Gait::ALL.map(|gait| {
            let default = GaitConfig::default();
            let walk = WalkConfig { max_episode_s: 1e6, ..default.walk };
            (GaitConfig { gaits: vec![gait], walk, ..default }, gait)
        })
    }

    /// Prepares the measure of environments of the task `gait`.
    pub fn new(spec: &EnvSpec, num_envs: usize, gait: Gait) -> Result<Self, MeasureError> {
        let layout = Layout::new(spec)?;
        Ok(Self { gait, layout, walkers: vec![Walker::default(); num_envs], sums: Sums::default() })
    }
}

impl Measure for GaitFollowing {
    type Found = GaitMotion;

    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError> {
        for robot in step.robots() {
            let command = &step.before[robot * self.layout.obs_len..][..self.layout.obs_len];
            let truth = &step.batch.critic_obs[robot * self.layout.critic_len..][..self.layout.critic_len];
            self.walkers[robot].add(&self.layout, (command, truth), step.index, &mut self.sums);
        }
        Ok(())
    }

    fn found(mut self, has_fallen: &[bool]) -> GaitMotion {
        for (walker, _) in self.walkers.iter_mut().zip(has_fallen).filter(|(_, has_fallen)| !**has_fallen) {
            walker.end_command(&self.layout, &mut self.sums);
        }
        self.sums.motion(self.gait, share_up(has_fallen))
    }
}

/// Positions of the quantities in the observations.
struct Layout {
    obs_len: usize,
    critic_len: usize,
    policy_dt: f64,
    velocity_command: usize,
    step_frequency: usize,
    phase_offset: usize,
    linear_velocity: usize,
    angular_velocity: usize,
    foot_force: usize,
}

impl Layout {
    /// Returns the layout of the task `gait` on a simulated robot.
    fn new(spec: &EnvSpec) -> Result<Self, MeasureError> {
        let start =
            |field: Option<(usize, &SpecField)>, name| field.map(|(start, _)| start).ok_or(MeasureError::Missing(name));
        let (policy, critic) =
            (|name| start(spec.observation_field(name), name), |name| start(spec.critic_field(name), name));
        Ok(Self {
            obs_len: spec.obs_len(),
            critic_len: spec.critic_obs_len(),
            policy_dt: spec.policy_dt,
            velocity_command: policy("velocity_command")?,
            step_frequency: policy("step_frequency")?,
            phase_offset: policy("phase_offset")?,
            linear_velocity: critic("true_linear_velocity")?,
            angular_velocity: critic("true_angular_velocity")?,
            foot_force: critic("foot_force")?,
        })
    }
}

/// One robot under its current command.
#[derive(Clone, Debug, Default)]
struct Walker {
    /// Step frequency [Hz] and phase offsets [cycles] of the command.
    command: [f32; 4],
    /// Step in which the command began.
    since: usize,
    /// Steps without contact of each foot so far.
    air_steps: [usize; 4],
    /// Steps of the touchdowns of each foot under this command, after the transient.
    touchdowns: [Vec<usize>; 4],
}

impl Walker {
    /// Adds a step: the observation with its command, and the privileged one after it.
    fn add(&mut self, layout: &Layout, (obs, truth): (&[f32], &[f32]), step: usize, sums: &mut Sums) {
        let offsets = &obs[layout.phase_offset..][..3];
        let command = [obs[layout.step_frequency], offsets[0], offsets[1], offsets[2]];
        if command != self.command {
            self.end_command(layout, sums);
            (self.command, self.since) = (command, step);
        }
        let velocity_command = &obs[layout.velocity_command..][..3];
        let velocity = &truth[layout.linear_velocity..][..2];
        let linear = (velocity[0] - velocity_command[0]).powi(2) + (velocity[1] - velocity_command[1]).powi(2);
        let yaw = (truth[layout.angular_velocity + 2] - velocity_command[2]).powi(2);
        sums.add_errors(linear, yaw);
        let is_settled = (step - self.since) as f64 * layout.policy_dt >= TRANSIENT_S;
        for leg in 0..4 {
            let touches = truth[layout.foot_force + leg] > CONTACT_FORCE;
            let swung = self.air_steps[leg] as f64 * layout.policy_dt >= MIN_SWING_S;
            if touches && swung && is_settled {
                self.touchdowns[leg].push(step);
            }
            self.air_steps[leg] = if touches { 0 } else { self.air_steps[leg] + 1 };
            sums.foot_steps += u64::from(is_settled);
            sums.contacts += u64::from(is_settled && touches);
        }
    }

    /// Adds the gait under the command that ends.
    fn end_command(&mut self, layout: &Layout, sums: &mut Sums) {
        let touchdowns = std::mem::take(&mut self.touchdowns);
        let [frequency, offsets @ ..] = self.command.map(f64::from);
        let period = layout.policy_dt * frequency;
        let last = touchdowns.iter().filter_map(|steps| steps.last()).max().copied().unwrap_or_default();
        let seconds = last.saturating_sub(self.since) as f64 * layout.policy_dt - TRANSIENT_S;
        // Without some cycles there is nothing to measure.
        if frequency == 0.0 || seconds * frequency < 3.0 {
            return;
        }
        let frequency_error = (0..4).map(|leg| (measured_frequency(&touchdowns[leg], layout) / frequency - 1.0).abs());
        let phase_error = (0..3).map(|leg| phase_error(&touchdowns[0], &touchdowns[leg + 1], period, offsets[leg]));
        let (frequency_error, phase_error) = (frequency_error.collect::<Vec<_>>(), phase_error.collect::<Vec<_>>());
        let is_within = |errors: &[f64], limit: f64| errors.iter().all(|error| *error <= limit);
        sums.commands += 1;
        let follows = is_within(&frequency_error, MAX_FREQUENCY_ERROR) && is_within(&phase_error, MAX_PHASE_ERROR);
        sums.followed += u64::from(follows);
        sums.frequency_error += frequency_error.iter().sum::<f64>() / 4.0;
        sums.phase_error += phase_error.iter().sum::<f64>() / 3.0;
    }
}

/// Returns the touchdowns per second between the first and the last one; 0 with less than two [Hz].
fn measured_frequency(touchdowns: &[usize], layout: &Layout) -> f64 {
    match touchdowns {
        [first, .., last] => (touchdowns.len() - 1) as f64 / ((last - first) as f64 * layout.policy_dt),
        _ => 0.0,
    }
}

/// Returns the error of the phase of a foot relative to FL, without sign, at most 0.5 [cycles].
///
/// `period` is that of the policy in cycles. The phase is the circular mean over the touchdowns of the foot; without a
/// touchdown of both feet the error is 0.5.
fn phase_error(of_fl: &[usize], of_foot: &[usize], period: f64, commanded: f64) -> f64 {
    let mut mean = [0.0; 2];
    for touchdown in of_foot {
        // A foot whose phase is ahead touches down earlier.
        let Some(reference) = of_fl.iter().min_by_key(|step| step.abs_diff(*touchdown)) else { continue };
        let phase = (*reference as f64 - *touchdown as f64) * period - commanded;
        let (sin, cos) = (TAU * phase).sin_cos();
        mean = [mean[0] + sin, mean[1] + cos];
    }
    if mean == [0.0; 2] { 0.5 } else { mean[0].atan2(mean[1]).abs() / TAU }
}

/// Sums over all robots.
#[derive(Default)]
struct Sums {
    steps: u64,
    velocity: f64,
    yaw_rate: f64,
    foot_steps: u64,
    contacts: u64,
    commands: u64,
    followed: u64,
    frequency_error: f64,
    phase_error: f64,
}

impl Sums {
    fn add_errors(&mut self, linear: f32, yaw: f32) {
        self.steps += 1;
        self.velocity += f64::from(linear);
        self.yaw_rate += f64::from(yaw);
    }

    fn motion(&self, gait: Gait, up: f64) -> GaitMotion {
        let (steps, commands) = (self.steps as f64, self.commands as f64);
        GaitMotion {
            gait: gait.name(),
            up,
            followed: self.followed as f64 / commands,
            frequency_error: self.frequency_error / commands,
            phase_error: self.phase_error / commands,
            duty_factor: self.contacts as f64 / self.foot_steps as f64,
            velocity_rms: (self.velocity / steps).sqrt(),
            yaw_rate_rms: (self.yaw_rate / steps).sqrt(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phase_is_that_of_the_touchdowns() {
        // A cycle of 20 steps: FL at 0, 20, 40; the other foot 5 steps later is a quarter of a cycle behind.
        let (of_fl, later) = ([0, 20, 40], [5, 25, 45]);
        assert!(phase_error(&of_fl, &later, 0.05, 0.75) < 1e-9);
        assert!((phase_error(&of_fl, &later, 0.05, 0.5) - 0.25).abs() < 1e-9);
        // Across the end of the cycle.
        assert!((phase_error(&of_fl, &[19, 39], 0.05, 0.0) - 0.05).abs() < 1e-9);
        assert_eq!(phase_error(&of_fl, &[], 0.05, 0.0), 0.5);
    }

    #[test]
    fn a_trot_is_followed_as_a_trot_and_not_as_a_pace() {
        let spec = twinstep_envs::GaitTask::new(GaitConfig::default(), &twinstep_model::go2(), true).expect("valid");
        let layout = Layout::new(twinstep_envs::Task::spec(&spec)).expect("the spec of the task");
        let measure = |offsets: [f32; 3]| {
            let (mut walker, mut sums) = (Walker::default(), Sums::default());
            for step in 0..200 {
                let mut obs = vec![0.0; layout.obs_len];
                obs[layout.step_frequency] = 2.5;
                obs[layout.phase_offset..][..3].copy_from_slice(&offsets);
                // A cycle of 20 steps; FL and RR are on the ground in its first half.
                let mut truth = vec![0.0; layout.critic_len];
                let diagonal = if step % 20 < 10 { [80.0, 0.0, 0.0, 80.0] } else { [0.0, 80.0, 80.0, 0.0] };
                truth[layout.foot_force..][..4].copy_from_slice(&diagonal);
                walker.add(&layout, (&obs, &truth), step, &mut sums);
            }
            walker.end_command(&layout, &mut sums);
            sums.motion(Gait::Trot, 1.0)
        };
        let trot = measure(Gait::Trot.phase_offset());
        assert!(trot.followed == 1.0 && trot.frequency_error < 1e-6 && trot.phase_error < 1e-6, "{trot:?}");
        assert!((trot.duty_factor - 0.5).abs() < 1e-9);
        let pace = measure(Gait::Pace.phase_offset());
        assert!(pace.followed == 0.0 && (pace.phase_error - 1.0 / 3.0).abs() < 1e-6, "{pace:?}");
    }
}
