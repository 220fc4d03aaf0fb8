//! Experiment: windows of a log that are simulated from measured states, and the channels that are compared.

use glam::DQuat;
use rayon::prelude::*;
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{
    BaseMount, Joint, NUM_JOINTS, PerJoint, Precision, RobotModel, RobotStates, Rollout, RolloutRequest,
};

use crate::error::ExperimentError;
use crate::window::{Window, WindowConfig, orientation, windows};
use twinstep_logs::operating_conditions::OperatingConditions;
use twinstep_logs::replay::{at_log_rate, delayed_mean, joint_commands};

/// Length of a block [s]; residuals of different blocks are treated as independent.
const BLOCK_S: f64 = 0.5;
/// Standard deviation of the noise of each quantity, for channels whose metadata do not state it.
const ASSUMED_NOISE: [(&str, f64); 7] =
    [("q", 0.002), ("dq", 0.05), ("tau_measured", 0.2), ("pos", 0.005), ("quat", 0.01), ("vel", 0.05), ("gyro", 0.02)];

/// Channel that is compared in every row.
#[derive(Clone, Debug)]
struct Channel {
    quantity: ResidualChannel,
    /// Standard deviation of the noise, in the channel's unit.
    sigma: f64,
    /// Measured values by row; NaN for a missing cell.
    measured: Vec<f64>,
}

/// Quantity that is compared, with its joint or axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResidualChannel {
    /// Position of a joint.
    Position(usize),
    /// Velocity of a joint.
    Velocity(usize),
    /// Torque of a joint at the current sensor.
    Torque(usize),
    /// Base position along a world axis.
    BasePosition(usize),
    /// Component of the rotation vector from the measured to the simulated base orientation.
    BaseOrientation(usize),
    /// Base velocity along a world axis.
    BaseVelocity(usize),
    /// Angular velocity about a base axis.
    BaseRate(usize),
}

impl Channel {
    /// Returns the compared rows of `window`, each with its index in the window. Rows of the burn-in are excluded.
    fn rows<'a>(&'a self, window: &'a Window) -> impl Iterator<Item = (usize, usize)> + 'a {
        let of_base = matches!(
            self.quantity,
            ResidualChannel::BasePosition(_)
                | ResidualChannel::BaseOrientation(_)
                | ResidualChannel::BaseVelocity(_)
                | ResidualChannel::BaseRate(_)
        );
        // A torque is the mean to the next row, so the last row has none.
        let end = window.rows.len() - usize::from(matches!(self.quantity, ResidualChannel::Torque(_)));
        let first = if of_base && window.base.is_fixed() { end } else { window.settling };
        (first..end).map(|index| (index, window.rows.start + index)).filter(|(_, row)| self.measured[*row].is_finite())
    }
}

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
}

impl Experiment {
    /// Creates an experiment from `log`, for robots with the gains and rates of `robot`.
    pub fn new(log: &Log, robot: &RobotModel, horizon: WindowConfig) -> Result<Self, ExperimentError> {
        let joints: Vec<_> = joint_commands(log)?.iter().map(|joint| joint.joint).collect();
        let robot = &at_log_rate(log, robot)?;
        let windows = windows(log, robot, horizon)?;
        let floating = windows.iter().any(|window| !window.base.is_fixed());
        let orientations =
            if floating { (0..log.rows()).map(|row| orientation(log, row)).collect() } else { Vec::new() };
        Ok(Self {
            actuator_hz: robot.control.actuator_hz,
            windows,
            channels: channels(log, &joints),
            orientations,
            joints,
            rows_per_block: ((BLOCK_S * log.meta().rate_hz).round() as usize).max(1),
            conditions: OperatingConditions::of(log),
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
            let count = last + 1 - window.rows.start;
            window.rows.end = last + 1;
            window.period.truncate(count);
            window.commands.truncate(window.period[count - 1] + 1);
        }
        self.windows.retain(|window| window.rows.len() > 1);
        self
    }

    /// Returns the residuals of each candidate: simulated minus measured, divided by the noise.
    ///
    /// There is one residual per measured cell, in the same order for every candidate. If a candidate diverges, its
    /// residuals are not finite from then on.
    pub fn residuals(
        &self,
        simulator: &mut dyn Rollout,
        candidates: &[RobotModel],
        precision: Precision,
    ) -> Vec<Vec<f64>> {
        let candidates = &self.at_rate(candidates);
        let trajectories = self.simulate(simulator, candidates, precision);
        candidates
            .par_iter()
            .zip(trajectories.par_chunks(self.windows.len().max(1)))
            .map(|(robot, windows)| {
                let mut residuals = Vec::new();
                for (channel, window, states) in self.compared(windows) {
                    self.compare(channel, window, states, robot, |_, difference| {
                        residuals.push(difference / channel.sigma);
                    });
                }
                residuals
            })
            .collect()
    }

    /// Returns the experiment restricted to windows with a fixed base, if there are any.
    #[must_use]
    pub fn prefer_fixed_base(mut self) -> Self {
        if self.windows.iter().any(|window| window.base.is_fixed()) {
            self.windows.retain(|window| window.base.is_fixed());
        }
        self
    }

    /// Returns true if a window has a floating base.
    pub fn has_floating_base(&self) -> bool {
        self.windows.iter().any(|window| !window.base.is_fixed())
    }

    /// Returns the channel and row of every residual.
    pub fn residual_index(&self) -> impl Iterator<Item = (ResidualChannel, usize)> {
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        windows.flat_map(|(channel, window)| channel.rows(window).map(move |(_, row)| (channel.quantity, row)))
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
        let error = size * (2.25 / cells).sqrt().min(1.0) * self.sigma(quantity(axis));
        let mut perturbed = self.clone();
        for window in perturbed.windows.iter_mut().filter(|window| !window.base.is_fixed()) {
            window.perturb_start(of_axis, axis, error);
        }
        perturbed
    }

    /// Returns the indices of the residuals of every window with a floating base.
    pub fn free_windows(&self) -> Vec<Vec<usize>> {
        let mut of_window = vec![Vec::new(); self.windows.len()];
        let mut next = 0;
        for channel in &self.channels {
            for (window, own) in self.windows.iter().zip(&mut of_window) {
                let count = channel.rows(window).count();
                own.extend(next..next + count);
                next += count;
            }
        }
        let pairs = self.windows.iter().zip(of_window);
        pairs.filter(|(window, own)| !window.base.is_fixed() && !own.is_empty()).map(|(_, own)| own).collect()
    }

    /// Returns the standard deviation of a channel's noise, in the channel's unit; 1 if it is not compared.
    pub fn sigma(&self, quantity: ResidualChannel) -> f64 {
        self.channels.iter().find(|channel| channel.quantity == quantity).map_or(1.0, |channel| channel.sigma)
    }

    /// Upper bound of the values of [`Experiment::groups`].
    pub const GROUPS: usize = 14;

    /// Returns true if a group has a fixed base.
    pub fn is_held(group: usize) -> bool {
        group % 2 == 1
    }

    /// Returns the group of every residual: a number for its quantity and the mount of the base.
    pub fn groups(&self) -> Vec<usize> {
        let group = |channel: &Channel, window: &Window| {
            let quantity = match channel.quantity {
                ResidualChannel::Position(_) => 0,
                ResidualChannel::Velocity(_) => 1,
                ResidualChannel::Torque(_) => 2,
                ResidualChannel::BasePosition(_) => 3,
                ResidualChannel::BaseOrientation(_) => 4,
                ResidualChannel::BaseVelocity(_) => 5,
                ResidualChannel::BaseRate(_) => 6,
            };
            2 * quantity + usize::from(window.base.is_fixed())
        };
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        let same = windows.flat_map(|(channel, window)| channel.rows(window).map(move |_| group(channel, window)));
        same.collect()
    }

    /// Returns the block of every residual: half a second, or a window with a floating base.
    pub fn blocks(&self) -> Vec<usize> {
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        let block = |window: &Window, row: usize| {
            // An error of the initial state persists through a whole window with a floating base.
            (if window.base.is_fixed() { row } else { window.rows.start }) / self.rows_per_block
        };
        windows.flat_map(|(channel, window)| channel.rows(window).map(move |(_, row)| block(window, row))).collect()
    }

    /// Returns rows and position errors of each joint, simulated minus measured [rad].
    pub fn position_errors(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> [Vec<(usize, f64)>; NUM_JOINTS] {
        let robot = &self.at_rate(std::slice::from_ref(robot))[0];
        let windows = self.simulate(simulator, std::slice::from_ref(robot), Precision::Double);
        let mut errors = [const { Vec::new() }; NUM_JOINTS];
        for (channel, window, states) in self.compared(&windows) {
            if let ResidualChannel::Position(joint) = channel.quantity {
                self.compare(channel, window, states, robot, |row, difference| errors[joint].push((row, difference)));
            }
        }
        errors
    }

    /// Returns the robots with the actuator rate of the log.
    fn at_rate(&self, robots: &[RobotModel]) -> Vec<RobotModel> {
        let mut robots = robots.to_vec();
        for robot in &mut robots {
            robot.control.actuator_hz = self.actuator_hz;
        }
        robots
    }

    fn simulate(
        &self,
        simulator: &mut dyn Rollout,
        candidates: &[RobotModel],
        precision: Precision,
    ) -> Vec<RobotStates> {
        let derating: Vec<_> = candidates.iter().map(|robot| self.derating(robot)).collect();
        let mut jobs = Vec::new();
        for (robot, derating) in candidates.iter().zip(&derating) {
            for (index, window) in self.windows.iter().enumerate() {
                // The measured initial state contains the gyroscope bias.
                let mut start = window.start;
                for (rate, bias) in start.base_angular_velocity.iter_mut().zip(robot.gyro_bias.to_array()) {
                    *rate -= bias as f32;
                }
                jobs.push(RolloutRequest {
                    robot,
                    base: window.base,
                    start,
                    history: &window.history,
                    commands: &window.commands,
                    derating: derating.get(index).map_or(&[], Vec::as_slice),
                });
            }
        }
        simulator.run(&jobs, precision)
    }

    /// Returns the derating factors of the windows by actuator period; empty if the log has neither voltage nor
    /// temperature.
    fn derating(&self, robot: &RobotModel) -> Vec<Vec<PerJoint>> {
        if self.conditions.is_empty() {
            return Vec::new();
        }
        let of = |window: &Window| {
            let mut factors = vec![[1.0; NUM_JOINTS]; window.commands.len()];
            for (pair, row) in window.period.windows(2).zip(window.rows.clone()) {
                factors[pair[0]..pair[1]].fill(self.conditions.derating_factors(&robot.derating, row));
            }
            factors
        };
        self.windows.iter().map(of).collect()
    }

    fn compared<'a>(
        &'a self,
        windows: &'a [RobotStates],
    ) -> impl Iterator<Item = (&'a Channel, &'a Window, &'a RobotStates)> {
        self.channels.iter().flat_map(move |channel| {
            self.windows.iter().zip(windows).map(move |(window, states)| (channel, window, states))
        })
    }

    /// Calls `each` with every compared row and its difference, simulated minus measured.
    fn compare(
        &self,
        channel: &Channel,
        window: &Window,
        states: &RobotStates,
        robot: &RobotModel,
        mut each: impl FnMut(usize, f64),
    ) {
        for (index, row) in channel.rows(window) {
            let period = window.period[index];
            let simulated = match channel.quantity {
                ResidualChannel::Position(joint) => f64::from(states.measured.q[period][joint]),
                ResidualChannel::Velocity(joint) => f64::from(states.measured.dq[period][joint]),
                ResidualChannel::Torque(joint) => {
                    let until = window.period.get(index + 1).copied().unwrap_or(period + 1);
                    estimated_torque(states, robot, joint, period, until)
                }
                ResidualChannel::BasePosition(axis) => f64::from(states.truth.base_position[period][axis]),
                ResidualChannel::BaseOrientation(axis) => {
                    let [w, x, y, z] = states.measured.orientation[period].map(f64::from);
                    let rotation = self.orientations[row].inverse() * DQuat::from_xyzw(x, y, z, w);
                    let rotation = if rotation.w < 0.0 { -rotation } else { rotation };
                    rotation.to_scaled_axis()[axis]
                }
                ResidualChannel::BaseVelocity(axis) => f64::from(states.truth.base_linear_velocity[period][axis]),
                ResidualChannel::BaseRate(axis) => f64::from(states.measured.gyro[period][axis]),
            };
            each(row, simulated - channel.measured[row]);
        }
    }
}

/// Returns the mean torque over actuator periods `from..until`, with the delay of the torque sensor [N·m].
pub fn estimated_torque(states: &RobotStates, robot: &RobotModel, joint: usize, from: usize, until: usize) -> f64 {
    let delay = robot.joints[joint].actuator.sensor_delay / robot.control.actuator_dt();
    // Entry p + 1 has the torque of period p.
    let last = states.measured.tau.len() - 1;
    delayed_mean(
        |period| f64::from(states.measured.tau[(period + 1).min(last)][joint]),
        from..until.max(from + 1),
        delay,
    )
}

fn channels(log: &Log, joints: &[Joint]) -> Vec<Channel> {
    let mut channels = Vec::new();
    let mut add = |quantity: ResidualChannel, name: String, kind: &str, measured: Option<&[f64]>| {
        let assumed = ASSUMED_NOISE.iter().find(|(quantity, _)| *quantity == kind).expect("a known kind").1;
        if let Some(measured) = measured {
            let sigma = log.noise(&name).filter(|sigma| *sigma > 0.0).unwrap_or(assumed);
            channels.push(Channel { quantity, sigma, measured: measured.to_vec() });
        }
    };
    for joint in joints {
        let (index, name) = (joint.index(), joint.name());
        add(ResidualChannel::Position(index), format!("q_{name}"), "q", log.q(name));
        add(ResidualChannel::Velocity(index), format!("dq_{name}"), "dq", log.dq(name));
        if log.meta().tau_sensor == TorqueSensor::MotorCurrent {
            add(ResidualChannel::Torque(index), format!("tau_measured_{name}"), "tau_measured", log.tau_measured(name));
        }
    }
    if log.segments().any(|(segment, _)| segment.base == BaseMount::Floating) {
        let known = |row: usize| {
            ["w", "x", "y", "z"]
                .iter()
                .all(|part| log.channel(&format!("quat_{part}")).is_some_and(|cells| cells[row].is_finite()))
        };
        let zeros: Vec<f64> = (0..log.rows()).map(|row| if known(row) { 0.0 } else { f64::NAN }).collect();
        for (axis, letter) in ["x", "y", "z"].into_iter().enumerate() {
            let of = |kind: &str| format!("{kind}_{letter}");
            add(ResidualChannel::BasePosition(axis), of("pos"), "pos", log.channel(&of("pos")));
            add(ResidualChannel::BaseOrientation(axis), "quat_w".to_owned(), "quat", Some(&zeros));
            add(ResidualChannel::BaseVelocity(axis), of("vel"), "vel", log.channel(&of("vel")));
            add(ResidualChannel::BaseRate(axis), of("gyro"), "gyro", log.channel(&of("gyro")));
        }
    }
    channels
}
