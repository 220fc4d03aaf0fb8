//! Logs in which base channels are recorded late, because motion capture or IMU have clocks of their own.

use std::ops::Range;

use glam::DQuat;

use super::channel::ResidualChannel;
use super::{BLOCK_S, Experiment};

/// Half of the time over which the change of a base channel is measured [s].
const SLOPE_S: f64 = 0.01;

/// Source of base channels that has a clock of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// Position and velocity of the base.
    MotionCapture,
    /// Orientation and angular velocity of the base.
    Imu,
}

impl Clock {
    /// Both clocks.
    pub const ALL: [Self; 2] = [Self::MotionCapture, Self::Imu];

    fn times(self, quantity: ResidualChannel) -> bool {
        match quantity {
            ResidualChannel::BasePosition(_) | ResidualChannel::BaseVelocity(_) => self == Self::MotionCapture,
            ResidualChannel::BaseRate(_) => self == Self::Imu,
            _ => false,
        }
    }
}

impl Experiment {
    /// Returns the experiment with the base channels of `clock` recorded `delay_s` later, to first order.
    ///
    /// Missing cells stay missing, and the initial states as they are.
    #[must_use]
    pub fn with_late_base(&self, clock: Clock, delay_s: f64) -> Self {
        let mut late = self.clone();
        let rate_hz = self.rows_per_block as f64 / BLOCK_S;
        let stride = ((SLOPE_S * rate_hz).round() as usize).max(1);
        // Rows around `row` in its window, and `delay_s` as a share of the time between them.
        let around = |rows: &Range<usize>, row: usize| {
            let [before, after] = [row.saturating_sub(stride).max(rows.start), (row + stride).min(rows.end - 1)];
            (before, after, delay_s * rate_hz / (after - before) as f64)
        };
        let windows = || self.windows.iter().filter(|window| !window.base.is_fixed() && window.rows.len() > 1);
        for (channel, own) in late.channels.iter_mut().zip(&self.channels).filter(|(_, own)| clock.times(own.quantity))
        {
            for rows in windows().map(|window| &window.rows) {
                for row in rows.clone() {
                    let (before, after, share) = around(rows, row);
                    let change = share * (own.measured[after] - own.measured[before]);
                    if change.is_finite() {
                        channel.measured[row] = own.measured[row] - change;
                    }
                }
            }
        }
        if clock == Clock::Imu {
            for rows in windows().map(|window| &window.rows) {
                for row in rows.clone() {
                    let (before, after, share) = around(rows, row);
                    let change = self.orientations[before].inverse() * self.orientations[after];
                    let back = DQuat::from_scaled_axis(-share * change.to_scaled_axis());
                    late.orientations[row] = self.orientations[row] * back;
                }
            }
        }
        late
    }
}

#[cfg(test)]
mod tests {
    use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
    use twinstep_model::{BaseMount, Joint, go2};

    use super::*;
    use crate::window::WindowConfig;

    /// Speed of the base [m/s], its yaw rate [rad/s], and the delay [s].
    const SPEED: f64 = 0.4;
    const YAW_RATE: f64 = 0.5;
    const DELAY_S: f64 = 0.003;
    const MISSING: usize = 50;

    /// Returns an experiment of 1 s whose base moves forward and turns, with one missing position.
    fn experiment() -> Experiment {
        let column = |name: &str, of: &dyn Fn(f64) -> f64| {
            (name.to_owned(), (0..200).map(|row| of(f64::from(row) / 200.0)).collect::<Vec<f64>>())
        };
        let mut columns = vec![column("t", &|t| t), column("kp", &|_| 30.0), column("kd", &|_| 0.8)];
        for joint in Joint::ALL {
            columns.push(column(&format!("q_{joint}"), &|_| 0.0));
            columns.push(column(&format!("q_cmd_{joint}"), &|_| 0.0));
        }
        let is_missing = |t: f64| (t * 200.0).round() as usize == MISSING;
        columns.push(column("pos_x", &|t| if is_missing(t) { f64::NAN } else { SPEED * t }));
        columns.push(column("pos_z", &|_| 0.3));
        columns.push(column("vel_x", &|_| SPEED));
        columns.push(column("quat_w", &|t| (0.5 * YAW_RATE * t).cos()));
        columns.push(column("quat_z", &|t| (0.5 * YAW_RATE * t).sin()));
        columns.extend(["quat_x", "quat_y"].map(|name| column(name, &|_| 0.0)));
        let segments = vec![Segment { name: "part".to_owned(), base: BaseMount::Floating }];
        let log = Log::new(Meta::new(200.0, TorqueSensor::None, segments), columns).expect("a log");
        Experiment::new(&log, &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
    }

    fn position(experiment: &Experiment) -> &[f64] {
        let mut channels = experiment.channels.iter();
        &channels.find(|channel| channel.quantity == ResidualChannel::BasePosition(0)).expect("compared").measured
    }

    #[test]
    fn late_motion_capture_shows_where_the_base_was() {
        let on_time = experiment();
        let late = on_time.with_late_base(Clock::MotionCapture, DELAY_S);
        let rows = || position(&late).iter().zip(position(&on_time)).enumerate().filter(|(row, _)| *row != MISSING);
        // Beside the missing cell the speed is not known.
        let moved = rows().filter(|(_, (late, on_time))| (*on_time - *late - SPEED * DELAY_S).abs() < 1e-9).count();
        assert!(moved >= 195 && position(&late)[MISSING].is_nan(), "{moved}");
        assert_eq!(late.orientations, on_time.orientations);
    }

    #[test]
    fn late_imu_shows_how_the_base_was_turned() {
        let on_time = experiment();
        let late = on_time.with_late_base(Clock::Imu, DELAY_S);
        for (late, on_time) in late.orientations.iter().zip(&on_time.orientations) {
            let turned = (late.inverse() * *on_time).to_scaled_axis();
            assert!((turned.z - YAW_RATE * DELAY_S).abs() < 1e-6 && turned.x.abs() + turned.y.abs() < 1e-6, "{turned}");
        }
        assert_eq!(position(&late)[10], position(&on_time)[10]);
    }
}
