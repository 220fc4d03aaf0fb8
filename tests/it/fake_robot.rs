//! The fake Go2 on the batch engine: it stands up under the safety state machine, refuses wrong messages, and its faults
//! do what they say.

use twinstep_model::{BaseMount, Joint, go2};
use twinstep_robot::fake::{FakeConfig, FakeError, FakeFault, FakeRobot, Refused};
use twinstep_robot::{CommandLimits, Fault, OperatorRequest, Reading, SafetyConfig, State};
use twinstep_sim::{BatchBackend, SimConfig};
use twinstep_tests::robot_rig::{Rig, backend, fake_robot, released, robot_at_500_hz};
use twinstep_unitree::{LowCmd, RpcRequest, encode};

fn fault(line: &str) -> FakeFault {
    line.parse().unwrap()
}

/// Returns the fault that follows on a line within a time [s] while the robot stands.
fn fault_after(line: &str, seconds: f64) -> Option<Fault> {
    let mut rig = Rig::in_state(State::Ready);
    rig.inject(line);
    rig.run(seconds);
    rig.output.fault
}

#[test]
fn it_lies_and_stands_up_under_the_safety_state_machine() {
    let mut rig = Rig::default();
    rig.run(1.2);
    assert!(rig.height() < 0.12, "it lies at {} m", rig.height());
    let rig = Rig::in_state(State::Ready);
    assert!((0.28..0.34).contains(&rig.height()), "it stands at {} m", rig.height());
    let statistics = rig.robot.statistics();
    assert_eq!((statistics.refused, statistics.ignored), (0, 0), "{:?}", statistics.first_refused);
    assert!(statistics.accepted > 1700, "{statistics:?}");
    assert!(statistics.largest_gap_ms <= 2 && statistics.largest_excess_rad == 0.0, "{statistics:?}");
    let state = rig.last_state.as_ref().unwrap();
    assert_eq!(state.tick as usize, 2 * rig.num_states);
    assert!((state.imu_state.accelerometer[2] - 9.81).abs() < 0.5, "{:?}", state.imu_state);
    assert!(state.foot_force.iter().all(|counts| *counts > 25), "{:?}", state.foot_force);
    assert!((27.0..29.4).contains(&state.power_v) && state.bms_state.soc == 80, "{}", state.power_v);
}

#[test]
fn it_follows_actions_and_sits_down_without_them() {
    let mut rig = Rig::in_state(State::Ready);
    rig.run_with_actions(1.0);
    assert_eq!(rig.output.state, State::Run);
    rig.run(3.0);
    assert!(matches!(rig.output.fault, Some(Fault::ActionLate { .. })), "{:?}", rig.output.fault);
    assert!(rig.height() < 0.15, "it lies at {} m", rig.height());
}

#[test]
fn backend_of_another_rate_or_size_is_refused_with_what_is_needed() {
    let error = FakeRobot::new(backend(go2(), BaseMount::Floating), released()).err().unwrap();
    assert_eq!(error, FakeError::Rate(200.0));
    assert!(error.to_string().contains("set it to 500"));
    let two = BatchBackend::new(robot_at_500_hz(), SimConfig { threads: 1, ..SimConfig::default() }, 2).unwrap();
    assert_eq!(FakeRobot::new(Box::new(two), released()).err().unwrap(), FakeError::NumRobots(2));
    let config = FakeConfig { ambient_c: f32::NAN, ..released() };
    let error = FakeRobot::new(backend(robot_at_500_hz(), BaseMount::Floating), config).err().unwrap().to_string();
    assert!(error.contains("ambient_c"), "{error}");
}

#[test]
fn wrong_messages_are_refused_by_name() {
    let limits = CommandLimits::new(&go2(), &SafetyConfig::default());
    let good = limits.check(&twinstep_model::Command::hold(go2().control.default_pose_f32(), 0.0, 3.0)).unwrap();
    let good = good.to_low_cmd();
    let mut robot = fake_robot(released());
    robot.receive(&encode(&good)).unwrap();
    let mut refused = |change: fn(&mut LowCmd)| {
        let mut message = good.clone();
        change(&mut message);
        robot.receive(&encode(&message.with_checksum())).unwrap_err().to_string()
    };
    assert!(refused(|message| message.head = [0, 0]).starts_with("`head` is [00, 00]"));
    assert!(refused(|message| message.level_flag = 0xee).starts_with("`level_flag` is 0xee"));
    assert!(refused(|message| message.motor_cmd[0].mode = 10).starts_with("`mode` of FR_hip is 10"));
    assert!(refused(|message| message.motor_cmd[4].kd = f32::NAN).starts_with("`kd` of FL_thigh is NaN"));
    assert!(
        refused(|message| message.motor_cmd[4].kp = 300.0).starts_with("`kp` of FL_thigh is 300, outside 0 to 200")
    );
    assert!(refused(|message| message.motor_cmd[4].tau = -30.0).starts_with("`tau` of FL_thigh is -30"));
    assert!(refused(|message| message.motor_cmd[3].q = 2.0).starts_with("`q` of FL_hip is 2"));
    let damaged = LowCmd { crc: 1, ..good.clone() };
    assert!(matches!(robot.receive(&encode(&damaged)), Err(Refused::Checksum(_))));
    assert!(matches!(robot.receive(&encode(&good)[..100]), Err(Refused::Encoding(_))));
    assert_eq!((robot.statistics().accepted, robot.statistics().refused), (1, 9));
    assert_eq!(robot.statistics().first_refused, Some(Refused::Head { found: [0, 0] }));
    robot.inject(fault("power cut")).unwrap();
    assert_eq!(robot.receive(&encode(&good)), Err(Refused::PowerOff));
}

#[test]
fn messages_above_1_khz_are_refused() {
    let mut robot = fake_robot(released());
    let payload = encode(&LowCmd::stopped().with_checksum());
    for _ in 0..200 {
        robot.step().unwrap();
        robot.receive(&payload).unwrap();
        robot.receive(&payload).unwrap();
    }
    let errors = (0..500).filter(|step| {
        if step % 5 == 0 {
            robot.step().unwrap();
        }
        matches!(robot.receive(&payload), Err(Refused::TooOften { .. }))
    });
    assert!(errors.count() > 200);
}

#[test]
fn last_command_stays_in_force_and_the_gap_is_measured() {
    let mut rig = Rig::in_state(State::Ready);
    let command = rig.output.command.unwrap().to_low_cmd();
    for _ in 0..250 {
        rig.robot.step().unwrap();
    }
    assert!(rig.height() > 0.28, "no watchdog of the motors is documented: it stands on");
    rig.robot.receive(&encode(&command)).unwrap();
    assert_eq!(rig.robot.statistics().largest_gap_ms, 500);
}

#[test]
fn battery_command_switches_the_robot_off() {
    let mut robot = fake_robot(released());
    let mut command = LowCmd::stopped();
    command.bms_cmd.off = 0xa5;
    robot.receive(&encode(&command.with_checksum())).unwrap();
    assert!(!robot.is_powered() && robot.step().unwrap().is_empty());
}

#[test]
fn built_in_controller_stands_until_it_is_released() {
    let mut robot = fake_robot(FakeConfig::default());
    let call = |robot: &mut FakeRobot, service: &str, api_id: i64, parameter: &str| {
        let request = RpcRequest { id: 7, api_id, parameter: parameter.to_owned(), ..RpcRequest::default() };
        let response = robot.answer(service, &request);
        assert_eq!((response.id, response.api_id), (7, api_id));
        (response.code, response.data)
    };
    let height = |robot: &FakeRobot| robot.backend().ground_truth().unwrap().base_position[0][2];
    let run = |robot: &mut FakeRobot| (0..1500).for_each(|_| drop(robot.step().unwrap()));
    assert_eq!(call(&mut robot, "motion_switcher", 1001, "{}"), (0, r#"{"form":"0","name":"mcf"}"#.to_owned()));
    assert_eq!(call(&mut robot, "sport", 1004, "").0, 0);
    run(&mut robot);
    assert!(height(&robot) > 0.28, "{}", height(&robot));
    let sport = robot.sport_state().unwrap();
    assert!((sport.position[2] - height(&robot)).abs() < 1e-6);
    robot.receive(&encode(&LowCmd::stopped().with_checksum())).unwrap();
    run(&mut robot);
    assert!(height(&robot) > 0.28, "commands have no effect");
    assert_eq!(robot.statistics().ignored, 1);
    assert_eq!(call(&mut robot, "sport", 1005, "").0, 0);
    run(&mut robot);
    assert!(height(&robot) < 0.15);
    assert_eq!(call(&mut robot, "motion_switcher", 1003, "").0, 0);
    assert_eq!(call(&mut robot, "motion_switcher", 1001, "{}").1, r#"{"form":"0","name":""}"#);
    assert_eq!(robot.sport_state(), None);
    assert_eq!(call(&mut robot, "motion_switcher", 1002, r#"{"name":"nothing"}"#).0, 3204);
    assert_eq!(call(&mut robot, "motion_switcher", 1002, r#"{"name":"normal"}"#).0, 0);
    assert_eq!(call(&mut robot, "motion_switcher", 1001, "{}").1, r#"{"form":"0","name":"normal"}"#);
    assert_eq!(call(&mut robot, "sport", 1234, "").0, 3203);
    assert_eq!(call(&mut robot, "camera", 1001, "").0, 3203);
}

#[test]
fn each_fault_has_the_reaction_of_the_safety_state_machine() {
    use Fault::*;
    assert!(matches!(fault_after("heat FL_calf 90", 0.1), Some(Temperature { celsius: 89 | 90, .. })));
    assert!(matches!(fault_after("voltage 20", 0.1), Some(Voltage { .. })));
    assert!(matches!(fault_after("remote lost", 1.2), Some(RemoteLost)));
    assert!(matches!(fault_after("remote L2+B", 0.1), Some(RemoteStop)));
    assert!(matches!(fault_after("stale 100", 0.1), Some(StateStale { .. })));
    assert!(matches!(fault_after("fall", 0.3), Some(Tilt { .. })));
    assert!(matches!(fault_after("power cut", 0.1), Some(StateStale { .. })));
    assert!(matches!(fault_after("joint out FL_hip", 0.1), Some(JointLimit { joint, .. }) if joint.name() == "FL_hip"));
    assert!(matches!(fault_after("foreign writer on", 0.1), Some(ForeignWriter { writers: 1 })));
    assert!(matches!(fault_after("messages lost", 0.5), Some(MessagesLost { .. })));
    for harmless in ["loss 0.1", "delay 6", "reorder", "stale 10", "remote stick 0.5 0 0", "remote A"] {
        assert_eq!(fault_after(harmless, 1.0), None, "{harmless}");
    }
}

#[test]
fn low_battery_is_not_armed() {
    let mut rig = Rig::default();
    rig.inject("battery 10");
    rig.run(1.2);
    rig.input.request = Some(OperatorRequest::Arm);
    rig.step();
    let text = rig.output.request_refused.unwrap().to_string();
    assert_eq!(text, "the battery has 10 %, but 20 % are needed: charge it");
}

#[test]
fn cleared_robot_is_healthy_again() {
    let mut rig = Rig::default();
    for line in ["loss 1", "remote lost", "joint out FL_hip", "mistake encoder degrees", "foreign writer on", "clear"] {
        rig.inject(line);
    }
    rig.run(0.1);
    let reading = Reading::new(rig.last_state.as_ref().unwrap()).unwrap();
    assert!(reading.remote.is_some() && !rig.robot.wants_foreign_writer());
    assert!(Joint::ALL.iter().all(|joint| reading.q[joint.index()].abs() < 3.0), "{:?}", reading.q);
}

#[test]
fn power_cut_drops_the_robot() {
    let mut rig = Rig::in_state(State::Ready);
    rig.inject("power cut");
    rig.run(2.0);
    assert!(rig.height() < 0.15, "{}", rig.height());
}
