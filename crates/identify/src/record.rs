//! Simulation of a motion file on a robot in a backend, recorded as a log.

use std::ops::Range;

use twinstep_logs::{Gain, Log, LogError, Meta, Segment, TorqueSensor};
use twinstep_model::{
    BaseMount, FIXED_BASE_HEIGHT, Ground, InitialState, JOINT_NAMES, Joint, Leg, RobotModel, RobotStates, Simulator,
};

use twinstep_logs::operating_conditions::OperatingConditions;
use twinstep_logs::replay::{
    ActuatorClock, JointCommands, ReplayError, SimulationFailure, at_log_rate, command, joint_commands,
};

/// Reason why a simulation was not recorded.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The commands cannot be simulated.
    #[error(transparent)]
    Motion(#[from] ReplayError),
    /// The backend cannot be created.
    #[error(transparent)]
    Backend(Box<dyn std::error::Error + Send + Sync>),
    /// The simulation failed.
    #[error(transparent)]
    Failed(SimulationFailure),
    /// The recording is not a valid log.
    #[error(transparent)]
    Log(#[from] LogError),
    /// `progress` returned false.
    #[error("interrupted before the last row of the motion file")]
    Interrupted,
}

/// Runs the commands of `motion` on `robot` and returns the log.
///
/// `backend` makes a backend of one robot for a base mount and the robot at the rate of the motion. `base` overrides
/// the mount of the segments. `progress` receives the number of completed rows and returns false to interrupt.
pub fn record<S: Simulator>(
    motion: &Log,
    robot: &RobotModel,
    base: Option<BaseMount>,
    mut backend: impl FnMut(BaseMount, &RobotModel) -> Result<S, RecordError>,
    source: String,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Log, RecordError> {
    let robot = &at_log_rate(motion, robot)?;
    let player = CommandPlayer {
        motion,
        robot,
        joints: joint_commands(motion)?,
        clock: ActuatorClock::of(motion, robot)?,
        conditions: OperatingConditions::of(motion),
    };
    let base_of = |segment: &Segment| base.unwrap_or(segment.base);
    let mut record = Record::default();
    for (segment, rows) in motion.segments() {
        let base = base_of(segment);
        player.simulate(backend(base, robot)?, &segment.name, base, rows, &mut record, progress)?;
    }
    let segments = &motion.meta().segments;
    let segments = segments.iter().map(|segment| Segment { base: base_of(segment), ..segment.clone() }).collect();
    Ok(player.log(record, segments, source)?)
}

/// Recorded channels, with one entry per row.
#[derive(Default)]
struct Record {
    /// Channels in the order of [`sensor_names`].
    sensors: Vec<Vec<f64>>,
    /// Mean torque of each joint from the row to the next [N·m].
    tau_measured: Vec<Vec<f64>>,
}

/// Number of channels of [`sensors`] for the joints; the others are for a floating base.
const JOINT_CHANNELS: usize = 2 * JOINT_NAMES.len();

fn sensor_names() -> Vec<String> {
    let of = |quantity: &'static str, parts: &[&str]| {
        parts.iter().map(|part| format!("{quantity}_{part}")).collect::<Vec<_>>()
    };
    let xyz = ["x", "y", "z"];
    [
        of("q", &JOINT_NAMES),
        of("dq", &JOINT_NAMES),
        of("pos", &xyz),
        of("quat", &["w", "x", "y", "z"]),
        of("vel", &xyz),
        of("gyro", &xyz),
        of("foot_force", &Leg::ALL.map(Leg::name)),
    ]
    .concat()
}

/// Returns the sensor values of one row. Foot forces are not known before the first step.
fn sensors(states: &RobotStates, stepped: bool) -> Vec<f64> {
    let foot_force = if stepped { states.truth.foot_force[0] } else { [f32::NAN; 4] };
    let channels: [&[f32]; 7] = [
        &states.measured.q[0],
        &states.measured.dq[0],
        &states.truth.base_position[0],
        &states.measured.orientation[0],
        &states.truth.base_linear_velocity[0],
        &states.measured.gyro[0],
        &foot_force,
    ];
    channels.into_iter().flatten().copied().map(f64::from).collect()
}

/// Player of a motion file on a robot.
struct CommandPlayer<'a> {
    motion: &'a Log,
    robot: &'a RobotModel,
    joints: Vec<JointCommands<'a>>,
    clock: ActuatorClock,
    conditions: OperatingConditions,
}

impl CommandPlayer<'_> {
    /// Simulates a contiguous range of rows.
    fn simulate<S: Simulator>(
        &self,
        mut backend: S,
        segment: &str,
        base: BaseMount,
        rows: Range<usize>,
        record: &mut Record,
        progress: &mut dyn FnMut(usize) -> bool,
    ) -> Result<(), RecordError> {
        let t = &self.motion.t()[rows.clone()];
        let failed = |row: usize| {
            let (segment, t) = (segment.to_owned(), t[row - rows.start]);
            move |cause| RecordError::Failed(SimulationFailure { segment, row: row + 1, t, cause })
        };
        backend.reset(&[(0, self.initial_state(&backend.ground(), base, rows.start))]).map_err(failed(rows.start))?;
        for row in rows.clone() {
            record.sensors.push(sensors(backend.states(), row > rows.start));
            let mut sums = [0.0; JOINT_NAMES.len()];
            let periods = if row + 1 < rows.end { self.clock.periods_between(t, row - rows.start) } else { 0 };
            let command = command(self.robot, &self.joints, row);
            backend.set_derating(0, &self.conditions.derating_factors(&self.robot.derating, row));
            for _ in 0..periods {
                backend.step(&[command], &[true], 1).map_err(failed(row))?;
                for (sum, torque) in sums.iter_mut().zip(backend.measured().tau[0]) {
                    *sum += f64::from(torque);
                }
            }
            // The last row of a range has no period, so its mean torque is 0/0 = NaN: missing.
            record.tau_measured.push(sums.map(|sum| sum / periods as f64).to_vec());
            if !progress(row + 1) {
                return Err(RecordError::Interrupted);
            }
        }
        Ok(())
    }

    /// Returns the initial state: the measured values of the motion file in `row`, or else the default pose.
    fn initial_state(&self, ground: &Ground, base: BaseMount, row: usize) -> InitialState {
        let cell =
            |name: &str| self.motion.channel(name).map(|cells| cells[row] as f32).filter(|cell| cell.is_finite());
        let mut q = self.robot.control.default_pose_f32();
        let mut dq = [0.0; JOINT_NAMES.len()];
        for (index, name) in JOINT_NAMES.iter().enumerate() {
            q[index] = cell(&format!("q_{name}")).unwrap_or(q[index]);
            dq[index] = cell(&format!("dq_{name}")).unwrap_or(0.0);
        }
        let start = match base {
            BaseMount::Floating => InitialState::standing_on(ground, self.robot, q, 0.0),
            BaseMount::Fixed => InitialState::at_rest(FIXED_BASE_HEIGHT as f32, q),
        };
        let vector = |quantity: &str| {
            let [x, y, z] = ["x", "y", "z"].map(|axis| cell(&format!("{quantity}_{axis}")));
            Some([x?, y?, z?])
        };
        let orientation = || {
            let [w, x, y, z] = ["w", "x", "y", "z"].map(|part| cell(&format!("quat_{part}")));
            Some([w?, x?, y?, z?])
        };
        InitialState {
            base_position: vector("pos").unwrap_or(start.base_position),
            base_orientation: orientation().unwrap_or(start.base_orientation),
            base_linear_velocity: vector("vel").unwrap_or(start.base_linear_velocity),
            base_angular_velocity: vector("gyro").unwrap_or(start.base_angular_velocity),
            dq,
            ..start
        }
    }

    fn log(&self, record: Record, segments: Vec<Segment>, source: String) -> Result<Log, LogError> {
        let motion = self.motion;
        let floating = segments.iter().any(|segment| segment.base == BaseMount::Floating);
        let index = |cells: &[u32]| cells.iter().map(|cell| f64::from(*cell)).collect();
        let mut columns = vec![
            ("t".to_owned(), motion.t().to_vec()),
            ("segment".to_owned(), index(motion.segment())),
            ("episode".to_owned(), index(motion.episode())),
        ];
        let channel = |rows: &[Vec<f64>], channel: usize| rows.iter().map(|row| row[channel]).collect();
        let names = sensor_names();
        let num_channels = if floating { names.len() } else { JOINT_CHANNELS };
        for (index, name) in names.into_iter().take(num_channels).enumerate() {
            columns.push((name, channel(&record.sensors, index)));
        }
        for (joint, name) in JOINT_NAMES.iter().enumerate() {
            columns.push((format!("tau_measured_{name}"), channel(&record.tau_measured, joint)));
        }
        let mut meta = Meta {
            policy_hz: motion.meta().policy_hz,
            joints: JOINT_NAMES.map(str::to_owned).to_vec(),
            pd: Some(format!("PD at {} Hz, held, clipped to the torque limit", self.robot.control.actuator_hz)),
            source: Some(source),
            // The recorded torque is that of the actuator, before rotor inertia and friction.
            ..Meta::new(motion.meta().rate_hz, TorqueSensor::MotorCurrent, segments)
        };
        self.commands(&mut meta, &mut columns);
        // Voltage and temperature are copied, because they are not simulated.
        let given = motion.channels().filter(|(name, _)| *name == "battery_V" || name.starts_with("temp_"));
        columns.extend(given.map(|(name, cells)| (name.to_owned(), cells.to_vec())));
        Log::new(meta, columns)
    }

    /// Adds the commands of all twelve joints. Constant gains are written to the metadata.
    fn commands(&self, meta: &mut Meta, columns: &mut Vec<(String, Vec<f64>)>) {
        let (rows, control) = (self.motion.rows(), &self.robot.control);
        let [mut kp, mut kd] = [Vec::new(), Vec::new()];
        for joint in Joint::ALL {
            let name = joint.name();
            let given = self.joints.iter().find(|commands| commands.joint == joint);
            let default = || vec![control.default_pose[joint.index()]; rows];
            columns.push((format!("q_cmd_{name}"), given.map_or_else(default, |given| given.q_cmd.to_vec())));
            let optional =
                [("dq_cmd", given.and_then(|given| given.dq_cmd)), ("tau_ff", given.and_then(|given| given.tau_ff))];
            for (quantity, cells) in optional {
                if let Some(cells) = cells {
                    columns.push((format!("{quantity}_{name}"), cells.to_vec()));
                }
            }
            kp.push(given.and_then(|given| given.kp.clone()).unwrap_or_else(|| vec![control.kp[joint.index()]; rows]));
            kd.push(given.and_then(|given| given.kd.clone()).unwrap_or_else(|| vec![control.kd[joint.index()]; rows]));
        }
        for (quantity, gains, constant) in [("kp", kp, &mut meta.kp), ("kd", kd, &mut meta.kd)] {
            if gains.iter().all(|cells| cells.iter().all(|cell| *cell == cells[0])) {
                *constant = Some(Gain::by_joint(gains.iter().map(|cells| cells[0])));
            } else {
                let names = JOINT_NAMES.iter().map(|name| format!("{quantity}_{name}"));
                columns.extend(names.zip(gains));
            }
        }
    }
}
