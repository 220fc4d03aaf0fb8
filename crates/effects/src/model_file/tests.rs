//! Model files, read and written.

use expect_test::{Expect, expect};
use proptest::prelude::*;

use super::*;
use crate::{CATALOGUE, Scope, Target};
use twinstep_model::go2;

fn check_refusal(text: &str, message: &Expect) {
    let error = parse_robot(text, "robot.toml").expect_err("refused");
    message.assert_eq(&error.to_string());
}

#[test]
fn built_in_robot_is_read_from_one_line() {
    assert_eq!(parse_robot("robot = \"go2\"", "robot.toml").expect("valid"), go2());
}

#[test]
fn misspelt_key_is_named_with_its_line_and_the_possible_keys() {
    check_refusal(
        "# my robot\nrobto = \"go2\"\n",
        &expect![[r#"
            robot.toml: TOML parse error at line 2, column 1
              |
            2 | robto = "go2"
              | ^^^^^
            unknown field `robto`, expected one of `robot`, `control`, `joints`, `effect`, `actuator`
        "#]],
    );
}

#[test]
fn error_for_an_unknown_robot_lists_the_known_ones() {
    check_refusal(
        "robot = \"spot\"",
        &expect![[
            r#"robot.toml: `robot` = "spot" is unknown; possible: "go2", or a file that ends with .urdf or .xml (MJCF)"#
        ]],
    );
}

#[test]
fn path_of_an_ensemble_is_relative_to_the_model_file_and_becomes_absolute() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.toml");
    std::fs::write(&path, "robot = \"go2\"\n[actuator]\nensemble = \"e.safetensors\"\ndraw = \"step\"")
        .expect("written");
    let file = ModelFile::load(&path).expect("valid");
    let ensemble = folder.path().join("e.safetensors");
    assert_eq!(
        file.actuator,
        Some(ActuatorNetworkConfig { ensemble, draw: MemberSampling::PerStep, ..ActuatorNetworkConfig::default() })
    );
    assert_eq!(ModelFile::parse(&file.to_toml(), "again").expect("valid"), file);
    for refusal in [load_robot(&path).map(drop), ModelFile::load_without_actuator_network(&path).map(drop)] {
        let error = refusal.expect_err("refused").to_string();
        assert!(error.contains("robot.toml: this command does not simulate actuator networks"), "{error}");
    }
}

#[test]
fn errors_in_the_actuator_table_list_the_allowed_keys_and_values() {
    for (table, expected) in [
        ("ensembles = \"e\"", "unknown field `ensembles`, expected one of `ensemble`, `mode`, `draw`, `sample`"),
        ("ensemble = \"e\"\ndraw = \"row\"", "unknown variant `row`, expected `episode` or `step`"),
        ("ensemble = \"e\"\nsample = 1", "invalid type: integer `1`, expected a boolean"),
        ("draw = \"step\"", "missing field `ensemble`"),
    ] {
        let text = format!("robot = \"go2\"\n[actuator]\n{table}\n");
        let error = ModelFile::parse(&text, "robot.toml").expect_err("refused").to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn error_for_a_missing_file_contains_its_path() {
    let error = load_robot("/nowhere/robot.toml").expect_err("no such file").to_string();
    assert!(error.starts_with("cannot read the model file /nowhere/robot.toml"), "{error}");
}

const FRICTION: &str = "robot = \"go2\"\n[[effect]]\nname = \"coulomb_friction\"\nscope = \"RR_thigh\"\n";

#[test]
fn effect_with_an_interval_is_applied_to_the_robot() {
    let text = format!("{FRICTION}torque_nm = 0.40\ninterval = {{ torque_nm = [0.36, 0.44] }}\n");
    let file = ModelFile::parse(&text, "robot.toml").expect("valid");
    assert_eq!(file.effects[0].intervals, [Some([0.36, 0.44])]);
    let robot = file.robot_model().expect("no conflict");
    assert_eq!(robot.joints.map(|joint| joint.coulomb_friction)[10], 0.4);
    assert_eq!(robot.joints.map(|joint| joint.coulomb_friction).iter().sum::<f64>(), 0.4);
}

#[test]
fn errors_in_an_effect_contain_the_allowed_values() {
    check_refusal(
        &FRICTION.replace("coulomb_friction", "coulomb"),
        &expect![[
            r#"robot.toml: effect 1: `name` = "coulomb" is not in the catalogue; possible: command_delay, encoder_offset, pd_gain, torque_saturation, supply_sag, thermal_derating, torque_delay, torque_speed_limit, torque_dead_zone, drive_lag, torque_sensor_delay, torque_gain, torque_ripple, backlash, joint_elasticity, coulomb_friction, viscous_friction, stribeck_friction, load_friction, armature, joint_spring, payload, com_shift, inertia, ground_friction, ground_stiffness, gyro_bias"#
        ]],
    );
    check_refusal(FRICTION, &expect![[r#"robot.toml: effect 1: `torque_nm` is missing; expected a number"#]]);
    check_refusal(
        &format!("{FRICTION}torque_nm = \"much\""),
        &expect![[r#"robot.toml: effect 1: `torque_nm` is "much"; expected a number"#]],
    );
    check_refusal(
        &format!("{FRICTION}torque_nm = 21"),
        &expect![[
            r#"robot.toml: effect 1: `coulomb_friction` on RR_thigh: `torque_nm` = 21 is not allowed: -20 to 20"#
        ]],
    );
    check_refusal(
        &format!("{FRICTION}torque_nm = 1\ntorque = 1"),
        &expect![[
            r#"robot.toml: effect 1: `coulomb_friction` has no key `torque`; possible: name, scope, interval, torque_nm"#
        ]],
    );
    check_refusal(
        &format!("{FRICTION}torque_nm = 1\ninterval = {{ torque_nm = [2, 1] }}"),
        &expect![[r#"robot.toml: effect 1: `interval.torque_nm` is [2, 1]; expected low <= high"#]],
    );
    check_refusal(
        &format!("{}torque_nm = 1", FRICTION.replace("RR_thigh", "RR_knee")),
        &expect![[
            r#"robot.toml: effect 1: `scope` is "RR_knee"; expected one of all, hip, thigh, calf, FL, FR, RL, RR, left, right, base, ground, or a joint such as FL_hip"#
        ]],
    );
}

const SHIFT: &str = "robot = \"go2\"\n[[effect]]\nname = \"com_shift\"\nscope = \"base\"\nshift_m = [0.0, 0.0, 0.0]\n";

#[test]
fn interval_of_an_unmeasured_component_is_written_as_minus_to_plus_infinity() {
    let text = format!("{SHIFT}interval = {{ shift_m = [[-0.1, -inf, 0.0], [0.1, inf, 0.0]] }}\n");
    let file = ModelFile::parse(&text, "robot.toml").expect("valid");
    assert_eq!(file.effects[0].intervals, [Some([-0.1, 0.1]), None, Some([0.0, 0.0])]);
    assert!(file.to_toml().contains("[[-0.1, -inf, 0.0], [0.1, inf, 0.0]]"), "{}", file.to_toml());
    check_refusal(
        &format!("{SHIFT}interval = {{ shift_m = [[-0.1, nan, 0.0], [0.1, inf, 0.0]] }}\n"),
        &expect![[
            r#"robot.toml: effect 1: `interval.shift_m` is [[-0.1, nan, 0.0], [0.1, inf, 0.0]]; expected two finite numbers, or -inf and inf for a component that was not measured"#
        ]],
    );
}

fn some_entry() -> impl Strategy<Value = EffectEntry> {
    let scopes = Scope::of_joints().len();
    (0..CATALOGUE.len(), 0..scopes, prop::array::uniform10(0.0..1.0f64), any::<u16>()).prop_map(
        |(index, scope, shares, measured)| {
            let effect = CATALOGUE[index];
            let scope = match effect.target {
                Target::Joints => Scope::of_joints()[scope],
                Target::Supply => Scope::All,
                Target::Bodies | Target::Imu => Scope::Base,
                Target::Ground => Scope::Ground,
            };
            let parameters =
                effect.parameters.iter().flat_map(|parameter| std::iter::repeat_n(parameter, parameter.count));
            let values = parameters.zip(shares).map(|(parameter, share)| {
                let [low, high] = parameter.prior_range;
                low + share * (high - low)
            });
            let mut entry = EffectEntry::new(effect, scope, values.collect()).expect("prior values are allowed");
            // A random subset of the components has an interval.
            let interval =
                |(bit, value): (usize, &f64)| (measured >> bit & 1 == 1).then_some([value - 0.1, value + 0.1]);
            entry.intervals = entry.values.iter().enumerate().map(interval).collect();
            entry
        },
    )
}

proptest! {
    #[test]
    fn written_model_files_are_read_back_unchanged(entries in prop::collection::vec(some_entry(), 0..6)) {
        let file = ModelFile { effects: entries, ..ModelFile::default() };
        // Two ripples on one joint may conflict; such a file is not valid.
        if file.robot_model().is_ok() {
            prop_assert_eq!(ModelFile::parse(&file.to_toml(), "written").expect("valid"), file);
        }
    }
}
