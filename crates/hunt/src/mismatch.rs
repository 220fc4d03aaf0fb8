//! Errors of a healthy robot and of its recording that no effect of the catalogue describes, in eight families.

use rand::RngExt;
use serde::{Deserialize, Serialize};
use twinstep_logs::{Log, LogError, Meta};
use twinstep_model::{CompliantStand, RobotModel, Stream, standard_normal};

/// Error of a thigh's length [m].
const THIGH_ERROR_M: f64 = 0.005;
/// Relative error of a link's mass.
const LINK_MASS_ERROR: f64 = 0.1;
/// Error of the trunk's centre of mass along each axis [m].
const CENTRE_ERROR_M: f64 = 0.006;
/// Relative error of the gains.
const GAIN_ERROR: f64 = 0.05;
/// Range of the natural frequency of a stand that gives way [Hz].
const STAND_HZ: [f64; 2] = [6.0, 15.0];
/// Range of its damping ratio.
const STAND_DAMPING: [f64; 2] = [0.1, 0.3];
/// Range of the delay of motion capture, IMU and foot forces [s].
const CLOCK_OFFSET_S: [f64; 2] = [0.002, 0.008];
/// Fraction of the rows that are lost.
const LOST_ROWS: f64 = 0.02;
/// Standard deviation of the error of a row's time [s].
const TIME_JITTER_S: f64 = 0.0003;

/// Family of errors of a robot in which no effect is hidden.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mismatch {
    /// Thighs that are up to 5 mm longer or shorter, each by its own error.
    ThighLength,
    /// Masses of the legs' links that are up to 10 % off.
    LinkMass,
    /// Centre of mass of the trunk that is up to 6 mm off along each axis.
    CentreOfMass,
    /// Gains that are up to 5 % off, each joint by its own error.
    Gains,
    /// A stand that gives way, for a robot that hangs.
    CompliantStand,
    /// Motion capture, IMU and foot forces that are recorded 2 to 8 ms late.
    Clocks,
    /// Rows that are lost, and times with errors.
    DropsAndJitter,
    /// Metadata that state half or twice the noise.
    NoiseMisstated,
}

impl Mismatch {
    /// All families.
    pub const ALL: [Self; 8] = [
        Self::ThighLength,
        Self::LinkMass,
        Self::CentreOfMass,
        Self::Gains,
        Self::CompliantStand,
        Self::Clocks,
        Self::DropsAndJitter,
        Self::NoiseMisstated,
    ];

    /// Returns the name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::ThighLength => "thighs up to 5 mm off",
            Self::LinkMass => "link masses up to 10 % off",
            Self::CentreOfMass => "centre of mass up to 6 mm off",
            Self::Gains => "gains up to 5 % off",
            Self::CompliantStand => "a stand that gives way",
            Self::Clocks => "clocks 2 to 8 ms apart",
            Self::DropsAndJitter => "lost rows and jitter",
            Self::NoiseMisstated => "noise misstated by a factor of 2",
        }
    }

    /// Changes the robot as this family does.
    pub fn change_robot(self, robot: &mut RobotModel, random: &mut Stream) {
        let mut error = |largest: f64| random.random_range(-largest..largest);
        match self {
            Self::ThighLength => {
                for leg in &mut robot.legs {
                    leg.origins[2].z += error(THIGH_ERROR_M);
                }
            }
            Self::LinkMass => {
                for body in robot.legs.iter_mut().flat_map(|leg| &mut leg.bodies) {
                    *body = body.scaled(1.0 + error(LINK_MASS_ERROR));
                }
            }
            Self::CentreOfMass => {
                for length in [&mut robot.trunk.com.x, &mut robot.trunk.com.y, &mut robot.trunk.com.z] {
                    *length += error(CENTRE_ERROR_M);
                }
            }
            Self::Gains => {
                for joint in &mut robot.joints {
                    joint.actuator.kp_scale *= 1.0 + error(GAIN_ERROR);
                    joint.actuator.kd_scale *= 1.0 + error(GAIN_ERROR);
                }
            }
            Self::CompliantStand | Self::Clocks | Self::DropsAndJitter | Self::NoiseMisstated => {}
        }
    }

    /// Returns the stand that holds the robot in MuJoCo; `None` for a rigid one.
    pub fn stand(self, random: &mut Stream) -> Option<CompliantStand> {
        (self == Self::CompliantStand).then(|| CompliantStand {
            frequency_hz: random.random_range(STAND_HZ[0]..STAND_HZ[1]),
            damping_ratio: random.random_range(STAND_DAMPING[0]..STAND_DAMPING[1]),
        })
    }

    /// Changes the log as this family does.
    pub fn change_log(self, log: Log, random: &mut Stream) -> Result<Log, LogError> {
        match self {
            Self::Clocks => late(&log, random.random_range(CLOCK_OFFSET_S[0]..CLOCK_OFFSET_S[1])),
            Self::DropsAndJitter => with_lost_rows(&log, random),
            Self::NoiseMisstated => {
                let factor = if random.random_bool(0.5) { 2.0 } else { 0.5 };
                let mut meta = log.meta().clone();
                meta.noise.values_mut().for_each(|sigma| *sigma *= factor);
                Log::new(meta, columns(&log))
            }
            _ => Ok(log),
        }
    }

    /// Returns true if a cause of this name only repeats the error of the robot.
    pub fn describes(self, effect: &str) -> bool {
        self == Self::Gains && effect == "pd_gain"
    }
}

/// Returns all columns of a log.
pub fn columns(log: &Log) -> Vec<(String, Vec<f64>)> {
    let index = |cells: &[u32]| cells.iter().map(|cell| f64::from(*cell)).collect();
    let own = [
        ("t".to_owned(), log.t().to_vec()),
        ("segment".to_owned(), index(log.segment())),
        ("episode".to_owned(), index(log.episode())),
    ];
    own.into_iter().chain(log.channels().map(|(name, cells)| (name.to_owned(), cells.to_vec()))).collect()
}

/// Returns the log with motion capture, IMU and foot forces recorded `delay` [s] late.
fn late(log: &Log, delay: f64) -> Result<Log, LogError> {
    let is_late = |name: &str| {
        ["pos_", "quat_", "vel_", "gyro_", "acc_", "foot_force_"].iter().any(|start| name.starts_with(start))
    };
    let mut columns = columns(log);
    let rows_late = delay * log.meta().rate_hz;
    for (name, cells) in columns.iter_mut().filter(|(name, _)| is_late(name)) {
        let before = cells.clone();
        for (_, rows) in log.segments() {
            for row in rows.clone() {
                let at = (row as f64 - rows_late).max(rows.start as f64);
                let (first, part) = (at.floor() as usize, at.fract());
                let next = before[(first + 1).min(rows.end - 1)];
                // Before the second row a force is unknown.
                cells[row] = if part > 0.0 { before[first] * (1.0 - part) + next * part } else { before[first] };
            }
        }
        // Interpolated quaternions of neighbouring rows are of length 1 within 1e-5.
        debug_assert_eq!(cells.len(), before.len(), "{name}");
    }
    Log::new(log.meta().clone(), columns)
}

/// Returns the log without some of its rows, and with errors of the times of the others.
fn with_lost_rows(log: &Log, random: &mut Stream) -> Result<Log, LogError> {
    let mut kept: Vec<usize> = Vec::new();
    for (_, rows) in log.segments() {
        let last = rows.end - 1;
        kept.extend(rows.clone().filter(|row| *row == rows.start || *row == last || !random.random_bool(LOST_ROWS)));
    }
    let meta: Meta = log.meta().clone();
    let columns = columns(log).into_iter().map(|(name, cells)| {
        let is_time = name == "t";
        let cell = |row: &usize| {
            let error = if is_time { standard_normal(random).clamp(-2.0, 2.0) * TIME_JITTER_S } else { 0.0 };
            cells[*row] + error
        };
        let cells = kept.iter().map(cell).collect();
        (name, cells)
    });
    Log::new(meta, columns.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use twinstep_logs::{Segment, TorqueSensor};
    use twinstep_model::{BaseMount, go2, stream};

    use super::*;

    fn log() -> Log {
        let column = |name: &str, of: fn(f64) -> f64| {
            (name.to_owned(), (0..400).map(|row| of(f64::from(row) / 200.0)).collect::<Vec<_>>())
        };
        let columns = [
            column("t", |t| t),
            column("q_FL_hip", |t| t),
            column("q_cmd_FL_hip", |t| t),
            column("gyro_x", |t| 3.0 * t),
            column("kp", |_| 25.0),
            column("kd", |_| 0.6),
        ];
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let mut meta = Meta::new(200.0, TorqueSensor::None, segments);
        meta.noise.insert("q_FL_hip".to_owned(), 0.001);
        Log::new(meta, columns).expect("a log")
    }

    #[test]
    fn clock_offset_delays_the_inertial_measurement_unit_and_not_the_joints() {
        let changed = Mismatch::Clocks.change_log(log(), &mut stream(1, "test", 0)).expect("a log");
        assert_eq!(changed.q("FL_hip"), log().q("FL_hip"));
        let (now, before) = (changed.channel("gyro_x").expect("kept"), log().channel("gyro_x").expect("kept")[300]);
        let delay = (before - now[300]) / 3.0;
        assert!((CLOCK_OFFSET_S[0]..CLOCK_OFFSET_S[1]).contains(&delay), "{delay}");
    }

    #[test]
    fn lost_rows_leave_a_valid_log() {
        let changed = Mismatch::DropsAndJitter.change_log(log(), &mut stream(2, "test", 0)).expect("a log");
        assert!((380..400).contains(&changed.rows()), "{}", changed.rows());
        assert!(changed.t().windows(2).all(|pair| pair[1] > pair[0]));
    }

    #[test]
    fn families_change_the_robot_or_the_log() {
        for family in Mismatch::ALL {
            let mut robot = go2();
            family.change_robot(&mut robot, &mut stream(3, "test", 0));
            let changed = family.change_log(log(), &mut stream(3, "test", 0)).expect("a log");
            let same_log = changed.t() == log().t()
                && changed.meta() == log().meta()
                && changed.channel("gyro_x") == log().channel("gyro_x");
            let has_stand = family.stand(&mut stream(3, "test", 0)).is_some();
            assert!(robot != go2() || !same_log || has_stand, "{family:?}");
        }
    }
}
