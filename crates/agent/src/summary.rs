//! Summary of a run.

use serde::Serialize;

/// Mean and maximum of a time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Spread {
    /// Mean [ms].
    pub mean_ms: f64,
    /// Maximum [ms].
    pub max_ms: f64,
}

/// What happened in a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RunSummary {
    /// Time of the policy: steps times the period [s].
    pub seconds: f64,
    /// Number of policy steps.
    pub steps: u64,
    /// Number of falls: episodes that the task ended.
    pub falls: u64,
    /// Number of episodes that ended because the simulation became NaN or infinite.
    pub diverged: u64,
    /// Mean velocity command: forward [m/s], left [m/s], yaw rate [rad/s]. `None` if the endpoint has none.
    pub mean_command: Option<[f64; 3]>,
    /// Mean velocity in the base frame: forward [m/s], left [m/s], yaw rate [rad/s]. `None` on a real robot.
    pub mean_velocity: Option<[f64; 3]>,
    /// Root mean square of the horizontal velocity error [m/s]. `None` on a real robot.
    pub velocity_rms: Option<f64>,
    /// Root mean square error of the yaw rate that the gyroscope measures [rad/s].
    pub yaw_rate_rms: Option<f64>,
    /// Share of the entries of actions that were clipped to [−1, 1].
    pub clipped_share: f64,
    /// Time from an action to the next observation.
    pub step_time: Spread,
    /// Lateness of the steps in real time; zero without pacing.
    pub lateness: Spread,
    /// Number of rows in the log.
    pub log_rows: u64,
}

/// Sums from which a summary is computed.
#[derive(Clone, Debug, Default)]
pub struct Sums {
    /// Number of policy steps.
    pub steps: u64,
    /// Number of falls.
    pub falls: u64,
    /// Number of diverged episodes.
    pub diverged: u64,
    /// Number of clipped entries of actions, and of all entries.
    pub clipped: [u64; 2],
    command: [f64; 3],
    velocity: [f64; 3],
    velocity_error: f64,
    yaw_rate_error: f64,
    times: [Times; 2],
}

#[derive(Clone, Copy, Debug, Default)]
struct Times {
    sum: f64,
    max: f64,
}

impl Times {
    fn add(&mut self, seconds: f64) {
        self.sum += seconds;
        self.max = self.max.max(seconds);
    }

    fn spread(self, count: f64) -> Spread {
        Spread { mean_ms: 1e3 * self.sum / count, max_ms: 1e3 * self.max }
    }
}

impl Sums {
    /// Adds the times of a step: of the step itself, and by how much it was late [s].
    pub fn add_times(&mut self, step: f64, late: f64) {
        self.times[0].add(step);
        self.times[1].add(late);
    }

    /// Adds command and velocity of a step, in the base frame.
    pub fn add_motion(&mut self, command: [f32; 3], velocity: [f32; 3]) {
        let (command, velocity) = (command.map(f64::from), velocity.map(f64::from));
        for entry in 0..3 {
            self.command[entry] += command[entry];
            self.velocity[entry] += velocity[entry];
        }
        let error = |entry: usize| (command[entry] - velocity[entry]).powi(2);
        self.velocity_error += error(0) + error(1);
        self.yaw_rate_error += error(2);
    }

    /// Returns the summary. `has_command` and `has_velocity` say what the endpoint observes.
    pub fn summary(&self, policy_dt: f64, has_command: bool, has_velocity: bool, log_rows: u64) -> RunSummary {
        // Without a step all sums are zero.
        let steps = self.steps.max(1) as f64;
        let mean = |sum: [f64; 3]| sum.map(|sum| sum / steps);
        RunSummary {
            seconds: self.steps as f64 * policy_dt,
            steps: self.steps,
            falls: self.falls,
            diverged: self.diverged,
            mean_command: has_command.then(|| mean(self.command)),
            mean_velocity: has_velocity.then(|| mean(self.velocity)),
            velocity_rms: (has_command && has_velocity).then(|| (self.velocity_error / steps).sqrt()),
            yaw_rate_rms: has_command.then(|| (self.yaw_rate_error / steps).sqrt()),
            clipped_share: self.clipped[0] as f64 / self.clipped[1].max(1) as f64,
            step_time: self.times[0].spread(steps),
            lateness: self.times[1].spread(steps),
            log_rows,
        }
    }
}
