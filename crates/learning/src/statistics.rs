//! Statistics of collected steps: reward terms, falls, velocity errors.

use twinstep_model::{EnvSpec, SpecField, Trajectory};

/// Sums over collected steps.
#[derive(Clone, Debug, PartialEq)]
pub struct Statistics {
    /// Number of steps.
    pub steps: u64,
    /// Sum of the rewards.
    pub reward: f64,
    /// Number of ended episodes.
    pub episodes: u64,
    /// Number of terminated episodes.
    pub falls: u64,
    /// Sum of the lengths of the ended episodes [steps].
    pub length: u64,
    /// Sum of each weighted reward term over the ended episodes.
    pub terms: Vec<f64>,
    /// Number of steps with an observed velocity: all but the last one of each episode.
    pub velocity_steps: u64,
    /// Sum of the squared error of the horizontal velocity [m²/s²]. Zero if it is not observed.
    pub velocity_error: f64,
    /// Sum of the squared error of the yaw rate [rad²/s²].
    pub yaw_rate_error: f64,
    /// Sum of the levels of robots on a course, and their number.
    pub levels: [f64; 2],
    layout: Option<VelocityLayout>,
}

/// Positions of command and velocity in the observations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityLayout {
    obs_len: usize,
    critic_len: usize,
    command: usize,
    linear_velocity: usize,
    angular_velocity: usize,
}

impl VelocityLayout {
    /// Returns the positions. The command of a task with a path is the velocity of the path.
    ///
    /// Returns `None` if the task has no such command, or velocities are not observed.
    pub fn new(spec: &EnvSpec) -> Option<Self> {
        Some(Self {
            obs_len: spec.obs_len(),
            critic_len: spec.critic_obs_len(),
            command: position(&spec.observation, "velocity_command")
                .or_else(|| position(&spec.observation, "path_velocity"))?,
            linear_velocity: position(&spec.critic_observation, "true_linear_velocity")?,
            angular_velocity: position(&spec.critic_observation, "true_angular_velocity")?,
        })
    }

    /// Returns the squared errors of horizontal velocity [m²/s²] and yaw rate [rad²/s²] of a robot.
    ///
    /// `obs` are the observations before a step, with the command of the step; `critic_obs` those after it.
    pub fn squared_errors(&self, obs: &[f32], critic_obs: &[f32], robot: usize) -> [f32; 2] {
        let command = &obs[robot * self.obs_len + self.command..][..3];
        let truth = &critic_obs[robot * self.critic_len..][..self.critic_len];
        let velocity = &truth[self.linear_velocity..][..2];
        let yaw_rate = truth[self.angular_velocity + 2];
        let linear = (velocity[0] - command[0]).powi(2) + (velocity[1] - command[1]).powi(2);
        [linear, (yaw_rate - command[2]).powi(2)]
    }
}

fn position(fields: &[SpecField], name: &str) -> Option<usize> {
    let index = fields.iter().position(|field| field.name == name)?;
    Some(fields[..index].iter().map(|field| field.size).sum())
}

impl Statistics {
    /// Creates sums of zero for the task of `spec`.
    pub fn new(spec: &EnvSpec) -> Self {
        Self {
            steps: 0,
            reward: 0.0,
            episodes: 0,
            falls: 0,
            length: 0,
            terms: vec![0.0; spec.reward_terms.len()],
            velocity_steps: 0,
            velocity_error: 0.0,
            yaw_rate_error: 0.0,
            levels: [0.0; 2],
            layout: VelocityLayout::new(spec),
        }
    }

    /// Adds the steps of all robots.
    pub fn add(&mut self, trajectory: &Trajectory) {
        let num_envs = trajectory.num_envs;
        self.steps += trajectory.reward.len() as u64;
        self.reward += trajectory.reward.iter().map(|reward| f64::from(*reward)).sum::<f64>();
        for (step, episode) in &trajectory.ended {
            self.episodes += 1;
            self.falls += u64::from(trajectory.terminated[step * num_envs + episode.env]);
            self.length += u64::from(episode.length);
            self.terms.iter_mut().zip(&episode.terms).for_each(|(sum, term)| *sum += f64::from(*term));
        }
        let Some(layout) = self.layout else { return };
        for step in 0..trajectory.steps {
            let obs = &trajectory.obs[step * num_envs * layout.obs_len..];
            let critic_obs = &trajectory.critic_obs[(step + 1) * num_envs * layout.critic_len..];
            // The observation of an ended episode is already that of the next one.
            for robot in (0..num_envs).filter(|robot| !trajectory.done(step, *robot)) {
                let [linear, yaw] = layout.squared_errors(obs, critic_obs, robot);
                self.velocity_steps += 1;
                self.velocity_error += f64::from(linear);
                self.yaw_rate_error += f64::from(yaw);
            }
        }
    }

    /// Adds the mean level of robots on a course.
    pub fn add_level(&mut self, mean_level: f64, robots: usize) {
        self.levels[0] += mean_level * robots as f64;
        self.levels[1] += robots as f64;
    }

    /// Returns the mean level of the robots on a course; the first is 0. `None` without a course.
    pub fn mean_level(&self) -> Option<f64> {
        let [sum, robots] = self.levels;
        (robots > 0.0).then(|| sum / robots)
    }

    /// Adds the sums of other steps.
    pub fn merge(&mut self, other: &Self) {
        self.steps += other.steps;
        self.reward += other.reward;
        self.episodes += other.episodes;
        self.falls += other.falls;
        self.length += other.length;
        self.velocity_steps += other.velocity_steps;
        self.velocity_error += other.velocity_error;
        self.yaw_rate_error += other.yaw_rate_error;
        self.levels = [self.levels[0] + other.levels[0], self.levels[1] + other.levels[1]];
        self.terms.iter_mut().zip(&other.terms).for_each(|(sum, term)| *sum += term);
    }

    /// Returns the root mean square errors of horizontal velocity [m/s] and yaw rate [rad/s].
    ///
    /// Returns `None` if velocities are not observed.
    pub fn velocity_rms(&self) -> Option<[f64; 2]> {
        let rms = |sum: f64| (sum / self.velocity_steps.max(1) as f64).sqrt();
        self.layout.map(|_| [rms(self.velocity_error), rms(self.yaw_rate_error)])
    }
}
