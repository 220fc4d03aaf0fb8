//! Runs a policy on one robot.

use std::time::{Duration, Instant};

use twinstep_model::{
    EnvError, EnvSpec, GaitCommand, ResetRequest, Stream, VecEnv, VelocityCommand, standard_normal, stream,
};

use crate::error::AgentError;
use crate::joint_recorder::JointRecorder;
use crate::pacer::Pacer;
use crate::policy::BoundPolicy;
use crate::policy_input::PolicyInput;
use crate::recorder::Recorder;
use crate::summary::{RunSummary, Sums};

/// Time with a velocity command of zero at the end of a run on a real robot [s]. A robot that is left in the middle of a stride
/// stands on two legs.
const BRAKE_S: f64 = 0.8;

/// What to run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunPlan {
    /// Time of the policy after which the run ends [s]. Default: never.
    pub seconds: Option<f64>,
    /// True to begin a step every policy period; false to step as fast as the robot answers.
    pub real_time: bool,
    /// Standard deviation of Gaussian noise that is added to every action; 0 for none.
    pub action_noise: f64,
    /// Seed of the robot's random numbers, and of the noise.
    pub seed: u64,
    /// True to wait for the operator and go on after a real robot was stopped; false to end with an error.
    pub goes_on: bool,
}

/// Logs of a run, at most one.
#[derive(Default)]
pub struct Recorders<'a> {
    /// Log with a row per policy step.
    pub steps: Option<&'a mut Recorder>,
    /// Log with a row per actuator period.
    pub joints: Option<&'a mut JointRecorder>,
}

/// What to do in the next step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Control {
    /// Step with these commands.
    Step(WantedCommands),
    /// End the run.
    End,
}

/// Commands of a step; `None` for those of the endpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WantedCommands {
    /// Velocity command.
    pub velocity: Option<VelocityCommand>,
    /// Gait command.
    pub gait: Option<GaitCommand>,
}

impl WantedCommands {
    /// Returns a velocity command alone.
    pub fn velocity(velocity: Option<VelocityCommand>) -> Self {
        Self { velocity, gait: None }
    }
}

/// State of a run before a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Status {
    /// Time of the policy so far [s].
    pub seconds: f64,
    /// Velocity command in force; `None` if the endpoint has none.
    pub command: Option<[f32; 3]>,
    /// Velocity in the base frame: forward [m/s], left [m/s], yaw rate [rad/s]. `None` on a real robot.
    pub velocity: Option<[f32; 3]>,
    /// Number of falls so far.
    pub falls: u64,
    /// Time of the last step [s].
    pub step_time: f64,
    /// Lateness of the last step [s].
    pub lateness: f64,
}

/// Parts of the observation that a run reads.
#[derive(Clone, Copy)]
struct Layout {
    command: Option<usize>,
    step_frequency: Option<usize>,
    yaw_rate: Option<usize>,
    /// In group `critic`.
    velocity: Option<usize>,
}

impl Layout {
    fn new(spec: &EnvSpec) -> Self {
        let vector = |field: Option<(usize, &twinstep_model::SpecField)>| {
            field.filter(|(_, field)| field.size == 3).map(|(start, _)| start)
        };
        Self {
            command: vector(spec.observation_field("velocity_command")),
            step_frequency: spec.observation_field("step_frequency").map(|(start, _)| start),
            yaw_rate: vector(spec.observation_field("base_angular_velocity")).map(|start| start + 2),
            velocity: vector(spec.critic_field("true_linear_velocity")),
        }
    }

    /// Returns the velocity in the base frame, with the yaw rate of the gyroscope.
    fn velocity(self, obs: &[f32], critic_obs: &[f32]) -> Option<[f32; 3]> {
        let (linear, yaw_rate) = (self.velocity?, self.yaw_rate?);
        Some([critic_obs[linear], critic_obs[linear + 1], obs[yaw_rate]])
    }
}

/// Steps robot 0 of `env`, which must have one robot and [`twinstep_model::AutoresetMode::Disabled`].
///
/// `control` is called before every step, with the robot to look at. After a fall the robot is reset and the run goes on;
/// one that was stopped by a fault ends the run unless the plan goes on.
/// If it fails, the rows of all executed steps are in the log. A real robot that follows velocities gets some steps more with a
/// velocity of zero, which are not part of the run.
pub fn run(
    env: &mut dyn VecEnv,
    policy: &mut BoundPolicy,
    mut recorders: Recorders,
    plan: RunPlan,
    control: &mut dyn FnMut(&Status, &dyn VecEnv) -> Control,
) -> Result<RunSummary, AgentError> {
    let spec = env.spec().clone();
    let layout = Layout::new(&spec);
    let mut agent = Agent {
        layout,
        obs: Vec::new(),
        critic_obs: Vec::new(),
        episode: 0,
        time_steps: 0,
        uses_commands: false,
        action_noise: plan.action_noise,
        noise: stream(plan.seed, "action noise", 0),
    };
    agent.reset(env, policy, &ResetRequest::seeded(plan.seed, 1))?;
    let (mut sums, mut step_time, mut lateness) = (Sums::default(), 0.0, 0.0);
    let mut pacer = Pacer::new(Duration::from_secs_f64(spec.policy_dt));
    loop {
        let seconds = sums.steps as f64 * spec.policy_dt;
        // Half a period of tolerance for the rounding of the product.
        if plan.seconds.is_some_and(|end| seconds + 0.5 * spec.policy_dt >= end) {
            break;
        }
        let (command, velocity) = (agent.command(), layout.velocity(&agent.obs, &agent.critic_obs));
        let status = Status { seconds, command, velocity, falls: sums.falls, step_time, lateness };
        let Control::Step(wanted) = control(&status, env) else { break };
        if let Some(recorder) = &mut recorders.steps {
            agent.observe(env, recorder, &spec)?;
        }
        let action = agent.action(policy, wanted.velocity, &spec, &mut sums)?;
        if plan.real_time {
            lateness = pacer.wait().as_secs_f64();
        }
        let start = Instant::now();
        let ended = agent.step(env, wanted, &action, &mut sums)?;
        step_time = start.elapsed().as_secs_f64();
        sums.add_times(step_time, lateness);
        agent.check_command(wanted)?;
        if let Some(recorder) = &mut recorders.steps {
            recorder.write(&action)?;
        }
        if let Some(recorder) = &mut recorders.joints {
            recorder.write(env)?;
        }
        if let Some(stop) = env.real_time().and_then(|report| report.stop.as_ref()).filter(|_| ended && !plan.goes_on) {
            return Err(AgentError::RobotStopped { reason: stop.reason.clone() });
        }
        if ended {
            agent.reset(env, policy, &ResetRequest::default())?;
            if let Some(recorder) = &mut recorders.joints {
                recorder.begin_episode();
            }
        }
    }
    if env.real_time().is_some() && agent.uses_commands {
        // The run is complete: without its client the endpoint holds the robot, and lets it sit down.
        agent.brake(env, policy, &spec, &mut pacer).ok();
    }
    let rows = recorders.steps.map_or(0, |recorder| recorder.rows());
    let rows = rows + recorders.joints.map_or(0, |recorder| recorder.rows());
    Ok(sums.summary(spec.policy_dt, layout.command.is_some(), layout.velocity.is_some(), rows))
}

/// What the agent observes.
struct Agent {
    layout: Layout,
    obs: Vec<f32>,
    critic_obs: Vec<f32>,
    episode: u64,
    /// Policy periods since the start, with one for each reset.
    time_steps: u64,
    /// True once the endpoint was seen to use a command.
    uses_commands: bool,
    /// Standard deviation of the noise of the actions.
    action_noise: f64,
    noise: Stream,
}

impl Agent {
    fn reset(
        &mut self,
        env: &mut dyn VecEnv,
        policy: &mut BoundPolicy,
        request: &ResetRequest,
    ) -> Result<(), EnvError> {
        self.obs = env.reset(request)?.to_vec();
        self.critic_obs = env.critic_obs().to_vec();
        policy.reset();
        Ok(())
    }

    /// Returns the velocity command in the observation.
    fn command(&self) -> Option<[f32; 3]> {
        self.layout.command.map(|start| [self.obs[start], self.obs[start + 1], self.obs[start + 2]])
    }

    /// Returns the step frequency in the observation [Hz].
    fn step_frequency(&self) -> Option<f32> {
        self.layout.step_frequency.map(|entry| self.obs[entry])
    }

    /// Gives the measurements of this moment to the recorder.
    fn observe(&self, env: &dyn VecEnv, recorder: &mut Recorder, spec: &EnvSpec) -> Result<(), EnvError> {
        let pose = if recorder.has_orientation() { env.scene(0)?.pose.first().copied() } else { None };
        let t = self.time_steps as f64 * spec.policy_dt;
        recorder.observe(t, self.episode, &self.obs, &self.critic_obs, pose);
        Ok(())
    }

    /// Returns the action, clipped to [−1, 1]. The policy observes the command that is wanted now.
    fn action(
        &mut self,
        policy: &mut BoundPolicy,
        wanted: Option<[f32; 3]>,
        spec: &EnvSpec,
        sums: &mut Sums,
    ) -> Result<Vec<f32>, AgentError> {
        if let (Some(start), Some(wanted)) = (self.layout.command, wanted) {
            self.obs[start..start + 3].copy_from_slice(&wanted);
        }
        let mut action = policy.action(&PolicyInput { obs: &self.obs, critic_obs: &self.critic_obs })?;
        if self.action_noise > 0.0 {
            for value in &mut action {
                *value += (self.action_noise * standard_normal(&mut self.noise)) as f32;
            }
        }
        if let Some(index) = action.iter().position(|value| !value.is_finite()) {
            let joint = spec.action_entry(index);
            return Err(AgentError::NotFinite { joint, value: action[index], steps: sums.steps });
        }
        let clipped = action.iter().filter(|value| value.abs() > 1.0).count();
        sums.clipped[0] += clipped as u64;
        sums.clipped[1] += action.len() as u64;
        Ok(action.iter().map(|value| value.clamp(-1.0, 1.0)).collect())
    }

    /// Steps the robot. Returns true if the episode ended.
    fn step(
        &mut self,
        env: &mut dyn VecEnv,
        wanted: WantedCommands,
        action: &[f32],
        sums: &mut Sums,
    ) -> Result<bool, AgentError> {
        if let Some(velocity) = wanted.velocity {
            env.set_velocity_commands(&[velocity])?;
        }
        if let Some(gait) = wanted.gait {
            env.set_gait_commands(&[gait])?;
        }
        let command = self.command();
        let batch = env.step(action)?;
        (self.obs, self.critic_obs) = (batch.obs.clone(), batch.critic_obs.clone());
        sums.steps += 1;
        self.time_steps += 1;
        sums.falls += u64::from(batch.terminated[0]);
        sums.diverged += batch.ended.iter().filter(|episode| episode.diverged).count() as u64;
        let velocity = self.layout.velocity(&self.obs, &self.critic_obs);
        let yaw_rate = self.layout.yaw_rate.map_or(0.0, |entry| self.obs[entry]);
        sums.add_motion(command.unwrap_or_default(), velocity.unwrap_or([0.0, 0.0, yaw_rate]));
        let ended = batch.done(0);
        if ended {
            self.episode += 1;
            self.time_steps += 1;
        }
        Ok(ended)
    }

    /// Steps a walking robot to a stand.
    fn brake(
        &mut self,
        env: &mut dyn VecEnv,
        policy: &mut BoundPolicy,
        spec: &EnvSpec,
        pacer: &mut Pacer,
    ) -> Result<(), AgentError> {
        let still = WantedCommands::velocity(Some([0.0; 3]));
        let mut outside = Sums::default();
        for _ in 0..(BRAKE_S / spec.policy_dt).round() as u64 {
            let action = self.action(policy, still.velocity, spec, &mut outside)?;
            pacer.wait();
            if self.step(env, still, &action, &mut outside)? {
                break;
            }
        }
        Ok(())
    }

    /// Checks after the first step with a command that the endpoint uses it.
    fn check_command(&mut self, wanted: WantedCommands) -> Result<(), AgentError> {
        if let (Some(observed), Some([wanted, ..])) = (self.step_frequency(), wanted.gait)
            && !self.uses_commands
            && (observed - wanted).abs() > 1e-6
        {
            return Err(AgentError::GaitCommandIgnored { observed, wanted });
        }
        match (self.command(), wanted.velocity) {
            (Some(observed), Some(wanted)) if !self.uses_commands && observed != wanted => {
                Err(AgentError::CommandIgnored { observed, wanted })
            }
            (_, wanted) => {
                self.uses_commands |= wanted.is_some();
                Ok(())
            }
        }
    }
}
