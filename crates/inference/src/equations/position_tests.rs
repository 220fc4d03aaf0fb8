//! Causes that are found in positions alone, on a robot whose base is fixed.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, CONTACT, RobotModel, TreeModel, go2};

use super::explain::explain;
use super::explanation::Explained;
use super::robot::Robot;
use crate::{Candidate, JointLog, WindowLength, simulate, windows};

/// Returns a log of positions and commands: sines of 8 s, as a robot follows them.
fn log(robot: &RobotModel) -> Log {
    let columns = |positions: &dyn Fn(usize, usize) -> f64| {
        let mut columns = BTreeMap::<String, Vec<f64>>::new();
        for row in 0..1600 {
            let t = 0.005 * row as f64;
            columns.entry("t".to_owned()).or_default().push(t);
            for (joint, name) in Robot::from(&go2()).tree.joints.iter().map(|joint| &joint.name).enumerate() {
                let rate = 3.0 + 0.7 * joint as f64 + 0.4 * t;
                let command = go2().control.default_pose[joint] + 0.3 * (rate * t).sin();
                columns.entry(format!("q_cmd_{name}")).or_default().push(command);
                columns.entry(format!("q_{name}")).or_default().push(positions(row, joint));
            }
        }
        columns
    };
    let air = Segment { name: "air".to_owned(), base: BaseMount::Fixed };
    let mut meta = Meta::new(200.0, TorqueSensor::None, vec![air]);
    (meta.kp, meta.kd) = (Some(Gain::Uniform(30.0)), Some(Gain::Uniform(0.8)));
    let commands = Log::new(meta.clone(), columns(&|_, joint| go2().control.default_pose[joint])).expect("a log");
    let of = Robot::from(robot);
    let tree = TreeModel { tree: of.tree, joints: of.joints, points: Vec::new(), contact: CONTACT };
    let joint_log = JointLog::new(&commands, &tree.tree, |_| true).expect("a fixed base");
    let zeros = vec![0.0; tree.joints.len()];
    let windows = windows(&joint_log, &tree.tree, WindowLength::WholeRanges);
    let candidate = Candidate { robot: tree, kp: zeros.clone(), kd: zeros };
    let hz = robot.control.actuator_hz;
    let trace = simulate(&joint_log, &windows, &[candidate], hz, &AtomicBool::new(false)).expect("a robot").remove(0);
    Log::new(meta, columns(&|row, joint| trace[0].q[joint][row])).expect("a log")
}

fn explained(robot: &RobotModel) -> Explained {
    explain(&log(robot), &go2(), &std::sync::Arc::default(), |_| true, &mut |_| true)
        .expect("a fixed base")
        .expect("not interrupted")
}

#[test]
fn friction_of_one_joint_is_named_with_its_size_and_a_robot_like_its_model_lacks_nothing() {
    let found = explained(&go2());
    let names = |found: &Explained| -> Vec<String> {
        found.causes.iter().map(|cause| format!("{}@{}", cause.effect.name, cause.scope)).collect()
    };
    assert_eq!(names(&found), Vec::<String>::new());
    let mut robot = go2();
    robot.joints[5].coulomb_friction += 0.6;
    let found = explained(&robot);
    assert_eq!(names(&found), ["coulomb_friction@FR_calf"], "{:#?}", found.decisions);
    let cause = &found.causes[0];
    assert!((cause.values[0] - 0.6).abs() < 0.1, "{}", cause.values[0]);
    assert!(found.is_of_positions);
}
