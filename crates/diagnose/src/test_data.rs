//! Data of a joint whose position is proportional to its friction, for tests.

use twinstep_identify::window::WindowConfig;
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, NUM_JOINTS, Precision, RobotStates, Rollout, RolloutRequest, go2};

use super::residual_data::ResidualData;

/// Standard deviation of the measured positions [rad].
const NOISE: f64 = 0.001;

/// Positions that are proportional to the viscous friction of the first joint, with another shape for Coulomb
/// friction.
pub struct Linear;

fn position(viscous: f64, coulomb: f64, row: usize) -> f64 {
    0.05 * viscous * (0.11 * row as f64).sin() + 0.02 * coulomb * (0.11 * row as f64).sin().signum()
}

impl Rollout for Linear {
    fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
        let play = |job: &RolloutRequest| {
            let joint = &job.robot.joints[0];
            let mut states = RobotStates::new(job.commands.len() + 1);
            for (row, q) in states.measured.q.iter_mut().enumerate() {
                q[0] = position(joint.viscous_friction, joint.coulomb_friction, row) as f32;
            }
            states
        };
        jobs.iter().map(play).collect()
    }
}

/// Rows of a robot on the ground, which the simulator cannot follow.
#[derive(Clone, Copy, Debug)]
pub struct Contact {
    /// Time on the ground [s].
    pub seconds: usize,
    /// Amplitude of the error [rad], its frequency [Hz], and the seed of its phases.
    pub amplitude: f64,
    pub hz: f64,
    pub seed: u32,
}

/// Returns the data of a robot with this viscous friction by row, and measurement noise: 20 s in the air, and then on the
/// ground.
pub fn data(viscous: impl Fn(usize) -> f64, contact: Option<Contact>) -> ResidualData {
    ResidualData::new(vec![log(viscous, contact)], &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
}

/// Returns the log of [`data`].
pub fn log(viscous: impl Fn(usize) -> f64, contact: Option<Contact>) -> Log {
    const AIR: usize = 4000;
    const WINDOW_IN_AIR: usize = 400;
    const WINDOW: usize = 200;
    let rows = AIR + contact.map_or(0, |contact| contact.seconds * WINDOW);
    let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..rows).map(of).collect());
    let noise = |row: usize| 3.46 * NOISE * ((row * 7919 % 1009) as f64 / 1009.0 - 0.5);
    // The first row of a window is the last row of the previous one.
    let in_window = |row: usize, length: usize| if row == 0 { 0 } else { (row - 1) % length + 1 };
    let measured = |row: usize| match contact {
        Some(Contact { amplitude, hz, seed, .. }) if row >= AIR => {
            let (window, row) = ((row - AIR) / WINDOW, row - AIR);
            let phase = f64::from(seed) * (window * 6151 % 97) as f64;
            let error = amplitude * (std::f64::consts::TAU * hz * row as f64 / 200.0 + phase).sin();
            position(viscous(AIR + row), 0.0, in_window(row, WINDOW)) + error
        }
        _ => position(viscous(row), 0.0, in_window(row, WINDOW_IN_AIR)),
    };
    let columns = [
        column("t", &|row| row as f64 / 200.0),
        column("segment", &|row| f64::from(row >= AIR)),
        column("q_FL_hip", &|row| measured(row) + noise(row)),
        column("dq_FL_hip", &|row| 0.3 * (0.11 * in_window(row, WINDOW_IN_AIR) as f64).cos()),
        column("q_cmd_FL_hip", &|_| 0.0),
        column("kp", &|_| 25.0),
        column("kd", &|_| 0.6),
        column("quat_w", &|_| 1.0),
        column("pos_z", &|_| 0.0),
        column("vel_x", &|_| 0.0),
    ];
    let segment = |name: &str, base| Segment { name: name.to_owned(), base };
    let mut segments = vec![segment("air", BaseMount::Fixed)];
    segments.extend(contact.map(|_| segment("ground", BaseMount::Floating)));
    let mut meta = Meta::new(200.0, TorqueSensor::None, segments);
    meta.noise.insert("q_FL_hip".to_owned(), NOISE);
    Log::new(meta, columns).expect("a log")
}

/// Robot of which each joint moves by its Coulomb friction minus the mean of those of its leg.
pub struct Coupled;

impl Coupled {
    /// Returns the position of a joint [rad] with these Coulomb frictions, by joint and row.
    pub fn position(friction: [f64; NUM_JOINTS]) -> impl Fn(usize, usize) -> f64 {
        let mean = |joint: usize| friction[joint / 3 * 3..][..3].iter().sum::<f64>() / 3.0;
        let moving: [f64; NUM_JOINTS] = std::array::from_fn(|joint| friction[joint] - mean(joint));
        move |joint, row| position(0.0, moving[joint], row)
    }
}

impl Rollout for Coupled {
    fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
        let play = |job: &RolloutRequest| {
            let moved = Self::position(job.robot.joints.each_ref().map(|joint| joint.coulomb_friction));
            let mut states = RobotStates::new(job.commands.len() + 1);
            for (row, q) in states.measured.q.iter_mut().enumerate() {
                *q = std::array::from_fn(|joint| moved(joint, row) as f32);
            }
            states
        };
        jobs.iter().map(play).collect()
    }
}

/// Returns the data of a robot with this Coulomb friction at its left front calf [N·m], where the joints of a leg move each other.
pub fn coupled_with_calf_friction(base: BaseMount, friction: f64) -> ResidualData {
    let calf = std::array::from_fn(|joint| if joint == 2 { friction } else { 0.0 });
    moving(base, &Coupled::position(calf))
}

/// Returns the data of a robot that moves for 20 s, with these joint positions [rad] by joint and row of a window.
fn moving(base: BaseMount, q: &dyn Fn(usize, usize) -> f64) -> ResidualData {
    const ROWS: usize = 4000;
    let window = if base == BaseMount::Fixed { 400 } else { 200 };
    let column = |name: String, of: &dyn Fn(usize) -> f64| (name, (0..ROWS).map(of).collect::<Vec<f64>>());
    let constants = [("kp", 25.0), ("kd", 0.6), ("quat_w", 1.0), ("pos_z", 0.0), ("vel_x", 0.0)];
    let mut columns = vec![column("t".to_owned(), &|row| row as f64 / 200.0)];
    columns.extend(constants.map(|(name, value)| column(name.to_owned(), &|_| value)));
    let noise = |row: usize| 3.46 * NOISE * ((row * 7919 % 1009) as f64 / 1009.0 - 0.5);
    for (joint, name) in JOINT_NAMES.into_iter().enumerate() {
        // The first row of a window is the last row of the previous one.
        let in_window = |row: usize| if row == 0 { 0 } else { (row - 1) % window + 1 };
        columns.push(column(format!("q_{name}"), &|row| q(joint, in_window(row)) + noise(row)));
        columns.push(column(format!("q_cmd_{name}"), &|_| 0.0));
    }
    let segments = vec![Segment { name: "motion".to_owned(), base }];
    let mut meta = Meta::new(200.0, TorqueSensor::None, segments);
    meta.noise.extend(JOINT_NAMES.map(|joint| (format!("q_{joint}"), NOISE)));
    let log = Log::new(meta, columns).expect("a log");
    ResidualData::new(vec![log], &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
}

/// Robot that stands still, with a gyroscope whose reading is its bias.
pub struct AtRest;

impl Rollout for AtRest {
    fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
        let play = |job: &RolloutRequest| {
            let mut states = RobotStates::new(job.commands.len() + 1);
            states.measured.gyro.fill(job.robot.gyro_bias.to_array().map(|bias| bias as f32));
            states
        };
        jobs.iter().map(play).collect()
    }
}

/// Returns the data of a robot that stands for 20 s, with noise of 0.02 rad/s and this bias of its gyroscope [rad/s].
///
/// If it `hangs` before, for 20 s, its feet shake the base later, which the simulator does not follow.
pub fn data_at_rest(bias: [f64; 3], hangs: bool) -> ResidualData {
    const ROWS: usize = 4000;
    const NOISE: f64 = 0.02;
    let rows = if hangs { 2 * ROWS } else { ROWS };
    let column = |name: String, of: &dyn Fn(usize) -> f64| (name, (0..rows).map(of).collect::<Vec<f64>>());
    let shaking = |row: usize| if hangs && row >= ROWS { 0.3 * (0.05 * row as f64).sin() } else { 0.0 };
    let constants = [("kp", 25.0), ("kd", 0.6), ("quat_w", 1.0), ("pos_z", 0.0), ("vel_x", 0.0)];
    let mut columns = vec![column("t".to_owned(), &|row| row as f64 / 200.0)];
    columns.extend(constants.map(|(name, value)| column(name.to_owned(), &|_| value)));
    for joint in JOINT_NAMES {
        columns.extend(["q", "q_cmd"].map(|quantity| column(format!("{quantity}_{joint}"), &|_| 0.0)));
    }
    for (axis, name) in ["gyro_x", "gyro_y", "gyro_z"].into_iter().enumerate() {
        let noise = |row: usize| 3.46 * NOISE * (((row + 50 * axis) * 7919 % 1009) as f64 / 1009.0 - 0.5);
        columns.push(column(name.to_owned(), &|row| bias[axis] + noise(row) + shaking(row)));
    }
    columns.push(column("segment".to_owned(), &|row| f64::from(hangs && row >= ROWS)));
    let stand = Segment { name: "stand".to_owned(), base: BaseMount::Floating };
    let hang = hangs.then(|| Segment { name: "hang".to_owned(), base: BaseMount::Fixed });
    let mut meta = Meta::new(200.0, TorqueSensor::None, hang.into_iter().chain([stand]).collect());
    meta.noise.insert("gyro".to_owned(), NOISE);
    let log = Log::new(meta, columns).expect("a log");
    ResidualData::new(vec![log], &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
}

/// Returns the data of a robot that stands for 40 s, whose left front calf has this encoder offset [rad] at each time [s].
pub fn standing(offset: impl Fn(f64) -> f64) -> ResidualData {
    const ROWS: usize = 8000;
    let column = |name: String, of: &dyn Fn(f64) -> f64| {
        (name, (0..ROWS).map(|row| of(row as f64 / 200.0)).collect::<Vec<f64>>())
    };
    let mut columns = vec![column("t".to_owned(), &|t| t)];
    let zeros = ["quat_x", "quat_y", "quat_z", "vel_x"].map(|name| (name, 0.0));
    for (name, value) in [("kp", 25.0), ("kd", 0.6), ("quat_w", 1.0), ("pos_z", 0.3)].into_iter().chain(zeros) {
        columns.push(column(name.to_owned(), &|_| value));
    }
    for (joint, name) in JOINT_NAMES.into_iter().enumerate() {
        let pose = go2().control.default_pose[joint];
        columns.push(column(format!("q_{name}"), &|t| pose + if name == "FL_calf" { offset(t) } else { 0.0 }));
        columns.push(column(format!("q_cmd_{name}"), &|_| pose));
        columns.push(column(format!("dq_{name}"), &|_| 0.0));
    }
    let segments = vec![Segment { name: "stance".to_owned(), base: BaseMount::Floating }];
    let log = Log::new(Meta::new(200.0, TorqueSensor::None, segments), columns).expect("a log");
    ResidualData::new(vec![log], &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
}

/// Returns the data of a joint that does not move while its command swings by up to 0.3 rad, with this measured torque [N·m]
/// for each position error [rad].
pub fn held(torque: impl Fn(f64) -> f64) -> ResidualData {
    const ROWS: usize = 4000;
    let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..ROWS).map(of).collect::<Vec<f64>>());
    let error = |row: usize| 0.3 * (0.0031 * row as f64).sin() * (0.03 * row as f64).sin();
    let noise = |row: usize| 0.5 * ((row * 7919 % 1009) as f64 / 1009.0 - 0.5);
    let columns = [
        column("t", &|row| row as f64 / 200.0),
        column("q_FL_hip", &|_| 0.0),
        column("dq_FL_hip", &|_| 0.0),
        column("q_cmd_FL_hip", &error),
        column("tau_measured_FL_hip", &|row| torque(error(row)) + noise(row)),
        column("kp", &|_| 25.0),
        column("kd", &|_| 0.6),
    ];
    let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
    let log = Log::new(Meta::new(200.0, TorqueSensor::MotorCurrent, segments), columns).expect("a log");
    ResidualData::new(vec![log], &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
}
