//! Channels of a log that are compared with a simulation, and the standard deviation of their noise.

use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{BaseMount, Joint};

use crate::base_wrench::MeasuredStance;
use crate::window::Window;

/// Standard deviation of the noise of each quantity, for channels whose metadata do not state it.
const ASSUMED_NOISE: [(&str, f64); 7] =
    [("q", 0.002), ("dq", 0.05), ("tau_measured", 0.2), ("pos", 0.005), ("quat", 0.01), ("vel", 0.05), ("gyro", 0.02)];

/// Standard deviation of force and moment on the base: errors of the torque sensors, of leg lengths and of friction [N],
/// [N·m].
const WRENCH_SIGMA: [f64; 2] = [1.0, 0.1];

/// Channel that is compared in every row.
#[derive(Clone, Debug)]
pub struct Channel {
    pub quantity: ResidualChannel,
    /// Standard deviation of the noise, in the channel's unit.
    pub sigma: f64,
    /// Measured values by row; NaN for a missing cell.
    pub measured: Vec<f64>,
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
    /// Force along, or moment about, a base axis that the feet of a standing robot do not exert, on measured states.
    BaseWrench(usize),
}

impl Channel {
    /// Returns the joint whose torque is compared on measured states: of a robot that walks, trots or jumps.
    ///
    /// In closed loop it would have the errors of the contact model. Of a robot that stands, it shows the mass.
    pub fn torque_joint(&self, window: &Window) -> Option<usize> {
        match self.quantity {
            ResidualChannel::Torque(joint) if window.fast => Some(joint),
            _ => None,
        }
    }

    /// Returns the compared rows of `window`, each with its index in the window. Rows of the burn-in are excluded.
    ///
    /// With a fixed base, of the base only the gyroscope is compared, which then reads its bias.
    pub fn rows<'a>(&'a self, window: &'a Window) -> impl Iterator<Item = (usize, usize)> + 'a {
        let of_base = matches!(
            self.quantity,
            ResidualChannel::BasePosition(_)
                | ResidualChannel::BaseOrientation(_)
                | ResidualChannel::BaseVelocity(_)
                | ResidualChannel::BaseWrench(_)
        );
        // A torque is the mean to the next row, so the last row has none.
        let end = window.rows.len() - usize::from(matches!(self.quantity, ResidualChannel::Torque(_)));
        let first = if of_base && window.base.is_fixed() { end } else { window.settling };
        (first..end).map(|index| (index, window.rows.start + index)).filter(|(_, row)| self.measured[*row].is_finite())
    }
}

/// Returns the channels that `log` has.
pub fn channels(log: &Log, joints: &[Joint]) -> Vec<Channel> {
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

/// Returns the channels of the wrench on the base, if `stance` has samples in windows with a floating base.
///
/// The measured value is 0 at the samples in which the robot does not walk: feet that touch down are not in balance.
pub fn wrench_channels(rows: usize, stance: &MeasuredStance, windows: &[Window]) -> Vec<Channel> {
    let mut measured = vec![f64::NAN; rows];
    let quiet =
        |row: &usize| windows.iter().any(|window| !window.fast && !window.base.is_fixed() && window.rows.contains(row));
    stance.rows().filter(quiet).for_each(|row| measured[row] = 0.0);
    if measured.iter().all(|cell| cell.is_nan()) {
        return Vec::new();
    }
    let channel = |axis: usize| Channel {
        quantity: ResidualChannel::BaseWrench(axis),
        sigma: WRENCH_SIGMA[axis / 3],
        measured: measured.clone(),
    };
    (0..6).map(channel).collect()
}
