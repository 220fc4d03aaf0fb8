//! Ground-truth robot of a case and its log.
//!
//! The robot runs in another engine at a smaller time step. It has small errors of mass, leg mounts and contact. In
//! MuJoCo its actuators follow laws that are written without the model's code.

use rand::{Rng, RngExt};
use twinstep_effects::apply_effects;
use twinstep_identify::{RecordError, Sensor, apply_sensors, record};
use twinstep_logs::{Log, LogError, TorqueSensor};
use twinstep_model::{BaseMount, Joint, RobotModel, Simulator, go2};
use twinstep_sim::{BackendBuildError, Engine, MujocoPlant, RapierBackend, SimConfig};

use crate::Plant;
use crate::draw::Case;
use crate::mismatch::columns;
use crate::motion::{RATE_HZ, motion};
use crate::unmodelled::PerturbedBackend;

/// Physics rate of the ground truth [Hz]; that of the model is 1000.
const PHYSICS_HZ: u32 = 4000;
/// Maximum relative error of the masses, too small to be reported as a cause.
const MASS_ERROR: f64 = 0.01;
/// Maximum error of the leg mounting positions [m], too small to be reported as a cause.
const LENGTH_ERROR: f64 = 0.002;

/// One of the two logs of a case's robot: the same phases with other random motions, gains and noise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Take {
    /// The log that is diagnosed.
    First,
    /// A log for the corrected model.
    Second,
}

/// Simulates a log of a case on `plant`. `progress` receives the number of completed rows and returns false to
/// interrupt.
pub fn log_of(
    case: &Case,
    plant: Plant,
    take: Take,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Log, RecordError> {
    let mut robot = perturbed(&mut case.stream("hunt body"));
    let errors = &mut case.stream("hunt mismatch");
    if let Some(mismatch) = case.mismatch {
        mismatch.change_robot(&mut robot, errors);
    }
    let stand = case.mismatch.and_then(|mismatch| mismatch.stand(errors));
    let robot = apply_effects(&robot, &case.hidden).expect("cases are sampled as valid robots");
    let of_motion = if take == Take::First { "hunt motion" } else { "hunt second motion" };
    let motion = motion(case.setting, &mut case.stream(of_motion));
    // The source of the log does not reveal the hidden effects.
    let exact = match plant {
        Plant::Rapier => played(&motion, &robot, progress, |base, robot| {
            let physics_hz = Some(PHYSICS_HZ);
            let config = SimConfig { engine: Engine::Rapier, base, physics_hz, threads: 1, ..SimConfig::default() };
            Ok(PerturbedBackend::new(RapierBackend::new(robot.clone(), config, 1)?, case.outside))
        }),
        Plant::Mujoco => played(&motion, &robot, progress, |base, robot| {
            let config = SimConfig { base, threads: 1, ..SimConfig::default() };
            Ok(PerturbedBackend::new(MujocoPlant::on_stand(robot.clone(), config, 1, stand)?, case.outside))
        }),
    }?;
    let random = &mut case.stream("hunt sensors");
    let sensors = sensors(random);
    let delayed = torque_sensor(&exact, &robot, case.setting.torque)?;
    let seeds: [u64; 2] = [random.random(), random.random()];
    let noisy = apply_sensors(&delayed, &sensors, seeds[take as usize])?;
    let noisy = if case.setting.motion_capture { noisy } else { without_motion_capture(&noisy)? };
    Ok(case.mismatch.map_or(Ok(noisy.clone()), |mismatch| mismatch.change_log(noisy, errors))?)
}

/// Returns the log of `motion` on `robot`, without noise.
fn played<S: Simulator>(
    motion: &Log,
    robot: &RobotModel,
    progress: &mut dyn FnMut(usize) -> bool,
    backend: impl Fn(BaseMount, &RobotModel) -> Result<S, BackendBuildError>,
) -> Result<Log, RecordError> {
    let backend = |base, robot: &RobotModel| backend(base, robot).map_err(|error| RecordError::Backend(error.into()));
    record(motion, robot, None, backend, "twinstep hunt".to_owned(), progress)
}

/// Returns the built-in robot with small random errors.
fn perturbed(random: &mut impl Rng) -> RobotModel {
    let mut robot = go2();
    let mut error = |max: f64| random.random_range(-max..max);
    robot.trunk = robot.trunk.scaled(1.0 + error(MASS_ERROR));
    for leg in &mut robot.legs {
        for body in &mut leg.bodies {
            *body = body.scaled(1.0 + error(MASS_ERROR));
        }
        // Only the mounting position has an error. Errors of all lengths of a leg would add up to more than 2 mm at its
        // foot, and a foot that is 2 mm too low changes the joint angles of the standing robot by 10 mrad.
        let mount = &mut leg.origins[0];
        for length in [&mut mount.x, &mut mount.y, &mut mount.z] {
            *length += error(LENGTH_ERROR);
        }
    }
    robot.contact.friction *= 1.0 + error(0.05);
    robot.contact.time_constant *= 1.0 + error(0.2);
    robot
}

/// Samples noise and resolution of the sensors.
fn sensors(random: &mut impl Rng) -> Vec<Sensor> {
    let mut sensor = |quantity, [low, high]: [f64; 2], resolution| {
        let sigma = random.random_range(low..high);
        Sensor { quantity, sigma, resolution }
    };
    vec![
        sensor("q", [0.0005, 0.002], 0.0002),
        sensor("dq", [0.02, 0.1], 0.01),
        sensor("tau_measured", [0.05, 0.3], 0.05),
        sensor("pos", [0.001, 0.003], 0.0),
        sensor("quat", [0.002, 0.005], 0.0),
        sensor("vel", [0.02, 0.05], 0.0),
        sensor("gyro", [0.01, 0.03], 0.001),
        sensor("foot_force", [1.0, 3.0], 1.0),
    ]
}

/// Delays the torque channels by the delay of the robot's sensors, or removes them if torque is not measured.
fn torque_sensor(log: &Log, robot: &RobotModel, measured: bool) -> Result<Log, LogError> {
    let mut meta = log.meta().clone();
    if !measured {
        meta.tau_sensor = TorqueSensor::None;
    }
    let index = |cells: &[u32]| cells.iter().map(|cell| f64::from(*cell)).collect();
    let mut columns = vec![
        ("t".to_owned(), log.t().to_vec()),
        ("segment".to_owned(), index(log.segment())),
        ("episode".to_owned(), index(log.episode())),
    ];
    for (name, cells) in log.channels() {
        let Some(joint) = name.strip_prefix("tau_measured_") else {
            columns.push((name.to_owned(), cells.to_vec()));
            continue;
        };
        if measured {
            let joint: Joint = joint.parse().expect("one of the twelve");
            let delay = robot.joints[joint.index()].actuator.sensor_delay * RATE_HZ;
            let parts = log.segments().flat_map(|(_, rows)| delayed(&cells[rows], delay));
            columns.push((name.to_owned(), parts.collect()));
        }
    }
    Log::new(meta, columns)
}

/// Removes position and velocity of the base.
fn without_motion_capture(log: &Log) -> Result<Log, LogError> {
    let of_base = |name: &str| name.starts_with("pos_") || name.starts_with("vel_");
    let mut columns = columns(log);
    columns.retain(|(name, _)| !of_base(name));
    let mut meta = log.meta().clone();
    meta.noise.retain(|name, _| !of_base(name) && name != "pos" && name != "vel");
    Log::new(meta, columns)
}

/// Returns `cells` of one contiguous range with a delay of `delay` rows, interpolated linearly.
fn delayed(cells: &[f64], delay: f64) -> Vec<f64> {
    let value = |row: usize| {
        let position = (row as f64 - delay).max(0.0);
        let (before, part) = (position.floor() as usize, position.fract());
        let after = cells[(before + 1).min(cells.len() - 1)];
        if part > 0.0 { cells[before] * (1.0 - part) + after * part } else { cells[before] }
    };
    // Rows without torque, such as the last one, stay without it.
    (0..cells.len()).map(|row| if cells[row].is_nan() { f64::NAN } else { value(row) }).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::LazyLock;

    use twinstep_effects::{Effect, EffectEntry, Scope};
    use twinstep_identify::evaluate;
    use twinstep_sim::BatchRollout;

    use super::*;
    use crate::base_schedule::BaseSchedule;
    use crate::draw::CaseKind;
    use crate::log_setup::LogSetup;

    /// Log of a healthy robot that hangs. A simulation takes seconds.
    static HANGING: LazyLock<Log> = LazyLock::new(|| recorded(&case(BaseSchedule::Fixed, 1, Vec::new()), Take::First));

    fn recorded(case: &Case, take: Take) -> Log {
        log_of(case, Plant::Rapier, take, &mut |_| true).expect("the simulation succeeds")
    }

    fn case(place: BaseSchedule, seed: u64, hidden: Vec<EffectEntry>) -> Case {
        let setting = LogSetup { battery: true, ..LogSetup::with_torque(place) };
        Case { seed, number: 0, kind: CaseKind::Healthy, setting, hidden, outside: None, mismatch: None }
    }

    #[test]
    fn log_of_a_healthy_robot_is_near_the_nominal_model() {
        let of = |place, seed| recorded(&case(place, seed, Vec::new()), Take::First);
        for (place, log) in [
            (BaseSchedule::Fixed, HANGING.clone()),
            (BaseSchedule::Floating, of(BaseSchedule::Floating, 2)),
            (BaseSchedule::FixedThenFloating, of(BaseSchedule::FixedThenFloating, 3)),
        ] {
            let folder = tempfile::tempdir().expect("a folder");
            log.write(folder.path()).expect("written");
            let log = Log::open(folder.path()).expect("a log");
            for channel in ["dq_RR_calf", "tau_measured_FL_hip", "battery_V", "kp"] {
                assert!(
                    log.channel(channel).is_some() || channel == "kp" && log.kp("FL_hip", 0).is_some(),
                    "{channel}"
                );
            }
            assert!(log.channel("temp_FL_hip").is_none());
            assert!(log.noise("q_FL_hip").is_some_and(|sigma| (0.0005..0.0021).contains(&sigma)));
            assert_eq!(log.channel("gyro_x").is_some(), place != BaseSchedule::Fixed);
            let mut simulator = BatchRollout::new(&go2(), &SimConfig::default()).expect("a simulator");
            let error = evaluate(&log, &go2(), &mut simulator, |_| true).expect("evaluated");
            let worst =
                error.per_joint.iter().max_by(|a, b| a.1.q_rmse_rad.partial_cmp(&b.1.q_rmse_rad).expect("numbers"));
            println!("{place:?}: q {:?} rad, torque {:?} N·m, worst {worst:?}", error.q_rmse_rad, error.torque_rmse_nm);
            assert!(error.q_rmse_rad.is_some_and(|error| error < 0.02));
        }
    }

    #[test]
    fn delay_of_the_torque_sensor_changes_only_the_torque() {
        let effect = Effect::named("torque_sensor_delay").expect("known");
        let delay = EffectEntry::new(effect, Scope::All, vec![0.0125]).expect("allowed");
        let healthy = &*HANGING;
        let delayed = recorded(&case(BaseSchedule::Fixed, 1, vec![delay]), Take::First);
        assert_eq!(healthy.q("FL_calf"), delayed.q("FL_calf"));
        let [healthy, delayed] = [healthy, &delayed].map(|log| log.tau_measured("FL_calf").expect("measured"));
        assert_ne!(healthy, delayed);
    }

    #[test]
    fn second_log_of_a_robot_has_the_same_channels_and_noise_and_another_motion() {
        let first = &*HANGING;
        let second = recorded(&case(BaseSchedule::Fixed, 1, Vec::new()), Take::Second);
        assert_eq!(first.meta().noise, second.meta().noise);
        assert_eq!(first.rows(), second.rows());
        assert_ne!(first.q_cmd("FL_hip"), second.q_cmd("FL_hip"));
        let error = |log: &Log| {
            let mut simulator = BatchRollout::new(&go2(), &SimConfig::default()).expect("a simulator");
            evaluate(log, &go2(), &mut simulator, |_| true).expect("evaluated").q_rmse_rad.expect("measured")
        };
        assert!((error(&second) / error(first) - 1.0).abs() < 0.5, "the same robot");
    }

    #[test]
    fn delayed_cells_are_interpolated() {
        assert_eq!(delayed(&[1.0, 2.0, 4.0, 8.0], 1.5)[1..], [1.0, 1.5, 3.0]);
        assert_eq!(delayed(&[1.0, 2.0], 0.0), [1.0, 2.0]);
    }
}
