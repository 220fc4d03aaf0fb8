//! A measured log replayed in the simulator, and what the simulation gets wrong, joint by joint.

use std::fmt::Write as _;
use std::ops::Range;

use twinstep_logs::{BaseMount as MeasuredBase, Log};
use twinstep_model::{Backend, FIXED_BASE_HEIGHT, InitialState, RobotModel};
use twinstep_sim::{BaseMount, BatchBackend, BackendBuildError, SimConfig};

use twinstep_sysid::motion::{DriveClock, SimulationFailure, JointCommands, MotionError, cell_or_zero, command, joint_commands};

/// Columns of the longest bar of [`Replay::table`].
const BAR_WIDTH: f64 = 24.0;
/// The longest bar stands for at least this RMSE [rad], so that rounding errors draw no bars.
const LEAST_BAR_SCALE: f64 = 1e-3;

/// A measured log beside the simulation under the same commands.
#[derive(Clone, Debug, PartialEq)]
pub struct Replay {
    /// The joints of the log, in the order of [`Joint::ALL`].
    pub joints: Vec<JointError>,
    /// The log's time of each row [s].
    pub t: Vec<f64>,
    /// The rows of each part of the log; the robot is placed anew at the start of each.
    pub parts: Vec<Range<usize>>,
    /// Root mean square over all joints and rows of the position error [rad].
    pub rmse_rad: f64,
}

/// One joint, measured and simulated, with one entry a row.
#[derive(Clone, Debug, PartialEq)]
pub struct JointError {
    /// The joint's name.
    pub name: String,
    /// Root mean square of simulated − measured position [rad].
    pub rmse_rad: f64,
    /// Largest absolute value of simulated − measured position [rad].
    pub max_rad: f64,
    /// Measured position [rad].
    pub measured: Vec<f64>,
    /// Simulated position at the same time [rad].
    pub simulated: Vec<f64>,
    /// Commanded position [rad].
    pub command: Vec<f64>,
}

/// Why a log cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The trunk was free to move.
    #[error(
        "segment `{segment}` has base \"floating\": only segments with base \"fixed\" are replayed\n  \
         leave its rows out of the log, or record with the trunk on a stand"
    )]
    FloatingBase {
        /// The segment's name.
        segment: String,
    },
    /// A motion was given, which holds commands but no measurement.
    #[error("joint `{joint}` of the log has no `q`: a replay needs measured positions")]
    NotMeasured {
        /// The joint's name.
        joint: String,
    },
    /// The log's commands or its time do not fit the robot.
    #[error(transparent)]
    Motion(#[from] MotionError),
    /// The simulation could not be built.
    #[error(transparent)]
    Build(#[from] BackendBuildError),
    /// The simulation failed.
    #[error(transparent)]
    Simulation(#[from] SimulationFailure),
}

/// Puts `robot` down at the first measured state of each part of `log` and commands it as logged to the part's end.
///
/// Row k's measured position is compared with the simulated position at that time; in a part's first row both are
/// equal. A row's command is in force to the next row, under the ideal drive at the model's rate. Joints that the log
/// lacks hold the default pose; a missing velocity or feed-forward torque is zero. The base of `config` is set from
/// the segment. `progress` receives the number of rows done.
pub fn replay(
    log: &Log,
    robot: &RobotModel,
    config: SimConfig,
    progress: &mut dyn FnMut(usize),
) -> Result<Replay, ReplayError> {
    if let Some((segment, _)) = log.segments().find(|(segment, _)| segment.base == MeasuredBase::Floating) {
        return Err(ReplayError::FloatingBase { segment: segment.name.clone() });
    }
    let commands = joint_commands(log)?;
    let joints = commands.iter().map(|commands| MeasuredJoint::of(log, commands)).collect::<Result<Vec<_>, _>>()?;
    let clock = DriveClock::of(log, robot)?;
    let mut backend = BatchBackend::new(robot.clone(), SimConfig { base: BaseMount::Fixed, ..config }, 1)?;
    let mut simulated = vec![Vec::with_capacity(log.rows()); joints.len()];
    for (segment, rows) in log.segments() {
        let failed = |row: usize| {
            let (segment, t) = (segment.name.clone(), log.t()[row]);
            move |cause| SimulationFailure { segment, row: row + 1, t, cause }
        };
        backend.reset(&[(0, placement(robot, &joints, rows.start))]).map_err(failed(rows.start))?;
        for row in rows.clone() {
            for (joint, simulated) in joints.iter().zip(&mut simulated) {
                simulated.push(f64::from(backend.states().q[0][joint.commands.joint.index()]));
            }
            if row + 1 < rows.end {
                let drive_periods = clock.periods_between(&log.t()[rows.start..], row - rows.start);
                backend.step(&[command(robot, &commands, row)], &[true], drive_periods).map_err(failed(row))?;
            }
            progress(row + 1);
        }
    }
    let joints: Vec<_> = joints.iter().zip(simulated).map(|(joint, simulated)| joint.compare(simulated)).collect();
    let rmse_rad = root_mean_square(joints.iter().map(|joint| joint.rmse_rad));
    Ok(Replay { joints, t: log.t().to_vec(), parts: log.segments().map(|(_, rows)| rows).collect(), rmse_rad })
}

impl Replay {
    /// A text table with one line a joint, bars in proportion to the RMSE, and a last line over all joints.
    pub fn table(&self) -> String {
        let worst = self.joints.iter().map(|joint| joint.rmse_rad).fold(LEAST_BAR_SCALE, f64::max);
        let largest = self.joints.iter().map(|joint| joint.max_rad).fold(0.0, f64::max);
        let mut table = "joint       RMSE [rad]  largest error [rad]\n".to_owned();
        let mut line = |name: &str, rmse_rad: f64, max_rad: f64, bar: &str| {
            let line = format!("{name:<10}  {rmse_rad:>10.4}  {max_rad:>19.4}  {bar}");
            writeln!(table, "{}", line.trim_end()).expect("a String takes every text");
        };
        for joint in &self.joints {
            line(&joint.name, joint.rmse_rad, joint.max_rad, &bar(joint.rmse_rad / worst));
        }
        line("all joints", self.rmse_rad, largest, "");
        table
    }
}

/// What the log holds of one joint.
struct MeasuredJoint<'a> {
    commands: &'a JointCommands<'a>,
    q: &'a [f64],
    dq: Option<&'a [f64]>,
}

impl<'a> MeasuredJoint<'a> {
    fn of(log: &'a Log, commands: &'a JointCommands<'a>) -> Result<Self, ReplayError> {
        let name = commands.joint.name();
        let q = log.q(name).ok_or_else(|| ReplayError::NotMeasured { joint: name.to_owned() })?;
        Ok(Self { commands, q, dq: log.dq(name) })
    }

    fn compare(&self, simulated: Vec<f64>) -> JointError {
        let errors = || simulated.iter().zip(self.q).map(|(simulated, measured)| simulated - measured);
        JointError {
            name: self.commands.joint.name().to_owned(),
            rmse_rad: root_mean_square(errors()),
            max_rad: errors().map(f64::abs).fold(0.0, f64::max),
            measured: self.q.to_vec(),
            command: self.commands.q_cmd.to_vec(),
            simulated,
        }
    }
}

fn placement(robot: &RobotModel, joints: &[MeasuredJoint], row: usize) -> InitialState {
    let mut placement = InitialState::at_rest(FIXED_BASE_HEIGHT as f32, robot.control.default_pose_f32());
    for joint in joints {
        let index = joint.commands.joint.index();
        placement.q[index] = joint.q[row] as f32;
        placement.dq[index] = cell_or_zero(joint.dq, row);
    }
    placement
}

fn root_mean_square(values: impl Iterator<Item = f64>) -> f64 {
    let (count, sum) = values.fold((0, 0.0), |(count, sum), value| (count + 1, sum + value * value));
    if count == 0 { 0.0 } else { (sum / f64::from(count)).sqrt() }
}

/// A bar of `share` times the full width, in eighths of a column.
fn bar(share: f64) -> String {
    const EIGHTHS: [&str; 8] = ["", "▏", "▎", "▍", "▌", "▋", "▊", "▉"];
    let eighths = (share * BAR_WIDTH * 8.0).round() as usize;
    "█".repeat(eighths / 8) + EIGHTHS[eighths % 8]
}

#[cfg(test)]
mod tests {
    use expect_test::expect;
    use twinstep_logs::{Gain, LogError, Meta, Segment, TorqueSensor};
    use twinstep_model::{Command, Joint, go2};

    use super::*;

    const ROWS: usize = 120;
    const KP: f32 = 20.0;
    const KD: f32 = 1.5;

    fn config() -> SimConfig {
        SimConfig { threads: 1, ..SimConfig::default() }
    }

    fn meta(base: MeasuredBase) -> Meta {
        let segments = vec![Segment { name: "hang".to_owned(), base }];
        let gain = |gain: f32| Some(Gain::Uniform(f64::from(gain)));
        Meta { kp: gain(KP), kd: gain(KD), ..Meta::new(200.0, TorqueSensor::None, segments) }
    }

    /// Columns of the model's own motion: every joint but the rear right leg's swings, each with another phase.
    fn simulated_columns() -> Vec<(String, Vec<f64>)> {
        let robot = go2();
        let pose = robot.control.default_pose_f32();
        let fixed = SimConfig { base: BaseMount::Fixed, ..config() };
        let mut backend = BatchBackend::new(robot.clone(), fixed, 1).expect("a simulation");
        backend.reset(&[(0, InitialState::at_rest(FIXED_BASE_HEIGHT as f32, pose))]).expect("placed");
        let t = (0..ROWS).map(|row| row as f64 * 0.005).collect();
        let [mut q, mut q_cmd] = [0, 1].map(|_| vec![Vec::new(); Joint::ALL.len()]);
        for row in 0..ROWS {
            let mut command = Command::hold(pose, KP, KD);
            for joint in &Joint::ALL[..9] {
                command.q[joint.index()] += 0.3 * (row as f32 * 0.1 + joint.index() as f32).sin();
            }
            for joint in Joint::ALL.iter().skip(9) {
                let index = joint.index();
                (command.kp[index], command.kd[index]) = (robot.control.kp as f32, robot.control.kd as f32);
            }
            for joint in 0..Joint::ALL.len() {
                q[joint].push(f64::from(backend.states().q[0][joint]));
                q_cmd[joint].push(f64::from(command.q[joint]));
            }
            backend.step(&[command], &[true], 1).expect("stepped");
        }
        let joints = Joint::ALL.iter().zip(q.into_iter().zip(q_cmd)).take(9);
        let columns =
            joints.flat_map(|(joint, (q, q_cmd))| [(format!("q_{joint}"), q), (format!("q_cmd_{joint}"), q_cmd)]);
        std::iter::once(("t".to_owned(), t)).chain(columns).collect()
    }

    fn replayed(log: Result<Log, LogError>) -> Result<Replay, ReplayError> {
        replay(&log.expect("a log"), &go2(), config(), &mut |_| {})
    }

    fn with_column(name: &str, change: impl Fn(usize, f64) -> f64) -> Vec<(String, Vec<f64>)> {
        let mut columns = simulated_columns();
        let (_, cells) = columns.iter_mut().find(|(column, _)| column == name).expect("a column");
        *cells = cells.iter().enumerate().map(|(row, cell)| change(row, *cell)).collect();
        columns
    }

    #[test]
    fn log_of_the_model_itself_replays_without_error_and_missing_joints_hold_the_default_pose() {
        let mut rows_done = Vec::new();
        let log = Log::new(meta(MeasuredBase::Fixed), simulated_columns()).expect("a log");
        let replay = replay(&log, &go2(), config(), &mut |rows| rows_done.push(rows)).expect("a replay");
        assert_eq!(replay.joints.len(), 9);
        assert_eq!(replay.rmse_rad, 0.0);
        assert!(rows_done.into_iter().eq(1..=ROWS));
    }

    #[test]
    fn wrong_gain_shows_as_error_in_every_joint_that_moves() {
        let stiffer = Meta { kp: Some(Gain::Uniform(1.5 * f64::from(KP))), ..meta(MeasuredBase::Fixed) };
        let replay = replayed(Log::new(stiffer, simulated_columns())).expect("a replay");
        for joint in &replay.joints {
            assert_eq!(joint.simulated[0], joint.measured[0], "{} starts as measured", joint.name);
            assert!(joint.rmse_rad > 0.01 && joint.max_rad > joint.rmse_rad, "{joint:?}");
        }
    }

    #[test]
    fn each_part_starts_from_its_own_first_measurement() {
        let mut columns = simulated_columns();
        columns.push(("episode".to_owned(), (0..ROWS).map(|row| f64::from(u8::from(row >= 70))).collect()));
        let replay = replayed(Log::new(meta(MeasuredBase::Fixed), columns)).expect("a replay");
        assert_eq!(replay.parts, [0..70, 70..ROWS]);
        for joint in &replay.joints {
            assert_eq!(joint.simulated[..=70], joint.measured[..=70], "{}", joint.name);
        }
        assert!(replay.rmse_rad > 0.0, "the second part's unknown speed costs something");
    }

    #[test]
    fn late_row_and_a_clock_within_two_percent_change_nothing() {
        let columns = with_column("t", |row, t| 1.015 * t + if row == 40 { 0.002 } else { 0.0 });
        let replay = replayed(Log::new(meta(MeasuredBase::Fixed), columns)).expect("a replay");
        assert_eq!(replay.rmse_rad, 0.0);
    }

    #[test]
    fn gap_in_the_log_is_simulated_at_its_length() {
        let resting = |mut columns: Vec<(String, Vec<f64>)>| {
            // A constant command, so that a row left out costs nothing.
            for (name, cells) in &mut columns {
                if name.starts_with("q_cmd_") {
                    *cells = vec![cells[0]; ROWS];
                }
            }
            columns
        };
        let log = |columns| Log::new(meta(MeasuredBase::Fixed), columns);
        let whole = replayed(log(resting(simulated_columns()))).expect("a replay");
        let mut columns = resting(simulated_columns());
        for (_, cells) in &mut columns {
            cells.drain(50..55);
        }
        let gapped = replayed(log(columns)).expect("a replay");
        assert_eq!(gapped.joints[0].simulated[50..], whole.joints[0].simulated[55..]);
    }

    #[test]
    fn floating_segment_is_refused_by_name() {
        let error = replayed(Log::new(meta(MeasuredBase::Floating), simulated_columns())).expect_err("refused");
        expect![[r#"
            segment `hang` has base "floating": only segments with base "fixed" are replayed
              leave its rows out of the log, or record with the trunk on a stand"#]]
        .assert_eq(&error.to_string());
    }

    #[test]
    fn rate_that_the_drive_cannot_follow_is_refused_with_both_periods() {
        let columns = with_column("t", |_, t| 1.3 * t);
        let error = replayed(Log::new(meta(MeasuredBase::Fixed), columns)).expect_err("refused");
        expect![[r"
            the log's median sample period is 6.500 ms, not a whole number of the drive's 5.000 ms within 2 %
              resample the log, or give the robot model a `drive_hz` that the log's rate divides"]]
        .assert_eq(&error.to_string());
    }

    #[test]
    fn unknown_joint_is_refused_by_name() {
        let column = |name: &str| (name.to_owned(), vec![0.0, 0.005]);
        let log = Log::new(meta(MeasuredBase::Fixed), ["t", "q_knee", "q_cmd_knee"].map(column));
        let error = replayed(log).expect_err("refused");
        assert!(
            error.to_string().starts_with("joint `knee` of the log is none of the robot's\n  its joints are FL_hip")
        );
    }

    #[test]
    fn table_shows_each_joint_with_a_bar_and_all_joints_last() {
        let joint = |name: &str, rmse_rad: f64, max_rad: f64| JointError {
            name: name.to_owned(),
            rmse_rad,
            max_rad,
            measured: Vec::new(),
            simulated: Vec::new(),
            command: Vec::new(),
        };
        let joints =
            vec![joint("FL_hip", 0.0123, 0.05), joint("FL_thigh", 0.04, 0.123_45), joint("FL_calf", 0.000_02, 0.0001)];
        let replay = Replay { joints, t: Vec::new(), parts: Vec::new(), rmse_rad: 0.0242 };
        expect![[r"
            joint       RMSE [rad]  largest error [rad]
            FL_hip          0.0123               0.0500  ███████▍
            FL_thigh        0.0400               0.1235  ████████████████████████
            FL_calf         0.0000               0.0001
            all joints      0.0242               0.1235
        "]]
        .assert_eq(&replay.table());
    }
}
