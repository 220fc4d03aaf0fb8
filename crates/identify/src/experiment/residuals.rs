//! Residuals: simulation of the windows, and comparison with the log.

use glam::DQuat;
use rayon::prelude::*;
use twinstep_logs::replay::delayed_mean;
use twinstep_model::{NUM_JOINTS, PerJoint, Precision, RobotModel, RobotStates, Rollout, RolloutRequest};

use super::Experiment;
use super::channel::{Channel, ResidualChannel};
use crate::window::Window;

/// Pose of a simulated robot at a row of a log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimulatedPose {
    /// The row.
    pub row: usize,
    /// Position of the base in the world frame [m].
    pub position: [f32; 3],
    /// Rotation world-from-base, w, x, y, z.
    pub orientation: [f32; 4],
    /// Joint positions [rad].
    pub q: PerJoint,
}

impl Experiment {
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

    /// Returns the simulated pose at every row of the windows, each of which starts from its first measured state.
    pub fn simulated_poses(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> Vec<SimulatedPose> {
        let robot = &self.at_rate(std::slice::from_ref(robot))[0];
        let windows = self.simulate(simulator, std::slice::from_ref(robot), Precision::Double);
        let pose = |states: &RobotStates, row: usize, period: usize| SimulatedPose {
            row,
            position: states.truth.base_position[period],
            orientation: states.measured.orientation[period],
            q: states.measured.q[period],
        };
        let of_window = |(window, states): (&Window, &RobotStates)| {
            let rows = window.rows.clone().zip(&window.period);
            rows.map(|(row, period)| pose(states, row, *period)).collect::<Vec<_>>()
        };
        self.windows.iter().zip(&windows).flat_map(of_window).collect()
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
