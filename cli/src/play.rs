//! `twinstep play`: a motion file through a robot model, as a measured log.

use std::ops::Range;
use std::path::PathBuf;

use indicatif::ProgressBar;
use twinstep_logs::{Base as LoggedBase, Gain, Log, Meta, Segment, TauSensor};
use twinstep_model::{Backend, Ground, HELD_HEIGHT, JOINT_NAMES, Joint, Leg, Placement, RobotModel, RobotStates};
use twinstep_sim::{Base, BatchBackend, Engine, RapierBackend, SimConfig};

use crate::exit::{Failure, Outcome, Signals, input, other};
use crate::robot_file::robot_model;
use crate::serve::engine;
use twinstep_sysid::motion::{DriveClock, FailedAt, JointCommands, command, joint_commands};

/// Play a motion file through a robot model, and write what the robot did as a measured log.
///
/// A motion file is a log (data.csv, .csv.gz or .parquet, and meta.json beside it) with command columns only: `t` and
/// `q_cmd_<joint>`, and where wanted `dq_cmd_<joint>`, `tau_ff_<joint>`, `kp` and `kd`; gains may also stand in meta.json,
/// and are the model's where neither has them. Joints without a column hold the default pose. The row's command is in
/// force from its `t` to the next row's; rows come at the drive's 200 Hz or a whole fraction of it.
///
/// Every segment, and every episode in it, starts with the robot at rest in its default pose: on its feet, or held 1 m
/// above the ground. Columns `q_*`, `dq_*`, `pos_*`, `quat_*`, `vel_*` and `gyro_*`, where the motion has them, say
/// otherwise by their first row.
///
/// The log has `q_*` and `dq_*` sampled at `t`, `tau_measured_*` as the mean from `t` to the next row (none in a part's
/// last), the commands, and with a floating base `pos_*`, `quat_*`, `vel_*`, `gyro_*` and `foot_force_*`.
///
/// Example: `twinstep play stance.csv --engine batch --physics-hz 1000 --out stance_played.parquet`
#[derive(clap::Args)]
pub struct Args {
    /// The motion: a data file, or a folder that holds one.
    motion: PathBuf,
    /// Model file of the robot; the ideal Go2 without.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Whether the trunk moves: floating or fixed; as meta.json says of each segment without.
    #[arg(long, value_parser = base)]
    base: Option<Base>,
    /// Who integrates the equations of motion: rapier (the reference) or batch (the fast one); the server's default
    /// without.
    #[arg(long, value_parser = engine)]
    engine: Option<Engine>,
    /// Rate of the physics [Hz]; a multiple of the drive's 200. Without: rapier 200, batch 1000.
    #[arg(long, value_name = "HZ")]
    physics_hz: Option<u32>,
    /// Solver iterations a physics step. Without: rapier 2, batch 4.
    #[arg(long, value_name = "N")]
    solver_iterations: Option<u32>,
    /// The log to write: *.parquet, *.csv or *.csv.gz, or a folder, which gets data.parquet and meta.json.
    #[arg(long, value_name = "LOG")]
    out: PathBuf,
}

/// The log would replace the motion.
#[derive(Debug, thiserror::Error)]
#[error("`--out` = {} is the motion itself\n  name another file or folder", .0.display())]
struct SameFile(PathBuf);

/// Plays and writes.
pub fn run(args: &Args) -> Outcome {
    if args.motion.canonicalize().is_ok_and(|motion| args.out.canonicalize().is_ok_and(|out| out == motion)) {
        return Err(input(SameFile(args.out.clone())));
    }
    let robot = robot_model(args.model.as_deref())?;
    let config = args.config();
    config.check(&robot.control).map_err(input)?;
    let motion = Log::open_motion(&args.motion).map_err(input)?;
    let signals = Signals::listen()?;
    let bar = ProgressBar::new(motion.rows() as u64);
    let log = play(&motion, &robot, config, args.base, &mut |row| {
        bar.set_position(row as u64);
        if signals.check()? { Err(Failure::Interrupted) } else { Ok(()) }
    })?;
    bar.finish_and_clear();
    log.write(&args.out).map_err(input)
}

impl Args {
    fn config(&self) -> SimConfig {
        let default = SimConfig { threads: 1, ..SimConfig::default() };
        SimConfig {
            engine: self.engine.unwrap_or(default.engine),
            physics_hz: self.physics_hz,
            solver_iterations: self.solver_iterations,
            ..default
        }
    }
}

fn base(text: &str) -> Result<Base, String> {
    match text {
        "floating" => Ok(Base::Floating),
        "fixed" => Ok(Base::Fixed),
        _ => Err("the base is floating or fixed".to_owned()),
    }
}

/// What the robot does when it is commanded as `motion` has it; `base` goes before that of the segments.
///
/// `progress` receives the number of rows done, and may end it.
fn play(
    motion: &Log,
    robot: &RobotModel,
    config: SimConfig,
    base: Option<Base>,
    progress: &mut dyn FnMut(usize) -> Outcome,
) -> Result<Log, Failure> {
    let player = Player {
        motion,
        robot,
        joints: joint_commands(motion).map_err(input)?,
        clock: DriveClock::of(motion, robot).map_err(input)?,
    };
    let base_of = |segment: &Segment| base.unwrap_or(simulated(segment.base));
    let mut record = Record::default();
    for (segment, rows) in motion.segments() {
        let config = SimConfig { base: base_of(segment), ..config };
        match config.engine {
            Engine::Rapier => {
                let backend = RapierBackend::new(robot.clone(), config, 1).map_err(input)?;
                player.part(backend, &segment.name, config.base, rows, &mut record, progress)?;
            }
            Engine::Batch => {
                let backend = BatchBackend::new(robot.clone(), config, 1).map_err(input)?;
                player.part(backend, &segment.name, config.base, rows, &mut record, progress)?;
            }
        }
    }
    let segments = &motion.meta().segments;
    let segments: Vec<_> =
        segments.iter().map(|segment| Segment { base: logged(base_of(segment)), ..segment.clone() }).collect();
    player.log(record, segments, config).map_err(other)
}

fn simulated(base: LoggedBase) -> Base {
    match base {
        LoggedBase::Fixed => Base::Fixed,
        LoggedBase::Floating => Base::Floating,
    }
}

fn logged(base: Base) -> LoggedBase {
    match base {
        Base::Fixed => LoggedBase::Fixed,
        Base::Floating => LoggedBase::Floating,
    }
}

/// What the robot did, with one entry a row.
#[derive(Default)]
struct Record {
    /// As [`sensor_names`].
    sensors: Vec<Vec<f64>>,
    /// Mean torque of each joint from the row to the next [N·m].
    tau_measured: Vec<Vec<f64>>,
}

/// Channels of [`sensors`] that every log has; the rest is of the moving trunk.
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

/// The sensors of one row; no force is known before the first step.
fn sensors(states: &RobotStates, stepped: bool) -> Vec<f64> {
    let foot_force = if stepped { states.foot_force[0] } else { [f32::NAN; 4] };
    let channels: [&[f32]; 7] = [
        &states.q[0],
        &states.dq[0],
        &states.base_position[0],
        &states.base_orientation[0],
        &states.base_linear_velocity[0],
        &states.base_angular_velocity[0],
        &foot_force,
    ];
    channels.into_iter().flatten().copied().map(f64::from).collect()
}

/// A motion and the robot that it is for.
struct Player<'a> {
    motion: &'a Log,
    robot: &'a RobotModel,
    joints: Vec<JointCommands<'a>>,
    clock: DriveClock,
}

impl Player<'_> {
    /// Plays rows that follow one another.
    fn part<B: Backend>(
        &self,
        mut backend: B,
        segment: &str,
        base: Base,
        rows: Range<usize>,
        record: &mut Record,
        progress: &mut dyn FnMut(usize) -> Outcome,
    ) -> Outcome {
        let t = &self.motion.t()[rows.clone()];
        let failed = |row: usize| {
            let (segment, t) = (segment.to_owned(), t[row - rows.start]);
            move |cause| other(FailedAt { segment, row: row + 1, t, cause })
        };
        backend.reset(&[(0, self.placement(&backend.ground(), base, rows.start))]).map_err(failed(rows.start))?;
        for row in rows.clone() {
            record.sensors.push(sensors(backend.states(), row > rows.start));
            let mut sums = [0.0; JOINT_NAMES.len()];
            let periods = if row + 1 < rows.end { self.clock.periods_between(t, row - rows.start) } else { 0 };
            let command = command(self.robot, &self.joints, row);
            for _ in 0..periods {
                backend.step(&[command], &[true], 1).map_err(failed(row))?;
                for (sum, torque) in sums.iter_mut().zip(backend.states().tau[0]) {
                    *sum += f64::from(torque);
                }
            }
            // Of no period the mean is not a number: the part's last row has no torque.
            record.tau_measured.push(sums.map(|sum| sum / periods as f64).to_vec());
            progress(row + 1)?;
        }
        Ok(())
    }

    /// Where the robot starts: the default pose, but for what the motion measured in `row`.
    fn placement(&self, ground: &Ground, base: Base, row: usize) -> Placement {
        let cell =
            |name: &str| self.motion.channel(name).map(|cells| cells[row] as f32).filter(|cell| cell.is_finite());
        let mut q = self.robot.control.default_pose_f32();
        let mut dq = [0.0; JOINT_NAMES.len()];
        for (index, name) in JOINT_NAMES.iter().enumerate() {
            q[index] = cell(&format!("q_{name}")).unwrap_or(q[index]);
            dq[index] = cell(&format!("dq_{name}")).unwrap_or(0.0);
        }
        let start = match base {
            Base::Floating => Placement::above(ground, self.robot, q, 0.0),
            Base::Fixed => Placement::at_rest(HELD_HEIGHT as f32, q),
        };
        let vector = |quantity: &str| {
            let [x, y, z] = ["x", "y", "z"].map(|axis| cell(&format!("{quantity}_{axis}")));
            Some([x?, y?, z?])
        };
        let orientation = || {
            let [w, x, y, z] = ["w", "x", "y", "z"].map(|part| cell(&format!("quat_{part}")));
            Some([w?, x?, y?, z?])
        };
        Placement {
            base_position: vector("pos").unwrap_or(start.base_position),
            base_orientation: orientation().unwrap_or(start.base_orientation),
            base_linear_velocity: vector("vel").unwrap_or(start.base_linear_velocity),
            base_angular_velocity: vector("gyro").unwrap_or(start.base_angular_velocity),
            dq,
            ..start
        }
    }

    fn log(&self, record: Record, segments: Vec<Segment>, config: SimConfig) -> Result<Log, twinstep_logs::LogError> {
        let motion = self.motion;
        let floating = segments.iter().any(|segment| segment.base == LoggedBase::Floating);
        let index = |cells: &[u32]| cells.iter().map(|cell| f64::from(*cell)).collect();
        let mut columns = vec![
            ("t".to_owned(), motion.t().to_vec()),
            ("segment".to_owned(), index(motion.segment())),
            ("episode".to_owned(), index(motion.episode())),
        ];
        let channel = |rows: &[Vec<f64>], channel: usize| rows.iter().map(|row| row[channel]).collect();
        let names = sensor_names();
        let kept = if floating { names.len() } else { JOINT_CHANNELS };
        for (place, name) in names.into_iter().take(kept).enumerate() {
            columns.push((name, channel(&record.sensors, place)));
        }
        for (joint, name) in JOINT_NAMES.iter().enumerate() {
            columns.push((format!("tau_measured_{name}"), channel(&record.tau_measured, joint)));
        }
        let mut meta = Meta {
            policy_hz: motion.meta().policy_hz,
            joints: JOINT_NAMES.map(str::to_owned).to_vec(),
            pd: Some(format!("PD at {} Hz, held, clipped to the torque limit", self.robot.control.drive_hz)),
            source: Some(source(self.robot, config)),
            // The ideal drive's torque, before rotor and friction.
            ..Meta::new(motion.meta().rate_hz, TauSensor::Current, segments)
        };
        self.commands(&mut meta, &mut columns);
        Log::new(meta, columns)
    }

    /// The commands as they were given, of all twelve joints; gains that never change go to the description.
    fn commands(&self, meta: &mut Meta, columns: &mut Vec<(String, Vec<f64>)>) {
        let (rows, control) = (self.motion.rows(), &self.robot.control);
        let [mut kp, mut kd] = [Vec::new(), Vec::new()];
        for joint in Joint::ALL {
            let name = joint.name();
            let given = self.joints.iter().find(|commands| commands.joint == joint);
            let held = || vec![control.default_pose[joint.index()]; rows];
            columns.push((format!("q_cmd_{name}"), given.map_or_else(held, |given| given.q_cmd.to_vec())));
            let optional =
                [("dq_cmd", given.and_then(|given| given.dq_cmd)), ("tau_ff", given.and_then(|given| given.tau_ff))];
            for (quantity, cells) in optional {
                if let Some(cells) = cells {
                    columns.push((format!("{quantity}_{name}"), cells.to_vec()));
                }
            }
            kp.push(given.and_then(|given| given.kp.clone()).unwrap_or_else(|| vec![control.kp; rows]));
            kd.push(given.and_then(|given| given.kd.clone()).unwrap_or_else(|| vec![control.kd; rows]));
        }
        for (quantity, gains, constant) in [("kp", kp, &mut meta.kp), ("kd", kd, &mut meta.kd)] {
            if gains.iter().all(|cells| cells.iter().all(|cell| *cell == cells[0])) {
                let first: Vec<_> = gains.iter().map(|cells| cells[0]).collect();
                let same = first.iter().all(|gain| *gain == first[0]);
                *constant = Some(if same { Gain::Same(first[0]) } else { Gain::PerJoint(first) });
            } else {
                let names = JOINT_NAMES.iter().map(|name| format!("{quantity}_{name}"));
                columns.extend(names.zip(gains));
            }
        }
    }
}

fn source(robot: &RobotModel, config: SimConfig) -> String {
    let (physics_hz, solver_iterations) = (config.physics_hz(), config.solver_iterations());
    let engine = match config.engine {
        Engine::Rapier => "rapier",
        Engine::Batch => "batch",
    };
    format!("twinstep play: `{}` simulated by {engine} at {physics_hz} Hz x {solver_iterations}", robot.name)
}
