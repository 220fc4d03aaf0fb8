//! Height and velocity of a floating base that were not measured, estimated from the legs and the IMU.
//!
//! A foot on the ground does not slip, and rolls about its contact point, so that joint positions and velocities,
//! angular velocity and orientation give the velocity of the base; on flat ground they give its height. Each foot is a
//! measurement in a Kalman filter for each world axis, with the accelerometer as input. Feet in the air are left out: by
//! the log's `contact` or `foot_force`, or because they contradict the filter. A Rauch–Tung–Striebel smoother then uses
//! the rows before and after each row.
//!
//! Bloesch et al., *State Estimation for Legged Robots – Consistent Fusion of Leg Kinematics and IMU*, 2012, estimate
//! orientation too; here it is the robot's own.

use glam::{DMat2, DVec2, DVec3};
use twinstep_logs::Log;
use twinstep_model::{Feet, Joint, Leg, NUM_JOINTS, NUM_LEGS, RobotModel};

use crate::orientation::orientation;

/// Gravitational acceleration [m/s²].
const GRAVITY: DVec3 = DVec3::new(0.0, 0.0, -9.81);
/// Standard deviation of the velocity of a foot that stands: slip, and noise of joint velocities [m/s].
const FOOT_VELOCITY_SIGMA: f64 = 0.1;
/// Standard deviation of the height of a foot that stands: deformation, errors of leg lengths [m].
const FOOT_HEIGHT_SIGMA: f64 = 0.005;
/// Time over which the error of a foot persists, because of slip, leg lengths and the shape of the ground [s].
const FOOT_ERROR_S: f64 = 0.05;
/// Standard deviations beyond which a foot contradicts the estimate and is taken to be in the air.
const GATE: f64 = 3.0;
/// Feet higher than this above the lowest one are in the air [m].
const SWING_HEIGHT: f64 = 0.02;
/// Spectral density of the error of measured accelerations, impacts included [m²/s³].
const MEASURED_ACCELERATION_DENSITY: f64 = 0.1;
/// Spectral density of the accelerations of a robot without an accelerometer [m²/s³].
const UNKNOWN_ACCELERATION_DENSITY: f64 = 5.0;

/// Share of a foot's highest force below which it may slip.
const CONTACT_SHARE: f64 = 0.15;

/// Estimated position and velocity of the base in the world frame.
#[derive(Clone, Debug)]
pub struct BaseEstimate {
    /// Position by row [m]; zero in rows with a fixed base. Only the height is observed; x and y start at 0.
    pub position: Vec<DVec3>,
    /// Velocity by row [m/s].
    pub velocity: Vec<DVec3>,
    /// Standard deviation of the height, root mean square over rows [m].
    pub height_sigma: f64,
    /// Standard deviation of the velocity along each axis, root mean square over rows [m/s].
    pub velocity_sigma: f64,
}

/// Height and velocity of the base according to one foot, if it stands.
#[derive(Clone, Copy)]
struct FootMeasurement {
    height: f64,
    velocity: DVec3,
    /// Whether the foot stands, if the log tells.
    stands: Option<bool>,
}

/// Mean and covariance of position and velocity along one axis.
#[derive(Clone, Copy)]
struct AxisState {
    mean: DVec2,
    covariance: DMat2,
}

/// What the sensors of one row say about the motion of the base.
struct RowMeasurement {
    feet: [FootMeasurement; NUM_LEGS],
    /// Acceleration in the world frame, if it was measured [m/s²].
    acceleration: Option<DVec3>,
}

impl BaseEstimate {
    /// Estimates the motion of the base in all rows of `log` with a floating base, of a robot with the legs of `robot`.
    ///
    /// The log needs orientation, angular velocity and the positions of all joints.
    pub fn of(log: &Log, robot: &RobotModel) -> Self {
        let mut this = Self {
            position: vec![DVec3::ZERO; log.rows()],
            velocity: vec![DVec3::ZERO; log.rows()],
            height_sigma: 0.0,
            velocity_sigma: 0.0,
        };
        let measurements = measurements(log, robot);
        let mut count = 0.0;
        for (_, rows) in log.segments().filter(|(segment, _)| !segment.base.is_fixed()) {
            count += rows.len() as f64;
            let (rows_measured, t) = (&measurements[rows.clone()], &log.t()[rows.clone()]);
            for (row, states) in smoothed(t, rows_measured).into_iter().enumerate() {
                let of_axis = |part: usize| DVec3::from_array(states.map(|state| state.mean[part]));
                this.position[rows.start + row] = of_axis(0);
                this.velocity[rows.start + row] = of_axis(1);
                this.height_sigma += states[2].covariance.x_axis.x;
                this.velocity_sigma += states.map(|state| state.covariance.y_axis.y).iter().sum::<f64>() / 3.0;
            }
        }
        let mean_sqrt = |sum: f64| (sum / f64::max(count, 1.0)).sqrt();
        this.height_sigma = mean_sqrt(this.height_sigma);
        this.velocity_sigma = mean_sqrt(this.velocity_sigma);
        this
    }
}

/// Reads what the sensors of each row say.
fn measurements(log: &Log, robot: &RobotModel) -> Vec<RowMeasurement> {
    let kinematics = Feet::from(robot);
    let radius = robot.shapes.foot_radius;
    let vector = |kind: &str| ["x", "y", "z"].map(|axis| log.channel(&format!("{kind}_{axis}")));
    let (gyro, acc) = (vector("gyro"), vector("acc"));
    let joints = Joint::ALL.map(|joint| {
        let q = log.q(joint.name()).unwrap_or_default();
        (q, log.dq(joint.name()).map_or_else(|| derivative(log, q), <[f64]>::to_vec))
    });
    let finite = |cell: f64| if cell.is_finite() { cell } else { 0.0 };
    let contacts = Leg::ALL.map(|leg| log.contacts(&format!("{leg:?}"), CONTACT_SHARE));
    let of_row = |row: usize| {
        let mut q = robot.control.default_pose_f32();
        let mut dq = [0.0; NUM_JOINTS];
        for (joint, (positions, velocities)) in joints.iter().enumerate() {
            if let Some(position) = positions.get(row) {
                q[joint] = *position as f32;
                dq[joint] = finite(velocities[row]) as f32;
            }
        }
        let rotation = orientation(log, row);
        let omega = DVec3::from_array(gyro.map(|cells| cells.map_or(0.0, |cells| finite(cells[row]))));
        let acceleration = (acc.iter().all(|cells| cells.is_some_and(|cells| cells[row].is_finite())))
            .then(|| rotation * DVec3::from_array(acc.map(|cells| cells.map_or(0.0, |cells| cells[row]))) + GRAVITY);
        let feet = kinematics.motions(&q, &dq).collect::<Vec<_>>();
        let feet = std::array::from_fn(|leg| {
            let position = feet[leg].position.as_dvec3();
            let hip = 3 * leg;
            let (sin, cos) = f64::from(q[hip]).sin_cos();
            let pitch_rate = f64::from(dq[hip + 1] + dq[hip + 2]);
            let calf_rate = omega + DVec3::new(f64::from(dq[hip]), cos * pitch_rate, sin * pitch_rate);
            // The lowest point of the foot is at rest, so that its centre moves while the calf turns.
            let centre_velocity = (rotation * calf_rate).cross(DVec3::Z * radius);
            let relative = rotation * (omega.cross(position) + feet[leg].velocity.as_dvec3());
            FootMeasurement {
                height: radius - (rotation * position).z,
                velocity: centre_velocity - relative,
                stands: contacts[leg].as_ref().and_then(|stands| stands[row]),
            }
        });
        let falls = feet.iter().all(|foot: &FootMeasurement| foot.stands == Some(false));
        RowMeasurement { feet, acceleration: acceleration.or(falls.then_some(GRAVITY)) }
    };
    (0..log.rows()).map(of_row).collect()
}

/// Returns central differences of `cells` within contiguous ranges of rows.
fn derivative(log: &Log, cells: &[f64]) -> Vec<f64> {
    let mut derivatives = vec![0.0; cells.len()];
    for (_, rows) in log.segments() {
        for row in rows.clone() {
            let (before, after) = (row.saturating_sub(1).max(rows.start), (row + 1).min(rows.end - 1));
            if after > before {
                derivatives[row] = (cells[after] - cells[before]) / (log.t()[after] - log.t()[before]);
            }
        }
    }
    derivatives
}

/// Returns the smoothed state of the three axes in each row of a contiguous range.
fn smoothed(t: &[f64], rows: &[RowMeasurement]) -> Vec<[AxisState; 3]> {
    let mut filtered: Vec<[AxisState; 3]> = Vec::with_capacity(rows.len());
    let mut predicted: Vec<[AxisState; 3]> = Vec::with_capacity(rows.len());
    let duration = t[t.len() - 1] - t[0];
    let error_rows = (FOOT_ERROR_S * (t.len() - 1) as f64 / duration.max(f64::MIN_POSITIVE)).max(1.0);
    for (row, measured) in rows.iter().enumerate() {
        let before = match filtered.last() {
            Some(states) => {
                let dt = t[row] - t[row - 1];
                std::array::from_fn(|axis| states[axis].advanced(dt, rows[row - 1].acceleration.map(|acc| acc[axis])))
            }
            None => initial(measured),
        };
        predicted.push(before);
        filtered.push(updated(before, measured, error_rows));
    }
    for row in (0..rows.len().saturating_sub(1)).rev() {
        let dt = t[row + 1] - t[row];
        let next = filtered[row + 1];
        for axis in 0..3 {
            filtered[row][axis] = filtered[row][axis].smoothed(dt, &predicted[row + 1][axis], &next[axis]);
        }
    }
    filtered
}

/// Returns the state before the first row: the lowest foot stands, and the velocity is unknown.
fn initial(measured: &RowMeasurement) -> [AxisState; 3] {
    let height = measured.feet.iter().map(|foot| foot.height).fold(f64::MIN, f64::max);
    let covariance = DMat2::from_diagonal(DVec2::new(0.02f64.powi(2), 1.0));
    [0.0, 0.0, height].map(|position| AxisState { mean: DVec2::new(position, 0.0), covariance })
}

/// Returns the state after the measurements of the feet that stand.
///
/// `error_rows` is the number of rows over which the error of a foot persists.
fn updated(mut states: [AxisState; 3], measured: &RowMeasurement, error_rows: f64) -> [AxisState; 3] {
    let [height_sigma, velocity_sigma] =
        [FOOT_HEIGHT_SIGMA, FOOT_VELOCITY_SIGMA].map(|sigma| sigma * error_rows.sqrt());
    let lowest = measured.feet.iter().map(|foot| foot.height).fold(f64::MIN, f64::max);
    let before = states;
    for foot in &measured.feet {
        let agrees = || {
            lowest - foot.height < SWING_HEIGHT
                && before[2].agrees(0, foot.height, FOOT_HEIGHT_SIGMA)
                && (0..3).all(|axis| before[axis].agrees(1, foot.velocity[axis], FOOT_VELOCITY_SIGMA))
        };
        if foot.stands.unwrap_or_else(agrees) {
            states[2] = states[2].measured(0, foot.height, height_sigma);
            for (axis, state) in states.iter_mut().enumerate() {
                *state = state.measured(1, foot.velocity[axis], velocity_sigma);
            }
        }
    }
    states
}

impl AxisState {
    /// Returns the state after `dt` [s] with a measured acceleration [m/s²].
    fn advanced(&self, dt: f64, acceleration: Option<f64>) -> Self {
        let density = if acceleration.is_some() { MEASURED_ACCELERATION_DENSITY } else { UNKNOWN_ACCELERATION_DENSITY };
        let transition = transition(dt);
        let shared = density * dt * dt / 2.0;
        let noise = DMat2::from_cols_array(&[density * dt.powi(3) / 3.0, shared, shared, density * dt]);
        let gained = acceleration.unwrap_or(0.0) * DVec2::new(dt * dt / 2.0, dt);
        Self {
            mean: transition * self.mean + gained,
            covariance: transition * self.covariance * transition.transpose() + noise,
        }
    }

    /// Returns true if a measurement of position (`part` 0) or velocity (1) is compatible with the state.
    fn agrees(&self, part: usize, value: f64, sigma: f64) -> bool {
        let variance = self.covariance.col(part)[part] + sigma * sigma;
        (value - self.mean[part]).powi(2) < GATE * GATE * variance
    }

    /// Returns the state after a measurement of position (`part` 0) or velocity (1).
    fn measured(&self, part: usize, value: f64, sigma: f64) -> Self {
        let column = self.covariance.col(part);
        let gain = column / (column[part] + sigma * sigma);
        let removed = DMat2::from_cols(gain * column.x, gain * column.y);
        Self { mean: self.mean + gain * (value - self.mean[part]), covariance: self.covariance - removed }
    }

    /// Returns the state given that of the next row: `predicted` from this one, and `next` with everything known.
    fn smoothed(&self, dt: f64, predicted: &Self, next: &Self) -> Self {
        let gain = self.covariance * transition(dt).transpose() * predicted.covariance.inverse();
        Self {
            mean: self.mean + gain * (next.mean - predicted.mean),
            covariance: self.covariance + gain * (next.covariance - predicted.covariance) * gain.transpose(),
        }
    }
}

/// Returns the change of position and velocity over `dt` [s] at constant velocity.
fn transition(dt: f64) -> DMat2 {
    DMat2::from_cols(DVec2::X, DVec2::new(dt, 1.0))
}
