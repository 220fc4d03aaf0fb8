//! The sealed robot and its log: another engine, a finer step, slightly other masses, lengths and contact.

use rand::{Rng, RngExt};
use twinstep_effects::apply_effects;
use twinstep_identify::{RecordError, Sensor, apply_sensors, record};
use twinstep_logs::{Log, LogError, TorqueSensor};
use twinstep_model::{BaseMount, Joint, RobotModel, go2};
use twinstep_sim::{Engine, RapierBackend, SimConfig};

use crate::draw::Case;
use crate::motion::{RATE_HZ, motion};
use crate::unmodelled::PerturbedBackend;

/// Rate of the plant's physics [Hz]; the model's is 1000.
const PHYSICS_HZ: u32 = 4000;
/// Errors of masses, relative, and of where the legs are mounted [m]: below what anybody should name.
const MASS_ERROR: f64 = 0.01;
const LENGTH_ERROR: f64 = 0.002;

/// The log of a case; `progress` may end it.
pub fn log_of(case: &Case, progress: &mut dyn FnMut(usize) -> bool) -> Result<Log, RecordError> {
    let robot = perturbed(&mut case.stream("hunt body"));
    let robot = apply_effects(&robot, &case.hidden).expect("drawn so that it is a robot");
    let backend = |base: BaseMount, robot: &RobotModel| {
        let physics_hz = Some(PHYSICS_HZ);
        let config = SimConfig { engine: Engine::Rapier, base, physics_hz, threads: 1, ..SimConfig::default() };
        let backend = RapierBackend::new(robot.clone(), config, 1);
        backend
            .map(|backend| PerturbedBackend::new(backend, case.outside))
            .map_err(|error| RecordError::Backend(error.into()))
    };
    let motion = motion(case.setting, &mut case.stream("hunt motion"));
    // Says nothing of what is hidden.
    let exact = record(&motion, &robot, None, backend, "twinstep hunt".to_owned(), progress)?;
    let random = &mut case.stream("hunt sensors");
    let sensors = sensors(random);
    let shown = torque_sensor(&exact, &robot, case.setting.torque)?;
    Ok(apply_sensors(&shown, &sensors, random.random())?)
}

/// The built-in robot, not quite.
fn perturbed(random: &mut impl Rng) -> RobotModel {
    let mut robot = go2();
    let mut error = |most: f64| random.random_range(-most..most);
    robot.trunk = robot.trunk.scaled(1.0 + error(MASS_ERROR));
    for leg in &mut robot.legs {
        for body in &mut leg.bodies {
            *body = body.scaled(1.0 + error(MASS_ERROR));
        }
        // Where the leg is mounted, and no length beyond: errors of a whole leg would add up to more than 2 mm at its foot,
        // and a foot 2 mm too low turns the standing robot's joints by 10 mrad already.
        let mount = &mut leg.origins[0];
        for length in [&mut mount.x, &mut mount.y, &mut mount.z] {
            *length += error(LENGTH_ERROR);
        }
    }
    robot.contact.friction *= 1.0 + error(0.05);
    robot.contact.time_constant *= 1.0 + error(0.2);
    robot
}

/// Noise and steps.
fn sensors(random: &mut impl Rng) -> Vec<Sensor> {
    let mut sensor = |quantity, [low, high]: [f64; 2], step| {
        let sigma = random.random_range(low..high);
        Sensor { quantity, sigma, resolution: step }
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

/// The torque channels as late as the robot's sensors are, or none of them; a recording has the torque itself.
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
            let late = robot.joints[joint.index()].actuator.sensor_delay * RATE_HZ;
            let parts = log.segments().flat_map(|(_, rows)| delayed(&cells[rows], late));
            columns.push((name.to_owned(), parts.collect()));
        }
    }
    Log::new(meta, columns)
}

/// `cells` of one part `late` rows late; a whole number of rows or not.
fn delayed(cells: &[f64], late: f64) -> Vec<f64> {
    let shown = |row: usize| {
        let place = (row as f64 - late).max(0.0);
        let (before, part) = (place.floor() as usize, place.fract());
        let after = cells[(before + 1).min(cells.len() - 1)];
        if part > 0.0 { cells[before] * (1.0 - part) + after * part } else { cells[before] }
    };
    // The last row has no torque, however late the others are.
    (0..cells.len()).map(|row| if cells[row].is_nan() { f64::NAN } else { shown(row) }).collect()
}

#[cfg(test)]
mod tests {
    use twinstep_effects::{Effect, EffectEntry, Scope};
    use twinstep_identify::evaluate;
    use twinstep_sim::BatchRollout;

    use super::*;
    use crate::draw::{BaseSchedule, CaseKind, LogSetup};

    fn case(place: BaseSchedule, seed: u64, hidden: Vec<EffectEntry>) -> Case {
        let setting = LogSetup { place, torque: true, battery: true, temperature: false };
        Case { seed, number: 0, kind: CaseKind::Healthy, setting, hidden, outside: None }
    }

    #[test]
    fn log_of_a_healthy_robot_is_near_the_nominal_model() {
        for (place, seed) in
            [(BaseSchedule::Fixed, 1), (BaseSchedule::Floating, 2), (BaseSchedule::FixedThenFloating, 3)]
        {
            let folder = tempfile::tempdir().expect("a folder");
            let log = log_of(&case(place, seed, Vec::new()), &mut |_| true).expect("the robot gets through");
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
    fn late_torque_sensor_shows_in_the_torque_alone() {
        let effect = Effect::named("torque_sensor_delay").expect("known");
        let late = EffectEntry::new(effect, Scope::All, vec![0.0125]).expect("allowed");
        let [healthy, late] = [vec![], vec![late]].map(|hidden| {
            let case = case(BaseSchedule::Fixed, 1, hidden);
            log_of(&case, &mut |_| true).expect("the robot gets through")
        });
        assert_eq!(healthy.q("FL_calf"), late.q("FL_calf"));
        let [healthy, late] = [&healthy, &late].map(|log| log.tau_measured("FL_calf").expect("measured"));
        assert_ne!(healthy, late);
    }

    #[test]
    fn late_cells_are_between_their_neighbours() {
        assert_eq!(delayed(&[1.0, 2.0, 4.0, 8.0], 1.5)[1..], [1.0, 1.5, 3.0]);
        assert_eq!(delayed(&[1.0, 2.0], 0.0), [1.0, 2.0]);
    }
}
