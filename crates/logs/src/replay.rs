//! Replay of a log: commands and readings of each row, in actuator periods.
//!
//! Every simulation or evaluation of a log goes through this module, so that all of them agree on
//! - the actuator rate: [`at_log_rate`] gives a robot the rate at which a log is replayed;
//! - time: [`ActuatorClock`] counts actuator periods between rows, so that jitter does not add up and a gap has its
//!   length;
//! - commands: [`joint_commands`] and [`command`], in force from a row to the next;
//! - torque readings: [`delayed_mean`], the mean from a row to the next, measured with the sensor's delay.

use std::ops::Range;

use twinstep_model::{BackendError, Command, JOINT_NAMES, Joint, RobotModel};

use crate::Log;

/// Lowest rate of a log that can be replayed [Hz].
const MIN_RATE_HZ: f64 = 20.0;
/// Highest rate of a log that can be replayed [Hz].
const MAX_RATE_HZ: f64 = 2000.0;
/// Allowed relative difference of a log's period from a whole number of actuator periods.
const PERIOD_TOLERANCE: f64 = 0.02;

/// Reason why the commands of a log cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The robot model has no joint of this name.
    #[error(
        "the robot has no joint `{joint}` of the log\n  its joints are {names}",
        names = JOINT_NAMES.join(", ")
    )]
    UnknownJoint {
        /// Name of the joint.
        joint: String,
    },
    /// The log lacks a required column.
    #[error("joint `{joint}` of the log has no `{quantity}`")]
    Missing {
        /// Name of the joint.
        joint: String,
        /// The missing quantity.
        quantity: &'static str,
    },
    /// A gain of a measured log is unknown.
    #[error(
        "joint `{joint}` of the log has no `{gain}`\n  add a column `{gain}` or `{gain}_{joint}`, or `\"{gain}\"` to the meta file; \
         `twinstep identify` estimates unknown gains"
    )]
    UnknownGain {
        /// Name of the joint.
        joint: String,
        /// `kp` or `kd`.
        gain: &'static str,
    },
    /// The log has no two consecutive rows.
    #[error("the log has no two consecutive rows in a segment, so there is nothing to simulate")]
    NoSteps,
    /// The log's rate is outside the possible range.
    #[error(
        "the log's median sample period is {period_ms:.3} ms; {} to {} ms are possible (20 to 2000 Hz)\n  resample the log",
        1e3 / MAX_RATE_HZ, 1e3 / MIN_RATE_HZ
    )]
    Rate {
        /// Median time between two rows [ms].
        period_ms: f64,
    },
    /// The actuator rate is not a multiple of the log's rate.
    #[error(
        "the log's median sample period is {period_ms:.3} ms, not a multiple of the actuator period of \
         {actuator_ms:.3} ms within 2 %\n  the actuator's rate is fixed: resample the log"
    )]
    Period {
        /// Median time between two rows [ms].
        period_ms: f64,
        /// Actuator period [ms].
        actuator_ms: f64,
    },
}

/// Failed simulation, with its location in the log.
#[derive(Debug, thiserror::Error)]
#[error("segment `{segment}`, row {row} (t = {t} s): {cause}")]
pub struct SimulationFailure {
    /// Name of the segment.
    pub segment: String,
    /// Data row from which the simulation was stepped, from 1.
    pub row: usize,
    /// Time of the row [s].
    pub t: f64,
    /// Error of the backend.
    pub cause: BackendError,
}

/// Commands of one joint, with one entry per row.
pub struct JointCommands<'a> {
    /// The joint.
    pub joint: Joint,
    /// Commanded position [rad].
    pub q_cmd: &'a [f64],
    /// Commanded velocity [rad/s].
    pub dq_cmd: Option<&'a [f64]>,
    /// Feed-forward torque [N·m].
    pub tau_ff: Option<&'a [f64]>,
    /// Position gain [N·m/rad]; `None` for that of the model.
    pub kp: Option<Vec<f64>>,
    /// Velocity gain [N·m·s/rad]; `None` for that of the model.
    pub kd: Option<Vec<f64>>,
}

impl<'a> JointCommands<'a> {
    fn of(log: &'a Log, name: &str) -> Result<Self, ReplayError> {
        let [kp, kd] = log.gains(name);
        let missing = || ReplayError::Missing { joint: name.to_owned(), quantity: "q_cmd" };
        Ok(Self {
            joint: name.parse().map_err(|_| ReplayError::UnknownJoint { joint: name.to_owned() })?,
            q_cmd: log.q_cmd(name).ok_or_else(missing)?,
            dq_cmd: log.dq_cmd(name),
            tau_ff: log.tau_ff(name),
            kp,
            kd,
        })
    }
}

/// Checks that the gains of all joints are known.
pub fn check_gains(log: &Log) -> Result<(), ReplayError> {
    let unknown = |joint: &String| {
        let [kp, kd] = [log.kp(joint, 0), log.kd(joint, 0)];
        [(kp, "kp"), (kd, "kd")].into_iter().find(|(gain, _)| gain.is_none()).map(|(_, gain)| (joint.clone(), gain))
    };
    match log.joints().iter().find_map(unknown) {
        Some((joint, gain)) => Err(ReplayError::UnknownGain { joint, gain }),
        None => Ok(()),
    }
}

/// Returns the commands of the log's joints, in the order of [`Joint::ALL`].
pub fn joint_commands(log: &Log) -> Result<Vec<JointCommands<'_>>, ReplayError> {
    let mut joints: Vec<_> = log.joints().iter().map(|name| JointCommands::of(log, name)).collect::<Result<_, _>>()?;
    joints.sort_by_key(|joint| joint.joint);
    Ok(joints)
}

/// Returns the command in force from a row to the next.
///
/// Joints that the log lacks hold the default pose. Missing velocities and feed-forward torques are zero.
pub fn command(robot: &RobotModel, joints: &[JointCommands], row: usize) -> Command {
    let control = &robot.control;
    let mut command = control.hold(control.default_pose_f32());
    for joint in joints {
        let index = joint.joint.index();
        command.q[index] = joint.q_cmd[row] as f32;
        command.dq[index] = cell_or_zero(joint.dq_cmd, row);
        command.tau_ff[index] = cell_or_zero(joint.tau_ff, row);
        for (gain, given) in [(&mut command.kp[index], &joint.kp), (&mut command.kd[index], &joint.kd)] {
            if let Some(given) = given {
                *gain = given[row] as f32;
            }
        }
    }
    command
}

/// Returns a cell of a column, or zero if the column or the cell is missing.
pub fn cell_or_zero(column: Option<&[f64]>, row: usize) -> f32 {
    column.map(|cells| cells[row]).filter(|cell| cell.is_finite()).unwrap_or(0.0) as f32
}

/// Returns the median time between two rows of a log [s].
fn median_period(log: &Log) -> Result<f64, ReplayError> {
    let mut steps: Vec<f64> =
        log.segments().flat_map(|(_, rows)| log.t()[rows].windows(2).map(|pair| pair[1] - pair[0])).collect();
    steps.sort_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied().ok_or(ReplayError::NoSteps)
}

/// Returns `robot` with the actuator rate at which `log` is replayed.
///
/// A log that is at least as fast as the robot's actuators is replayed at its own rate: its rows are the samples of the
/// PD loop. A slower log is replayed at the smallest multiple of its rate that reaches the actuator rate of `robot`.
pub fn at_log_rate(log: &Log, robot: &RobotModel) -> Result<RobotModel, ReplayError> {
    let (period, stated) = (median_period(log)?, log.meta().rate_hz);
    // The stated rate has no jitter; the measured one is used if they differ.
    let agree = (period * stated - 1.0).abs() <= PERIOD_TOLERANCE;
    let rate = if agree { stated } else { 1.0 / period };
    if !(MIN_RATE_HZ * (1.0 - PERIOD_TOLERANCE)..=MAX_RATE_HZ * (1.0 + PERIOD_TOLERANCE)).contains(&rate) {
        return Err(ReplayError::Rate { period_ms: 1e3 * period });
    }
    let multiple = (robot.control.actuator_hz / rate * (1.0 - PERIOD_TOLERANCE)).ceil().max(1.0);
    let mut robot = robot.clone();
    // A whole number, so that the physics can run at a multiple of it.
    robot.control.actuator_hz = (rate * multiple).round();
    Ok(robot)
}

/// Returns the mean of a signal over `samples`, as a sensor with a delay of `delay` samples measures it.
///
/// Values between samples are interpolated linearly. Before sample 0 the signal has the value of sample 0.
pub fn delayed_mean(signal: impl Fn(usize) -> f64, samples: Range<usize>, delay: f64) -> f64 {
    let (last, count) = (samples.end - 1, samples.len());
    if delay == 0.0 {
        return samples.map(signal).sum::<f64>() / count as f64;
    }
    let at = |sample: usize| {
        let position = (sample as f64 - delay).max(0.0);
        let (before, fraction) = (position as usize, position.fract());
        signal(before) * (1.0 - fraction) + signal((before + 1).min(last)) * fraction
    };
    samples.map(at).sum::<f64>() / count as f64
}

/// Conversion of a log's time to actuator periods.
pub struct ActuatorClock {
    /// Actuator period, measured by the clock of the log [s].
    period: f64,
}

impl ActuatorClock {
    /// Creates the clock of `log` for the actuators of `robot`.
    pub fn of(log: &Log, robot: &RobotModel) -> Result<Self, ReplayError> {
        let median = median_period(log)?;
        let actuator_dt = robot.control.actuator_dt();
        let periods = (median / actuator_dt).round();
        if periods < 1.0 || (median / (periods * actuator_dt) - 1.0).abs() > PERIOD_TOLERANCE {
            return Err(ReplayError::Period { period_ms: median * 1e3, actuator_ms: actuator_dt * 1e3 });
        }
        Ok(Self { period: median / periods })
    }

    /// Returns the number of actuator periods from `row` to the next, in a contiguous range that starts at `t[0]`.
    ///
    /// Both ends are rounded relative to the start, so that jitter does not accumulate and gaps keep their length.
    pub fn periods_between(&self, t: &[f64], row: usize) -> usize {
        let periods_to = |row: usize| ((t[row] - t[0]) / self.period).round() as usize;
        periods_to(row + 1) - periods_to(row)
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{BaseMount, go2};

    use super::*;
    use crate::{Meta, Segment, TorqueSensor};

    fn log(rate_hz: f64, period: f64) -> Log {
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let columns = [("t", period), ("q_FL_hip", 0.0), ("q_cmd_FL_hip", 0.0), ("kp", 0.0), ("kd", 0.0)];
        let cells = |step: f64| (0..20).map(|row| step * f64::from(row)).collect();
        let columns = columns.map(|(name, step)| (name.to_owned(), cells(step)));
        Log::new(Meta::new(rate_hz, TorqueSensor::None, segments), columns).expect("a log")
    }

    fn actuator_hz(rate_hz: f64, period: f64) -> Result<f64, ReplayError> {
        at_log_rate(&log(rate_hz, period), &go2()).map(|robot| robot.control.actuator_hz)
    }

    #[test]
    fn fast_log_sets_the_actuator_rate_and_slow_log_divides_it() {
        for (rate, expected) in
            [(1000.0, 1000.0), (500.0, 500.0), (200.0, 200.0), (100.0, 200.0), (50.0, 200.0), (60.0, 240.0)]
        {
            assert_eq!(actuator_hz(rate, 1.0 / rate).expect("a rate"), expected, "{rate} Hz");
        }
        assert_eq!(actuator_hz(200.0, 0.005 * 1.015).expect("a rate"), 200.0, "a clock within 2 %");
        assert_eq!(actuator_hz(200.0, 0.002).expect("a rate"), 500.0, "the stated rate is wrong");
    }

    #[test]
    fn clock_of_a_log_at_its_rate_counts_whole_periods() {
        for rate in [50.0, 60.0, 100.0, 200.0, 333.0, 500.0, 1000.0] {
            let log = log(rate, 1.0 / rate);
            let robot = at_log_rate(&log, &go2()).expect("a rate");
            let periods = ActuatorClock::of(&log, &robot).expect("a clock").periods_between(log.t(), 3);
            assert_eq!(periods as f64, (robot.control.actuator_hz / rate).round(), "{rate} Hz");
        }
    }

    #[test]
    fn rate_outside_the_range_is_rejected_with_the_range() {
        let error = actuator_hz(10.0, 0.1).expect_err("rejected").to_string();
        assert!(error.contains("100.000 ms; 0.5 to 50 ms are possible (20 to 2000 Hz)"), "{error}");
        assert!(actuator_hz(5000.0, 0.0002).is_err());
    }

    #[test]
    fn delayed_mean_reads_earlier_samples() {
        let ramp = |sample: usize| sample as f64;
        assert_eq!(delayed_mean(ramp, 8..10, 0.0), 8.5);
        assert_eq!(delayed_mean(ramp, 8..10, 2.25), 6.25);
        assert_eq!(delayed_mean(ramp, 0..2, 5.0), 0.0, "constant before sample 0");
    }
}
