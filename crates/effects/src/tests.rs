//! Tests of the whole catalogue and of the composition of entries.

use proptest::prelude::*;

use super::*;
use twinstep_model::{Joint, go2};

fn named(name: &str) -> &'static Effect {
    Effect::named(name).expect("in the catalogue")
}

fn entry(name: &str, scope: &str, values: &[f64]) -> EffectEntry {
    EffectEntry::new(named(name), scope.parse().expect("a scope"), values.to_vec()).expect("allowed")
}

/// Returns a scope that the effect can have.
fn some_scope(effect: &Effect) -> Scope {
    match effect.target {
        Target::Joints | Target::Supply => Scope::All,
        Target::Bodies | Target::Imu => Scope::Base,
        Target::Ground => Scope::Ground,
    }
}

#[test]
fn names_are_unique_and_confounders_are_in_the_catalogue() {
    for (index, effect) in CATALOGUE.iter().enumerate() {
        assert!(CATALOGUE[..index].iter().all(|other| other.name != effect.name), "{}", effect.name);
        for confounder in effect.confounders {
            assert!(Effect::named(confounder.effect).is_some(), "{}: confounder {}", effect.name, confounder.effect);
        }
        for parameter in effect.parameters {
            let [low, high] = parameter.bounds;
            let [from, to] = parameter.prior_range;
            assert!(low <= from && from < to && to <= high, "{}.{}", effect.name, parameter.name);
        }
    }
}

/// Sets the parameters of effects that are switched off to those of the nominal robot.
fn without_inactive_parameters(mut robot: RobotModel) -> RobotModel {
    let nominal = go2();
    for (joint, ideal) in robot.joints.iter_mut().zip(&nominal.joints) {
        if joint.actuator.ripple.amplitude == 0.0 {
            joint.actuator.ripple = ideal.actuator.ripple;
        }
        if joint.stribeck_friction.breakaway_torque == 0.0 {
            joint.stribeck_friction = ideal.stribeck_friction;
        }
    }
    if robot.derating.per_kelvin.iter().all(|factor| *factor == 0.0) {
        robot.derating.reference_temperature_c = nominal.derating.reference_temperature_c;
    }
    robot
}

#[test]
fn prior_values_change_the_robot_and_no_effect_values_do_not() {
    for effect in CATALOGUE {
        let of = |pick: fn(&Parameter) -> f64| -> Vec<f64> {
            effect.parameters.iter().flat_map(|parameter| vec![pick(parameter); parameter.count]).collect()
        };
        let apply = |values: Vec<f64>| {
            let intervals = vec![None; values.len()];
            // Not `EffectEntry::new`: an infinite no-effect value is outside the parameter's bounds.
            let entry = EffectEntry { effect, scope: some_scope(effect), values, intervals };
            let mut robot = go2();
            for joint in 0..12 {
                let site = if effect.target == Target::Joints { EffectSite::Joint(joint) } else { EffectSite::Global };
                effect.apply(&mut robot, site, &entry.values).expect("no conflict");
                if site == EffectSite::Global {
                    break;
                }
            }
            robot
        };
        assert_ne!(apply(of(|parameter| parameter.prior_range[1])), go2(), "{}", effect.name);
        if effect.name == "inertia" {
            continue;
        }
        let neutral = apply(of(|parameter| parameter.no_effect_value));
        let nominal = go2();
        let bodies = |robot: &RobotModel| -> Vec<_> {
            let bodies = robot.legs.iter().flat_map(|leg| leg.bodies).chain([robot.trunk]);
            bodies.flat_map(|body| [body.mass, body.com.x, body.com.y, body.com.z]).collect()
        };
        for (value, expected) in bodies(&neutral).iter().zip(bodies(&nominal)) {
            assert!((value - expected).abs() < 1e-12, "{}: {value} instead of {expected}", effect.name);
        }
        // Bodies were compared above: a payload of 0 kg changes their last digits.
        let rest = RobotModel { legs: nominal.legs, trunk: nominal.trunk, ..without_inactive_parameters(neutral) };
        assert_eq!(rest, nominal, "{}", effect.name);
    }
}

#[test]
fn effects_that_caveats_mention_are_in_the_catalogue() {
    for effect in CATALOGUE {
        let words = effect.caveat.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '_');
        for word in words.filter(|word| word.contains('_')) {
            assert!(Effect::named(word).is_some(), "the caveat of `{}` mentions `{word}`", effect.name);
        }
    }
}

#[test]
fn friction_adds_up_where_scopes_overlap() {
    let entries = [entry("coulomb_friction", "all", &[0.1]), entry("coulomb_friction", "RR_thigh", &[0.4])];
    let robot = apply_effects(&go2(), &entries).expect("no conflict");
    for (joint, model) in Joint::ALL.iter().zip(&robot.joints) {
        let expected = if joint.name() == "RR_thigh" { 0.5 } else { 0.1 };
        assert!((model.coulomb_friction - expected).abs() < 1e-12, "{}", joint.name());
    }
}

#[test]
fn gains_multiply() {
    let entries = [entry("torque_gain", "all", &[0.9]), entry("torque_gain", "calf", &[0.5])];
    let robot = apply_effects(&go2(), &entries).expect("no conflict");
    assert!((robot.joints[0].actuator.gain - 0.9).abs() < 1e-12);
    assert!((robot.joints[2].actuator.gain - 0.45).abs() < 1e-12);
}

#[test]
fn narrowest_scope_replaces_and_among_equal_scopes_the_last() {
    let entries = [
        entry("drive_lag", "FL_calf", &[0.001]),
        entry("drive_lag", "all", &[0.002]),
        entry("drive_lag", "calf", &[0.003]),
        entry("drive_lag", "calf", &[0.004]),
    ];
    let robot = apply_effects(&go2(), &entries).expect("no conflict");
    assert_eq!(robot.joints[2].actuator.torque_time_constant, 0.001);
    assert_eq!(robot.joints[5].actuator.torque_time_constant, 0.004);
    assert_eq!(robot.joints[0].actuator.torque_time_constant, 0.002);
}

#[test]
fn ripples_of_equal_frequency_add_with_their_phases() {
    let entries =
        [entry("torque_ripple", "FL_hip", &[0.3, 10.0, 0.2]), entry("torque_ripple", "FL_hip", &[0.1, 10.0, 1.5])];
    let ripple = apply_effects(&go2(), &entries).expect("no conflict").joints[0].actuator.ripple;
    for q in [0.0, 0.1, 0.7] {
        let sum = 0.3 * f64::sin(10.0 * q + 0.2) + 0.1 * f64::sin(10.0 * q + 1.5);
        assert!((ripple.amplitude * (ripple.cycles * q + ripple.phase).sin() - sum).abs() < 1e-12);
    }
}

#[test]
fn ripples_of_two_frequencies_are_rejected() {
    let entries =
        [entry("torque_ripple", "all", &[0.3, 10.0, 0.2]), entry("torque_ripple", "FL_hip", &[0.1, 12.0, 0.0])];
    let error = apply_effects(&go2(), &entries).expect_err("refused").to_string();
    assert!(error.contains("`cycles_per_turn`"), "{error}");
}

#[test]
fn entries_that_add_up_to_an_invalid_robot_are_rejected() {
    let refused = |entries: &[EffectEntry], part: &str| {
        let error = apply_effects(&go2(), entries).expect_err("refused").to_string();
        assert!(error.contains(part), "{error}");
    };
    // Longer than the torque history of the actuators.
    refused(&[entry("command_delay", "all", &[0.03]), entry("command_delay", "FL", &[0.03])], "more than 0.04 s");
    refused(&[entry("armature", "all", &[-0.01]), entry("armature", "FL_hip", &[-0.01])], "less than zero");
    refused(&[entry("armature", "all", &[-0.01]), entry("backlash", "calf", &[0.01])], "above zero");
    refused(&[entry("payload", "base", &[-3.0, 0.5, 0.5, 0.5])], "no longer positive");
}

#[test]
fn payload_adds_to_a_replaced_body_in_any_order_of_entries() {
    let theta = go2().trunk.scaled(1.2).log_cholesky();
    let (body, load) = (entry("inertia", "base", &theta), entry("payload", "base", &[2.0, 0.1, 0.0, 0.0]));
    let one = apply_effects(&go2(), &[body.clone(), load.clone()]).expect("no conflict").trunk;
    assert_eq!(apply_effects(&go2(), &[load, body]).expect("no conflict").trunk, one);
    assert!((one.mass - 1.2 * go2().trunk.mass - 2.0).abs() < 1e-9);
}

#[test]
fn scope_that_an_effect_cannot_have_is_rejected_with_the_allowed_ones() {
    let error =
        EffectEntry::new(named("payload"), Scope::All, vec![1.0, 0.0, 0.0, 0.0]).expect_err("refused").to_string();
    assert_eq!(error, "`payload` cannot have scope \"all\"; possible: base, or a joint for its child link");
}

#[test]
fn value_outside_its_bounds_is_rejected() {
    let error = EffectEntry::new(named("command_delay"), Scope::All, vec![0.5]).expect_err("refused").to_string();
    assert_eq!(error, "`command_delay` on all: `delay_s` = 0.5 is not allowed: 0 to 0.04");
}

proptest! {
    #[test]
    fn scope_names_round_trip(index in 0usize..24) {
        let scopes: Vec<_> = Scope::of_joints().into_iter().chain([Scope::Base, Scope::Ground]).collect();
        let scope = scopes[index % scopes.len()];
        prop_assert_eq!(scope.to_string().parse::<Scope>(), Ok(scope));
    }
}

#[test]
fn friction_can_be_less_than_the_file_states_and_never_less_than_none() {
    let mut robot = go2();
    robot.joints[2].viscous_friction = 0.3;
    let entry = |value| {
        EffectEntry::new(
            Effect::named("viscous_friction").expect("in the catalogue"),
            Scope::Joint(Joint::ALL[2]),
            vec![value],
        )
        .expect("within its bounds")
    };
    let less = apply_effects(&robot, &[entry(-0.2)]).expect("some friction is left");
    assert!((less.joints[2].viscous_friction - 0.1).abs() < 1e-12);
    let error = apply_effects(&robot, &[entry(-0.4)]).expect_err("no friction is left");
    assert!(error.to_string().contains("less than zero"), "{error}");
}
