//! Plots of effects and of evaluations, written by the program.

use std::path::Path;
use std::process::{Command, Output};

use twinstep_effects::CATALOGUE;
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES};
use twinstep_tests::python::{Programs, root};

const LOG: &str = "data/go2_air_chirp";

fn twinstep(arguments: &[&str]) -> Output {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    Command::new(programs.twinstep()).args(arguments).current_dir(root()).output().unwrap()
}

/// Returns the plot that a command writes.
fn plot(arguments: &[&str]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plot.svg");
    let output = twinstep(&[arguments, &["--plot", path.to_str().unwrap()]].concat());
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    assert!(!output.stdout.is_empty(), "the text is printed as well");
    let svg = std::fs::read_to_string(path).unwrap();
    assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"), "{arguments:?}");
    assert!(!svg.contains("NaN") && !svg.contains("inf"), "{arguments:?}");
    svg
}

/// Returns the `points` attribute of every polyline with this colour.
fn lines<'a>(svg: &'a str, colour: &str) -> Vec<&'a str> {
    let of_colour = |line: &&str| line.contains("<polyline") && line.contains(&format!("stroke=\"{colour}\""));
    svg.lines().filter(of_colour).filter_map(|line| line.split("points=\"").nth(1)?.split('"').next()).collect()
}

#[test]
fn pages_of_the_effects_are_those_of_the_catalogue_and_every_plot_has_a_visible_difference() {
    let folder = tempfile::tempdir().unwrap();
    let output = twinstep(&["effects", "--pages", folder.path().to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let names = CATALOGUE.iter().map(|effect| effect.name).chain(["index"]);
    for page in names.map(|name| format!("{name}.md")) {
        let [written, published] = [folder.path(), &root().join("docs/effects")].map(|folder| {
            std::fs::read_to_string(folder.join(&page)).unwrap_or_else(|cause| panic!("{page}: {cause}"))
        });
        assert_eq!(written, published, "run `twinstep effects --pages docs/effects`");
    }
    for effect in CATALOGUE {
        let svg = std::fs::read_to_string(folder.path().join(format!("{}.svg", effect.name))).unwrap();
        assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"), "{}", effect.name);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{}", effect.name);
        assert!(svg.contains(effect.name) && svg.contains("difference due to the effect"), "{}", effect.name);
        // The first line is the legend's sample; the others are in the three panels.
        let (without, with) = (lines(&svg, "#262626"), lines(&svg, "#F2A71B"));
        assert_eq!([without.len(), with.len()], [4, 4], "{}", effect.name);
        // Vertical positions of the points [half px]. The panel of the difference is scaled to the largest one.
        let heights = |line: &str| -> Vec<f64> {
            line.split_whitespace().map(|point| point.split_once(',').unwrap().1.parse().unwrap()).collect()
        };
        let [without, with] = [without[2], with[2]].map(heights);
        let difference = without.iter().zip(&with).map(|(one, other)| (one - other).abs()).fold(0.0, f64::max);
        assert!(difference > 10.0, "{}: the lines differ by at most {difference} half px", effect.name);
    }
}

#[test]
fn evaluation_plot_has_every_joint_and_the_worst_one_over_time() {
    let svg = plot(&["evaluate", LOG, "--from", "10"]);
    for name in JOINT_NAMES {
        assert!(svg.contains(name), "{name}");
    }
    assert!(svg.contains("RL_calf, the joint with the largest error") && svg.contains("measured"));
    assert!(!svg.contains("[N·m]"), "this log has no torque");
}

#[test]
fn evaluation_plot_has_torque_errors_if_torque_was_measured() {
    let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
    let meta = Meta {
        kp: Some(Gain::Uniform(30.0)),
        kd: Some(Gain::Uniform(0.7)),
        ..Meta::new(200.0, TorqueSensor::MotorCurrent, segments)
    };
    let column =
        |name: &str, at: fn(f64) -> f64| (name.to_owned(), (0..50).map(|row| at(f64::from(row) * 0.005)).collect());
    let columns = [
        column("t", |t| t),
        column("q_FL_calf", |t| -1.8 + 0.1 * t),
        column("dq_FL_calf", |_| 0.1),
        column("q_cmd_FL_calf", |t| -1.7 + 0.1 * t),
        column("tau_measured_FL_calf", |_| 2.0),
    ];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log");
    Log::new(meta, columns).unwrap().write(&path).unwrap();
    let svg = plot(&["evaluate", path.to_str().unwrap()]);
    assert!(svg.contains("torque, RMSE [N·m]") && svg.contains("joint position, RMSE [rad]"));
}

#[test]
fn unwritable_plot_path_is_rejected_before_the_computation() {
    let nowhere = Path::new("/nowhere/plot.svg").to_str().unwrap();
    for arguments in [&["effects", "armature"][..], &["evaluate", LOG]] {
        let output = twinstep(&[arguments, &["--plot", nowhere]].concat());
        assert_eq!(output.status.code(), Some(2));
        assert!(output.stdout.is_empty());
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(error.starts_with("error: cannot write `/nowhere/plot.svg`"), "{error}");
    }
    assert_eq!(twinstep(&["effects", "--plot", "list.svg"]).status.code(), Some(2), "the list of effects has no plot");
}
