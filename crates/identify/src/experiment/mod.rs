//! Experiment: windows of a log that are simulated from measured states, and the channels that are compared.
//!
//! - [`channel`]: the channels that are compared, and their noise.
//! - [`residuals`]: simulation of the windows, and comparison with the log.
//! - [`residual_index`]: channel and row, window, group and block of each residual.

mod channel;
mod residual_index;
mod residuals;

use std::sync::Arc;

use glam::DQuat;
use twinstep_logs::Log;
use twinstep_logs::operating_conditions::OperatingConditions;
use twinstep_logs::replay::{at_log_rate, joint_commands};
use twinstep_model::{Joint, RobotModel};

pub use channel::ResidualChannel;
pub use residual_index::Regime;
pub use residuals::{SimulatedPose, estimated_torque};

use crate::base_wrench::MeasuredStance;
use crate::error::ExperimentError;
use crate::orientation::orientation;
use crate::torque::MeasuredTorque;
use crate::window::{Window, WindowConfig, base_estimate, windows};
use channel::{Channel, channels, wrench_channels};

/// Length of a block [s]; residuals of different blocks are treated as independent.
const BLOCK_S: f64 = 0.5;

/// Root mean square of the joint speeds above which a robot with a floating base walks, trots or jumps [rad/s].
///
/// A robot that sways over standing feet moves its joints with 0.3 rad/s, one that trots with 1.5 rad/s.
const DYNAMIC_SPEED: f64 = 0.7;
/// Length of windows in which a robot with a floating base walks, trots or jumps [s].
const DYNAMIC_S: f64 = 0.5;
/// Time over which a joint speed is measured: long enough for encoder noise of 2 mrad [s].
const SPEED_S: f64 = 0.05;

/// Log split into windows.
#[derive(Clone, Debug)]
pub struct Experiment {
    windows: Vec<Window>,
    channels: Vec<Channel>,
    /// Rate at which the actuators are replayed [Hz].
    actuator_hz: f64,
    /// Measured orientations by row; empty without a floating base.
    orientations: Vec<DQuat>,
    /// Joints of the log.
    joints: Vec<Joint>,
    /// Number of rows in a block.
    rows_per_block: usize,
    conditions: OperatingConditions,
    /// Standard deviations of position and velocity of the initial states, where they are estimated [m], [m/s].
    estimated_start: Option<[f64; 2]>,
    /// Torques, for windows in which they are compared on measured states; `None` if there are none.
    torques: Option<Arc<MeasuredTorque>>,
    /// States and torques of the robot where it stands.
    stance: Arc<MeasuredStance>,
}

impl Experiment {
    /// Creates an experiment from `log`, for robots with the gains and rates of `robot`.
    pub fn new(log: &Log, robot: &RobotModel, horizon: WindowConfig) -> Result<Self, ExperimentError> {
        let joints: Vec<_> = joint_commands(log)?.iter().map(|joint| joint.joint).collect();
        let robot = &at_log_rate(log, robot)?;
        let mut windows = windows(log, robot, horizon)?;
        let mut channels = channels(log, &joints);
        let rows_per_block = ((BLOCK_S * log.meta().rate_hz).round() as usize).max(1);
        for window in windows.iter_mut().filter(|window| !window.base.is_fixed()) {
            window.fast = joint_speed(&channels, rows_per_block, window) > DYNAMIC_SPEED;
        }
        let estimate = base_estimate(log, robot)?;
        let stance = MeasuredStance::new(log, robot, estimate.as_ref());
        channels.extend(wrench_channels(log.rows(), &stance, &windows));
        let floating = windows.iter().any(|window| !window.base.is_fixed());
        let is_fast = |row: usize| windows.iter().any(|window| window.fast && window.rows.contains(&row));
        let torques = if windows.iter().any(|window| window.fast) {
            Some(Arc::new(MeasuredTorque::new(log, robot)?.only_ranges_with(is_fast)))
        } else {
            None
        };
        let orientations =
            if floating { (0..log.rows()).map(|row| orientation(log, row)).collect() } else { Vec::new() };
        Ok(Self {
            actuator_hz: robot.control.actuator_hz,
            torques,
            windows,
            channels,
            orientations,
            joints,
            rows_per_block,
            conditions: OperatingConditions::of(log),
            stance: Arc::new(stance),
            estimated_start: estimate.map(|estimate| [estimate.height_sigma, estimate.velocity_sigma]),
        })
    }

    /// Returns the joints of the log.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Returns the experiment restricted to the rows that `keep` selects.
    #[must_use]
    pub fn filter_rows(mut self, keep: impl Fn(usize) -> bool) -> Self {
        for channel in &mut self.channels {
            for (row, cell) in channel.measured.iter_mut().enumerate() {
                if !keep(row) {
                    *cell = f64::NAN;
                }
            }
        }
        for window in &mut self.windows {
            // Rows after the last selected one are not simulated.
            let last = window.rows.clone().rev().find(|row| keep(*row)).unwrap_or(window.rows.start);
            window.truncate(last + 1 - window.rows.start);
        }
        self.windows.retain(|window| window.rows.len() > 1);
        self
    }

    /// Returns true if a window has a fixed base.
    pub fn has_fixed_base(&self) -> bool {
        self.windows.iter().any(|window| window.base.is_fixed())
    }

    /// Returns the experiment without joint velocities, which repeat the information of positions with more noise.
    #[must_use]
    pub fn without_velocities(mut self) -> Self {
        self.channels.retain(|channel| !matches!(channel.quantity, ResidualChannel::Velocity(_)));
        self
    }

    /// Marks the windows in which a robot with a floating base walks, trots or jumps, and shortens them.
    ///
    /// Feet that touch down a few milliseconds earlier move the base by more than the effects that are looked for, and
    /// two engines differ by as much. The residuals of these windows are groups of their own ([`Regime::Dynamic`]), with
    /// the error of the contact model as their scale. Errors grow less in short windows.
    #[must_use]
    pub fn mark_dynamic_windows(mut self) -> Self {
        let most = ((DYNAMIC_S * self.rows_per_block as f64 / BLOCK_S).round() as usize).max(2);
        for window in self.windows.iter_mut().filter(|window| window.fast) {
            window.dynamic = true;
            window.truncate(most.min(window.rows.len()));
        }
        self
    }

    /// Returns the number of rows in all windows that are not dynamic.
    pub fn num_quiet_rows(&self) -> usize {
        self.windows.iter().filter(|window| !window.dynamic).map(|window| window.rows.len()).sum()
    }

    /// Returns the number of rows in all windows.
    pub fn num_rows(&self) -> usize {
        self.windows.iter().map(|window| window.rows.len()).sum()
    }

    /// Returns true if a window has a floating base.
    pub fn has_floating_base(&self) -> bool {
        self.windows.iter().any(|window| !window.base.is_fixed())
    }

    /// Dimension of a floating base's initial state: position, orientation, velocity, angular velocity.
    pub const INITIAL_STATE_DIM: usize = 12;

    /// Returns the experiment with one component of every initial base state perturbed.
    ///
    /// The perturbation is `size` standard deviations of the smoothed measurement.
    pub fn with_perturbed_start(&self, number: usize, size: f64) -> Self {
        let (of_axis, axis) = (number / 3, number % 3);
        let quantity = [
            ResidualChannel::BasePosition,
            ResidualChannel::BaseOrientation,
            ResidualChannel::BaseVelocity,
            ResidualChannel::BaseRate,
        ][of_axis];
        // The variance of a parabola fit through n cells within 20 ms is 9 / 4n of a cell's variance at the midpoint.
        let cells = 1.0 + 0.04 * self.rows_per_block as f64 / BLOCK_S;
        let quantity = quantity(axis);
        let is_compared = self.channels.iter().any(|channel| channel.quantity == quantity);
        let error = match (quantity, self.estimated_start) {
            (ResidualChannel::BasePosition(_), Some([sigma, _]))
            | (ResidualChannel::BaseVelocity(_), Some([_, sigma]))
                if !is_compared =>
            {
                size * sigma
            }
            _ => size * (2.25 / cells).sqrt().min(1.0) * self.sigma(quantity),
        };
        let mut perturbed = self.clone();
        for window in perturbed.windows.iter_mut().filter(|window| !window.base.is_fixed()) {
            window.perturb_start(of_axis, axis, error);
        }
        perturbed
    }

    /// Returns the standard deviation of a channel's noise, in the channel's unit; 1 if it is not compared.
    pub fn sigma(&self, quantity: ResidualChannel) -> f64 {
        self.channels.iter().find(|channel| channel.quantity == quantity).map_or(1.0, |channel| channel.sigma)
    }
}

/// Returns the root mean square of the joint speeds in a window [rad/s].
fn joint_speed(channels: &[Channel], rows_per_block: usize, window: &Window) -> f64 {
    let rate_hz = rows_per_block as f64 / BLOCK_S;
    let stride = ((SPEED_S * rate_hz).round() as usize).max(1);
    let positions = channels.iter().filter(|channel| matches!(channel.quantity, ResidualChannel::Position(_)));
    let squares = positions.flat_map(|channel| {
        let rows = window.rows.start..window.rows.end.saturating_sub(stride);
        rows.map(|row| (channel.measured[row + stride] - channel.measured[row]) * rate_hz / stride as f64)
    });
    let speeds: Vec<f64> = squares.filter(|speed| speed.is_finite()).collect();
    (speeds.iter().map(|speed| speed * speed).sum::<f64>() / speeds.len().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::{BaseMount, go2};

    use super::*;

    /// Returns an experiment of 4 s of `base` whose joints swing by 0.2 rad at `hz`, with noise of 2 mrad.
    fn experiment(base: BaseMount, hz: f64) -> Experiment {
        const ROWS: usize = 800;
        let column = |name: String, of: &dyn Fn(f64) -> f64| {
            (name, (0..ROWS).map(|row| of(row as f64 / 200.0)).collect::<Vec<f64>>())
        };
        let noise = |t: f64| 0.004 * ((t * 200.0 * 7919.0) % 1009.0 / 1009.0 - 0.5);
        let mut columns = vec![column("t".to_owned(), &|t| t)];
        for (name, value) in [("kp", 30.0), ("kd", 0.8), ("pos_z", 0.3), ("quat_w", 1.0), ("vel_x", 0.0)] {
            columns.push(column(name.to_owned(), &|_| value));
        }
        for joint in Joint::ALL {
            let swing = move |t: f64| 0.2 * (std::f64::consts::TAU * hz * t).sin();
            columns.push(column(format!("q_{joint}"), &|t| swing(t) + noise(t)));
            columns.push(column(format!("q_cmd_{joint}"), &swing));
        }
        let segments = vec![Segment { name: "part".to_owned(), base }];
        let log = Log::new(Meta::new(200.0, TorqueSensor::None, segments), columns).expect("a log");
        Experiment::new(&log, &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
    }

    #[test]
    fn windows_with_fast_joints_are_dynamic_if_the_base_floats() {
        let rows = |base, hz| {
            let experiment = experiment(base, hz);
            (experiment.num_rows(), experiment.mark_dynamic_windows().num_quiet_rows())
        };
        let (all, kept) = rows(BaseMount::Floating, 0.4);
        assert_eq!(all, kept, "a robot that sways");
        assert_eq!(rows(BaseMount::Floating, 2.0).1, 0, "a robot that trots");
        let (all, kept) = rows(BaseMount::Fixed, 2.0);
        assert_eq!(all, kept, "a robot that hangs");
    }
}
