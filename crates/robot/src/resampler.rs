//! Samples of the control loop, which come every 2 ms, at the actuator rate of the simulation.

use std::time::Duration;

use twinstep_model::{PerJoint, RobotSample};

use crate::robot_handle::TimedSample;

/// Time between two samples above which those before it are dropped.
const MAX_GAP: Duration = Duration::from_millis(20);

/// Interpolates samples of the control loop at the beginnings of actuator periods.
pub struct Resampler {
    /// Actuator period.
    period: Duration,
    /// Position gain of the policy's commands [N·m/rad]. Samples with another one are dropped.
    kp: f32,
    /// Beginning of the next actuator period.
    next: Option<Duration>,
    /// Samples from the last one before `next` on.
    kept: Vec<TimedSample>,
}

impl Resampler {
    /// Creates a resampler without samples.
    pub fn new(period: Duration, kp: f32) -> Self {
        Self { period, kp, next: None, kept: Vec::new() }
    }

    /// Drops the samples so far.
    pub fn restart(&mut self) {
        (self.next, self.kept) = (None, Vec::new());
    }

    /// Adds samples of the control loop and returns those of the actuator periods that are complete.
    pub fn add(&mut self, samples: Vec<TimedSample>) -> Vec<RobotSample> {
        let mut complete = Vec::new();
        for sample in samples {
            let is_gap = self.kept.last().is_some_and(|last| sample.at.saturating_sub(last.at) > MAX_GAP);
            if is_gap || sample.kp != self.kp {
                self.restart();
            }
            if sample.kp != self.kp {
                continue;
            }
            let start = *self.next.get_or_insert(sample.at);
            self.kept.push(sample);
            if self.kept[self.kept.len() - 1].at >= start + self.period {
                complete.push(self.sample(start));
                let next = start + self.period;
                let before = self.kept.iter().rposition(|sample| sample.at <= next).unwrap_or(0);
                self.kept.drain(..before);
                self.next = Some(next);
            }
        }
        complete
    }

    /// Returns the sample of the period that begins at `start`.
    ///
    /// A message of the robot has the torque before it, so the torque is the mean of the messages after `start`.
    fn sample(&self, start: Duration) -> RobotSample {
        let after = self.kept.iter().position(|sample| sample.at > start).unwrap_or(self.kept.len() - 1);
        let (one, other) = (&self.kept[after.saturating_sub(1)], &self.kept[after]);
        let span = other.at.saturating_sub(one.at).as_secs_f32();
        let share = if span > 0.0 { start.saturating_sub(one.at).as_secs_f32() / span } else { 0.0 };
        let between = |from: f32, to: f32| from + share * (to - from);
        let joints = |from: &PerJoint, to: &PerJoint| std::array::from_fn(|joint| between(from[joint], to[joint]));
        let within = &self.kept[after..];
        let tau = std::array::from_fn(|joint| {
            within.iter().map(|sample| sample.reading.tau[joint]).sum::<f32>() / within.len() as f32
        });
        RobotSample {
            q: joints(&one.reading.q, &other.reading.q),
            dq: joints(&one.reading.dq, &other.reading.dq),
            q_cmd: one.q_cmd,
            tau,
            // Rotations 2 ms apart differ by less than the noise of an IMU.
            orientation: one.reading.orientation,
            gyro: std::array::from_fn(|axis| between(one.reading.gyro[axis], other.reading.gyro[axis])),
            base: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reading::Reading;

    /// Returns the sample of a joint that turns at 3 rad/s, whose torque is 100 N·m/s times the time.
    fn sample(ms: u64) -> TimedSample {
        let time = ms as f32 / 1000.0;
        let reading = Reading {
            tick: ms as u32,
            q: [3.0 * time; 12],
            dq: [3.0; 12],
            tau: [100.0 * time; 12],
            temperature: [30; 12],
            orientation: [1.0, 0.0, 0.0, 0.0],
            gyro: [0.0; 3],
            acc: [0.0, 0.0, 9.81],
            tilt: 0.0,
            voltage: 29.0,
            charge: 90,
            lost_messages: 0,
            remote: None,
        };
        TimedSample { at: Duration::from_millis(ms), reading, q_cmd: [time; 12], kp: 30.0 }
    }

    #[test]
    fn positions_are_interpolated_and_torques_are_means_of_the_period() {
        let mut resampler = Resampler::new(Duration::from_millis(5), 30.0);
        let found: Vec<RobotSample> = (0..=10).flat_map(|index| resampler.add(vec![sample(2 * index)])).collect();
        assert_eq!(found.len(), 4, "20 ms");
        for (index, found) in found.iter().enumerate() {
            let start = 0.005 * index as f32;
            assert!((found.q[4] - 3.0 * start).abs() < 1e-6, "{index}: {}", found.q[4]);
        }
        // The messages within 5 to 10 ms are those of 6, 8 and 10 ms; the command at 5 ms is that of 4 ms.
        assert!((found[1].tau[0] - 0.8).abs() < 1e-5, "{}", found[1].tau[0]);
        assert_eq!(found[1].q_cmd[0], 0.004);
    }

    #[test]
    fn periods_with_other_gains_or_a_gap_are_dropped() {
        let mut resampler = Resampler::new(Duration::from_millis(5), 30.0);
        let stiff = |ms| TimedSample { kp: 60.0, ..sample(ms) };
        let samples = vec![sample(0), sample(2), stiff(4), stiff(6), sample(8), sample(10), sample(12), sample(14)];
        assert_eq!(resampler.add(samples).len(), 1, "from 8 ms on");
        assert_eq!(resampler.add(vec![sample(60), sample(62), sample(64), sample(66)]).len(), 1, "from 60 ms on");
    }
}
