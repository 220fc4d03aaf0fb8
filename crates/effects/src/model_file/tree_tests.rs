//! Model files of robots of any tree.

use toml::Value;

use super::*;

const ARM: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/robots/so101.xml");

fn read(more: &str) -> Result<TreeModelFile, ModelFileError> {
    TreeModelFile::parse(&format!("robot = {}\n{more}", Value::from(ARM)), "arm.toml")
}

fn refusal(more: &str) -> String {
    read(more).expect_err("refused").to_string()
}

#[test]
fn effect_of_one_joint_adds_to_that_of_all_and_to_the_robot_file() {
    let effect = |scope: &str, torque: f64| {
        format!("[[effect]]\nname = \"coulomb_friction\"\nscope = \"{scope}\"\ntorque_nm = {torque}\n")
    };
    let file = read(&(effect("elbow_flex", 0.2) + &effect("all", 0.1))).expect("valid");
    let robot = file.tree_model().expect("possible");
    let friction: Vec<f64> = robot.joints.iter().map(|joint| joint.coulomb_friction).collect();
    assert!((friction[1] - 0.152).abs() < 1e-12 && (friction[2] - 0.352).abs() < 1e-12, "{friction:?}");
    // The robot file has 0.052 N·m, of which an effect may take away.
    read(&effect("all", -0.05)).expect("valid");
    let error = refusal(&effect("all", -0.06));
    assert!(error.contains("a negative Coulomb friction of joint `shoulder_pan`"), "{error}");
}

#[test]
fn file_is_read_back_as_it_was_written() {
    let file = read(
        "[control]\nactuator_hz = 500\npolicy_hz = 50\naction_scale = 0.3\nkd = 1.5\n[control.default_pose]\nElbow = 0.5\n[control.kp]\nElbow = 20.0\n\
         [joints.rename]\nelbow_flex = \"Elbow\"\n\
         [[effect]]\nname = \"pd_gain\"\nscope = \"Elbow\"\nkp_scale = 1.5\nkd_scale = 1.0\n\
         interval = { kp_scale = [1.2, 1.8] }\n",
    )
    .expect("valid");
    assert_eq!(file.kp.as_ref().map(|kp| [kp.of("Elbow"), kp.of("gripper")]), Some([Some(20.0), None]));
    assert_eq!(file.pose(), [0.0, 0.0, 0.5, 0.0, 0.0, 0.0]);
    assert_eq!(TreeModelFile::parse(&file.to_toml(), "again").expect("valid"), file, "{}", file.to_toml());
    let plain = read("").expect("valid");
    assert_eq!(TreeModelFile::parse(&plain.to_toml(), "again").expect("valid"), plain);
}

#[test]
fn model_file_of_a_quadruped_is_that_of_a_tree_too() {
    for name in ["go1", "a1", "b2", "aliengo", "spot"] {
        let path = format!("{}/../../data/robots/{name}.toml", env!("CARGO_MANIFEST_DIR"));
        let file = TreeModelFile::load(&path).unwrap_or_else(|error| panic!("{error}"));
        let knee = file.nominal.tree.joints.iter().position(|joint| joint.name.starts_with("RR_calf")).expect("a knee");
        assert!(file.pose()[knee] < -1.0 && file.kp.is_some(), "{name}: {:?}", file.pose());
    }
}

#[test]
fn refusals_name_what_is_wrong_and_what_is_possible() {
    let joints = "shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper";
    let error = refusal("[joints.rename]\nelbow = \"Elbow\"\n");
    assert_eq!(error, format!("arm.toml: `joints.rename`: the robot has no joint `elbow`; its joints are {joints}"));
    let error = refusal("[joints.rename]\nelbow_flex = \"gripper\"\n");
    assert!(error.contains("two joints are named `gripper`"), "{error}");
    let error = refusal("[control]\nkp = -1\n");
    assert!(error.contains("`control.kp` is -1; finite and not negative expected"), "{error}");
    let error = refusal("[control.kd]\nelbow = 1\n");
    assert!(error.contains("`control.kd`: the robot has no joint `elbow`"), "{error}");
    let error = refusal("[control]\nactuator_hz = 5\n");
    assert!(error.contains("`control.actuator_hz` is 5; 20 to 2000 Hz expected"), "{error}");
    let error = refusal("[control.default_pose]\nelbow_flex = 3\n");
    assert!(error.contains("`control.default_pose.elbow_flex` is 3; -1.69 to 1.69 expected"), "{error}");
    let error = refusal("[groups]\nfoot = [\"toe\"]\n");
    assert!(error.contains("`groups.foot`: the robot has no link `toe`; its links are base"), "{error}");
    let error = refusal("[groups]\nhip = [\"gripper\", \"gripper\"]\n");
    assert!(error.contains("`groups.hip`: `gripper` is there twice"), "{error}");
    let error = refusal("[groups]\nhip = [\"toe\"]\n");
    assert!(error.contains("`groups.hip`: the robot has no joint `toe`; its joints are"), "{error}");
    let error = refusal("[[effect]]\nname = \"payload\"\nscope = \"base\"\nmass_kg = 1\nposition_m = [0, 0, 0]\n");
    assert!(error.contains("an effect of joints, because the robot is not like the Go2"), "{error}");
    let error = refusal("[[effect]]\nname = \"backlash\"\nscope = \"all\"\ngap_rad = nan\n");
    assert!(error.contains("`gap_rad` is nan; expected a finite number"), "{error}");
    let error = refusal("[[effect]]\nname = \"backlash\"\nscope = \"calf\"\ngap_rad = 0.1\n");
    assert!(error.contains("`scope` is \"calf\"; expected all, or a joint"), "{error}");
}
