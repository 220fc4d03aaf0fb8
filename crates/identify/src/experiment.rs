//! A log as an experiment: windows that are simulated from measured states, and what is compared.

use glam::DQuat;
use rayon::prelude::*;
use twinstep_model::{BaseMount, Command, RolloutRequest, Joint, NUM_JOINTS, Precision, RobotModel, RobotStates, Rollout};
use twinstep_logs::{Log, TorqueSensor};

use crate::operating_conditions::OperatingConditions;
use crate::motion::{MotionError, joint_commands};
use crate::window::{WindowConfig, Window, orientation, windows};

/// Rows this long apart [s] count as independent.
const BLOCK_S: f64 = 0.5;
/// Noise that is assumed of a channel whose noise nobody stated: of a quantity, its σ.
const ASSUMED_NOISE: [(&str, f64); 7] =
    [("q", 0.002), ("dq", 0.05), ("tau_measured", 0.2), ("pos", 0.005), ("quat", 0.01), ("vel", 0.05), ("gyro", 0.02)];

/// Why a log is no experiment.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// Its commands cannot be given to the robot.
    #[error(transparent)]
    Motion(#[from] MotionError),
    /// A floating base's motion was not measured.
    #[error("segment `{segment}` has base \"floating\", but the log has no `{missing}`: a window cannot start there")]
    MissingBaseState {
        /// The segment's name.
        segment: String,
        /// The channels that are missing.
        missing: &'static str,
    },
}

/// What is compared in every row.
#[derive(Clone, Debug)]
struct Channel {
    quantity: ResidualChannel,
    /// Standard deviation of its noise, in its unit.
    sigma: f64,
    /// Measured, by row; a missing cell is NaN.
    measured: Vec<f64>,
}

/// What is compared, with the joint or axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResidualChannel {
    /// Of a joint.
    Position(usize),
    /// Of a joint.
    Velocity(usize),
    /// Of a joint, at the current's sensor.
    Torque(usize),
    /// Along a world axis.
    BasePosition(usize),
    /// A component of the rotation vector from the measured to the simulated orientation.
    BaseOrientation(usize),
    /// Along a world axis.
    BaseVelocity(usize),
    /// About an axis of the trunk.
    BaseRate(usize),
}

impl Channel {
    /// Rows of `window` that are compared, with their index in it: not the first at least, which was given.
    fn rows<'a>(&'a self, window: &'a Window) -> impl Iterator<Item = (usize, usize)> + 'a {
        let of_trunk = matches!(
            self.quantity,
            ResidualChannel::BasePosition(_)
                | ResidualChannel::BaseOrientation(_)
                | ResidualChannel::BaseVelocity(_)
                | ResidualChannel::BaseRate(_)
        );
        // A torque is the mean to the next row, and the last has none.
        let end = window.rows.len() - usize::from(matches!(self.quantity, ResidualChannel::Torque(_)));
        let first = if of_trunk && window.held { end } else { window.settling };
        (first..end).map(|index| (index, window.rows.start + index)).filter(|(_, row)| self.measured[*row].is_finite())
    }
}

/// A log cut into windows.
#[derive(Clone, Debug)]
pub struct Experiment {
    windows: Vec<Window>,
    channels: Vec<Channel>,
    /// Measured orientations, by row, where the base was floating.
    orientations: Vec<DQuat>,
    /// The log's own joints.
    joints: Vec<Joint>,
    /// Rows in half a second.
    rows_per_block: usize,
    conditions: OperatingConditions,
}

impl Experiment {
    /// `log` as an experiment on robots with the gains and rates of `robot`.
    pub fn new(log: &Log, robot: &RobotModel, horizon: WindowConfig) -> Result<Self, ExperimentError> {
        let joints: Vec<_> = joint_commands(log)?.iter().map(|joint| joint.joint).collect();
        let windows = windows(log, robot, horizon)?;
        let floating = windows.iter().any(|window| !window.held);
        let orientations =
            if floating { (0..log.rows()).map(|row| orientation(log, row)).collect() } else { Vec::new() };
        Ok(Self {
            windows,
            channels: channels(log, &joints),
            orientations,
            joints,
            rows_per_block: ((BLOCK_S * log.meta().rate_hz).round() as usize).max(1),
            conditions: OperatingConditions::of(log),
        })
    }

    /// The joints that the log has.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// The experiment with the rows `keep` says yes to alone.
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
            // What is not compared is not simulated: a window ends with its last row that counts.
            let last = window.rows.clone().rev().find(|row| keep(*row)).unwrap_or(window.rows.start);
            let count = last + 1 - window.rows.start;
            window.rows.end = last + 1;
            window.period.truncate(count);
            window.commands.truncate(window.period[count - 1] + 1);
        }
        self.windows.retain(|window| window.rows.len() > 1);
        self
    }

    /// Differences of simulated and measured for each candidate, in units of their noise; one entry a cell that was
    /// measured, in the same order for every candidate. Not finite from where a candidate diverges.
    pub fn residuals(
        &self,
        simulator: &mut dyn Rollout,
        candidates: &[RobotModel],
        precision: Precision,
    ) -> Vec<Vec<f64>> {
        let trajectories = self.play(simulator, candidates, precision);
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

    /// The experiment with the parts whose base was fixed alone, if there are any.
    #[must_use]
    pub fn prefer_fixed_base(mut self) -> Self {
        if self.windows.iter().any(|window| window.held) {
            self.windows.retain(|window| window.held);
        }
        self
    }

    /// Whether there are parts whose base was floating.
    pub fn has_floating_base(&self) -> bool {
        self.windows.iter().any(|window| !window.held)
    }

    /// For every residual, its quantity and row.
    pub fn residual_index(&self) -> impl Iterator<Item = (ResidualChannel, usize)> {
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        windows.flat_map(|(channel, window)| channel.rows(window).map(move |(_, row)| (channel.quantity, row)))
    }

    /// Numbers of a floating base's start: position, orientation, velocity, rate.
    pub const INITIAL_STATE_DIM: usize = 12;

    /// The experiment with one number of every start off by `size` deviations of what smoothing leaves of its noise.
    pub fn with_perturbed_start(&self, number: usize, size: f64) -> Self {
        let (of_axis, axis) = (number / 3, number % 3);
        let quantity =
            [ResidualChannel::BasePosition, ResidualChannel::BaseOrientation, ResidualChannel::BaseVelocity, ResidualChannel::BaseRate][of_axis];
        // A parabola through the cells within 20 ms leaves 9 / 4n of their variance at its middle.
        let cells = 1.0 + 0.04 * self.rows_per_block as f64 / BLOCK_S;
        let error = size * (2.25 / cells).sqrt().min(1.0) * self.sigma(quantity(axis));
        let mut off = self.clone();
        for window in off.windows.iter_mut().filter(|window| !window.held) {
            window.perturb_start(of_axis, axis, error);
        }
        off
    }

    /// For every window whose base was floating, its residuals.
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
        pairs.filter(|(window, own)| !window.held && !own.is_empty()).map(|(_, own)| own).collect()
    }

    /// Noise of a quantity, in its unit; 1 if it is not compared.
    pub fn sigma(&self, quantity: ResidualChannel) -> f64 {
        self.channels.iter().find(|channel| channel.quantity == quantity).map_or(1.0, |channel| channel.sigma)
    }

    /// As many groups as [`EffectDemo::groups`] has at most.
    pub const GROUPS: usize = 14;

    /// Whether a group is of a fixed base.
    pub fn is_held(group: usize) -> bool {
        group % 2 == 1
    }

    /// For every residual, a number for its quantity and for whether the base was fixed.
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
            2 * quantity + usize::from(window.held)
        };
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        let same = windows.flat_map(|(channel, window)| channel.rows(window).map(move |_| group(channel, window)));
        same.collect()
    }

    /// For every residual, the block that it belongs to: half a second, or a window with a floating base.
    pub fn blocks(&self) -> Vec<usize> {
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        let block = |window: &Window, row: usize| {
            // What a window with a floating base starts with is carried through all of it.
            (if window.held { row } else { window.rows.start }) / self.rows_per_block
        };
        windows.flat_map(|(channel, window)| channel.rows(window).map(move |(_, row)| block(window, row))).collect()
    }

    /// Simulated less measured position of each joint [rad] with its row, simulated from measured states.
    pub fn position_errors(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> [Vec<(usize, f64)>; NUM_JOINTS] {
        let windows = self.play(simulator, std::slice::from_ref(robot), Precision::Double);
        let mut errors = [const { Vec::new() }; NUM_JOINTS];
        for (channel, window, states) in self.compared(&windows) {
            if let ResidualChannel::Position(joint) = channel.quantity {
                self.compare(channel, window, states, robot, |row, difference| errors[joint].push((row, difference)));
            }
        }
        errors
    }

    fn play(&self, simulator: &mut dyn Rollout, candidates: &[RobotModel], precision: Precision) -> Vec<RobotStates> {
        let weakened: Vec<_> = candidates.iter().map(|robot| self.derated_commands(robot)).collect();
        let mut jobs = Vec::new();
        for (robot, weakened) in candidates.iter().zip(&weakened) {
            for (index, window) in self.windows.iter().enumerate() {
                // Where the gyroscope is off, so is the measured start.
                let mut start = window.start;
                for (rate, bias) in start.base_angular_velocity.iter_mut().zip(robot.gyro_bias.to_array()) {
                    *rate -= bias as f32;
                }
                let commands = weakened.get(index).unwrap_or(&window.commands);
                jobs.push(RolloutRequest { robot, held: window.held, start, history: &window.history, commands });
            }
        }
        simulator.run(&jobs, precision)
    }

    /// The windows' commands to motors as supply and heat leave them; empty where the log tells neither.
    fn derated_commands(&self, robot: &RobotModel) -> Vec<Vec<Command>> {
        if self.conditions.is_empty() {
            return Vec::new();
        }
        let of = |window: &Window| {
            let mut commands = window.commands.clone();
            for (pair, row) in window.period.windows(2).zip(window.rows.clone()) {
                let strength = self.conditions.derating_factors(&robot.derating, row);
                commands[pair[0]..pair[1]].iter_mut().for_each(|command| command.derating_factor = strength);
            }
            commands
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

    /// Hands on the difference in each row that is compared.
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
                ResidualChannel::Position(joint) => f64::from(states.q[period][joint]),
                ResidualChannel::Velocity(joint) => f64::from(states.dq[period][joint]),
                ResidualChannel::Torque(joint) => {
                    let until = window.period.get(index + 1).copied().unwrap_or(period + 1);
                    estimated_torque(states, robot, joint, period, until)
                }
                ResidualChannel::BasePosition(axis) => f64::from(states.base_position[period][axis]),
                ResidualChannel::BaseOrientation(axis) => {
                    let [w, x, y, z] = states.base_orientation[period].map(f64::from);
                    let turn = self.orientations[row].inverse() * DQuat::from_xyzw(x, y, z, w);
                    let turn = if turn.w < 0.0 { -turn } else { turn };
                    turn.to_scaled_axis()[axis]
                }
                ResidualChannel::BaseVelocity(axis) => f64::from(states.base_linear_velocity[period][axis]),
                ResidualChannel::BaseRate(axis) => f64::from(states.base_angular_velocity[period][axis]),
            };
            each(row, simulated - channel.measured[row]);
        }
    }
}

/// Mean torque over actuator periods `from..until`, as a late sensor shows it [N·m].
pub fn estimated_torque(states: &RobotStates, robot: &RobotModel, joint: usize, from: usize, until: usize) -> f64 {
    let late = robot.joints[joint].actuator.sensor_delay / robot.control.actuator_dt();
    // Entry p + 1 holds the torque of period p.
    let at = |period: f64| {
        let entry = (period + 1.0).clamp(1.0, (states.tau.len() - 1) as f64);
        let (whole, part) = (entry.floor() as usize, entry.fract());
        let next = (whole + 1).min(states.tau.len() - 1);
        f64::from(states.tau[whole][joint]) * (1.0 - part) + f64::from(states.tau[next][joint]) * part
    };
    let periods = until.max(from + 1) - from;
    (0..periods).map(|index| at((from + index) as f64 - late)).sum::<f64>() / periods as f64
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
