//! Properties of the equations of a robot that hangs and whose log has positions alone.

use std::collections::BTreeMap;

use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, go2};

use super::law::{Law, Place, laws};
use super::motion_residuals::MotionResiduals;
use super::residuals::Residuals;
use super::robot::Robot;
use super::site::{Site, apply};

/// Returns a log of 4 s of sines, without velocities and torques.
fn log() -> Log {
    let mut columns = BTreeMap::<String, Vec<f64>>::new();
    let mut push = |name: String, value: f64| columns.entry(name).or_default().push(value);
    for row in 0..800 {
        let t = 0.005 * row as f64;
        push("t".to_owned(), t);
        for (joint, name) in JOINT_NAMES.iter().enumerate() {
            let rate = 4.0 + joint as f64;
            let pose = go2().control.default_pose[joint];
            push(format!("q_{name}"), pose + 0.3 * (rate * t).sin());
            push(format!("q_cmd_{name}"), pose + 0.35 * (rate * (t + 0.01)).sin());
        }
    }
    let air = Segment { name: "air".to_owned(), base: BaseMount::Fixed };
    let mut meta = Meta::new(200.0, TorqueSensor::None, vec![air]);
    (meta.kp, meta.kd) = (Some(Gain::Uniform(30.0)), Some(Gain::Uniform(0.8)));
    Log::new(meta, columns).expect("a log")
}

/// Returns a change of a law whose column shows it.
fn small(law: &Law, unknown: usize) -> Vec<f64> {
    let mut unknowns = vec![0.0; law.units.len()];
    unknowns[unknown] = 0.04 * law.units[unknown];
    unknowns
}

#[test]
fn column_of_every_law_is_nearly_what_a_small_effect_takes_from_the_residuals() {
    let mut robot = Robot::from(&go2());
    // A joint that sticks does not answer in proportion.
    robot.joints.iter_mut().for_each(|joint| joint.coulomb_friction = 0.0);
    for actuator_hz in [200.0, 1000.0] {
        let residuals = MotionResiduals::new(&log(), &robot, |_| true, actuator_hz).expect("a fixed base");
        let predicted = residuals.predicted(&robot);
        let before = residuals.residuals(&robot, &predicted);
        for law in laws() {
            // The simulation has no heat, and other frictions depend on a speed or a torque that is not small.
            let is_other = ["thermal_derating", "stribeck_friction", "load_friction"].contains(&law.effect.name);
            if is_other || !matches!(law.place, Place::Drive | Place::Joint) {
                continue;
            }
            for unknown in 0..law.units.len() {
                let mut after = robot.clone();
                let site = Site::Joint(4);
                apply(&mut after, &law, site, &small(&law, unknown), law.shapes[0]);
                let column = residuals.column(&law, site, (&robot, &predicted), &after);
                let changed = residuals.residuals(&after, &residuals.predicted(&after));
                let (mut error, mut size) = (0.0, 0.0);
                for (block, rows) in &column.parts {
                    for (row, entry) in rows.iter().enumerate() {
                        let change = before[*block].y[row] - changed[*block].y[row];
                        error += (change - entry).powi(2);
                        size += change.powi(2);
                    }
                }
                let relative = (error / f64::max(size, 1e-12)).sqrt();
                let case = format!("{} {unknown} at {actuator_hz} Hz", law.effect.name);
                println!("{case}: {relative:.3} of {:.1e} rad", size.sqrt());
                assert!(relative < 0.1 || size.sqrt() < 1e-4, "{case}: {relative}");
            }
        }
    }
}
