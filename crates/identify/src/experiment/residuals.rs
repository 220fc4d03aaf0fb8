//! Residuals: simulation of the windows, and comparison with the log.

use std::sync::Arc;

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
        let torques = self.torque_errors(candidates);
        let wrenches = self.wrench_errors(candidates, &[0.0; NUM_JOINTS]);
        let (windows, channels) = (self.windows.len(), self.channels.len());
        let of_channel = |place: usize| {
            let (index, channel) = (place / channels, &self.channels[place % channels]);
            let (robot, states) = (&candidates[index], &trajectories[index * windows..(index + 1) * windows]);
            let on_measured = torques.get(index).map_or(&[][..], |errors| &errors[..]);
            let mut residuals = Vec::new();
            for (window, states) in self.windows.iter().zip(states) {
                self.compare(channel, window, states, robot, |row, difference| {
                    let on_measured = match channel.quantity {
                        ResidualChannel::BaseWrench(axis) => {
                            self.stance.sample_of(row).map(|sample| wrenches[index][sample][axis])
                        }
                        _ => channel.torque_joint(window).zip(on_measured.get(row)).map(|(joint, all)| all[joint]),
                    };
                    let error = on_measured.filter(|error| error.is_finite()).unwrap_or(difference);
                    residuals.push(error / channel.sigma);
                });
            }
            residuals
        };
        let parts: Vec<Vec<f64>> = (0..candidates.len() * channels).into_par_iter().map(of_channel).collect();
        parts.par_chunks(channels.max(1)).map(<[Vec<f64>]>::concat).collect()
    }

    /// Returns the torque errors of each candidate on measured states, by row; NaN where there are none [N·m].
    ///
    /// Candidates that predict the same torque share them. Empty if the robot does not walk, trot or jump.
    fn torque_errors(&self, candidates: &[RobotModel]) -> Vec<Arc<Vec<[f64; NUM_JOINTS]>>> {
        let Some(torques) = &self.torques else { return Vec::new() };
        let alike: Vec<&[RobotModel]> =
            candidates.chunk_by(|one, other| torques.predict_same_torque(one, other)).collect();
        let of_first: Vec<_> = alike.par_iter().map(|robots| Arc::new(torques.error_table(&robots[0]))).collect();
        alike.iter().zip(of_first).flat_map(|(robots, errors)| vec![errors; robots.len()]).collect()
    }

    /// Returns the errors of the wrench on the base of each candidate, by sample, if `torque_errors` [N·m] are added to the
    /// measured torques.
    fn wrench_errors(&self, candidates: &[RobotModel], torque_errors: &[f64; NUM_JOINTS]) -> Vec<Vec<[f64; 6]>> {
        candidates.par_iter().map(|robot| self.stance.errors(robot, torque_errors)).collect()
    }

    /// Returns the change of the residuals of `robot` if `error` [N·m] is added to the measured torque of a joint of a
    /// standing robot.
    pub fn change_with_torque_error(&self, robot: &RobotModel, joint: usize, error: f64) -> Vec<f64> {
        let errors = |size: f64| {
            let torques = std::array::from_fn(|other| if other == joint { size } else { 0.0 });
            self.wrench_errors(std::slice::from_ref(robot), &torques).remove(0)
        };
        let [before, after] = [0.0, error].map(errors);
        let change = |(quantity, row): (ResidualChannel, usize)| match (quantity, self.stance.sample_of(row)) {
            (ResidualChannel::BaseWrench(axis), Some(sample)) => {
                (after[sample][axis] - before[sample][axis]) / self.sigma(quantity)
            }
            _ => 0.0,
        };
        self.residual_index().map(change).collect()
    }

    /// Returns rows and position errors of each joint, simulated minus measured [rad].
    pub fn position_errors(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> [Vec<(usize, f64)>; NUM_JOINTS] {
        let robot = &self.at_rate(std::slice::from_ref(robot))[0];
        let windows = self.simulate(simulator, std::slice::from_ref(robot), Precision::Double);
        let mut errors = [const { Vec::new() }; NUM_JOINTS];
        for channel in &self.channels {
            let ResidualChannel::Position(joint) = channel.quantity else { continue };
            for (window, states) in self.windows.iter().zip(&windows) {
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
                // Computed from measured states instead.
                ResidualChannel::BaseWrench(_) => 0.0,
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

#[cfg(test)]
mod tests {
    use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
    use twinstep_model::{BaseMount, Joint, go2};

    use super::*;
    use crate::window::WindowConfig;

    /// A simulator that cannot follow the robot: its joints do not move.
    struct Standstill;

    impl Rollout for Standstill {
        fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
            jobs.iter().map(|job| RobotStates::new(job.commands.len() + 1)).collect()
        }
    }

    /// Returns the largest torque residual [noise std] of a swinging robot whose motors are ideal.
    fn largest_torque_residual(base: BaseMount, hz: f64) -> f64 {
        let [kp, kd, lead] = [30.0, 0.8, 0.1];
        let phase = |row: usize| std::f64::consts::TAU * hz * row as f64 / 200.0;
        let (q, dq) = (|row| 0.2 * f64::sin(phase(row)), |row| 0.2 * std::f64::consts::TAU * hz * f64::cos(phase(row)));
        let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..400).map(of).collect::<Vec<f64>>());
        let mut columns = vec![
            column("t", &|row| row as f64 / 200.0),
            column("kp", &|_| kp),
            column("kd", &|_| kd),
            column("pos_z", &|_| 0.3),
            column("quat_w", &|_| 1.0),
            column("vel_x", &|_| 0.0),
        ];
        for joint in Joint::ALL {
            columns.push(column(&format!("q_{joint}"), &q));
            columns.push(column(&format!("dq_{joint}"), &dq));
            columns.push(column(&format!("q_cmd_{joint}"), &|row| q(row) + lead));
            columns.push(column(&format!("tau_measured_{joint}"), &|row| kp * lead - kd * dq(row)));
        }
        let segments = vec![Segment { name: "all".to_owned(), base }];
        let log = Log::new(Meta::new(200.0, TorqueSensor::MotorCurrent, segments), columns).expect("a log");
        let experiment = Experiment::new(&log, &go2(), WindowConfig::DIAGNOSIS).expect("an experiment");
        let residuals = experiment.residuals(&mut Standstill, &[go2()], Precision::Double).remove(0);
        let torques = experiment.residual_index().zip(residuals);
        let torques = torques.filter(|((channel, _), _)| matches!(channel, ResidualChannel::Torque(_)));
        torques.map(|(_, residual)| residual.abs()).fold(0.0, f64::max)
    }

    #[test]
    fn torques_of_a_walking_robot_do_not_depend_on_what_the_simulator_can_follow() {
        let walks = largest_torque_residual(BaseMount::Floating, 2.0);
        assert!(walks < 1.0, "{walks} of the noise of the sensor");
        assert!(largest_torque_residual(BaseMount::Floating, 0.4) > 10.0, "sways: compared in closed loop");
        assert!(largest_torque_residual(BaseMount::Fixed, 2.0) > 10.0, "hangs: compared in closed loop");
    }
}
