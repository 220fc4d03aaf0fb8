//! Lets a robot of any tree hold a pose in the batch engine.
//!
//! `cargo run --release -p twinstep-examples --example any_robot [ROBOT.urdf | ROBOT.xml]`

use std::path::PathBuf;

use miette::{Context, IntoDiagnostic};
use twinstep_model::TreeModel;
use twinstep_robot_files::read_robot;
use twinstep_sim::{Placement, SimConfig, TreeCommand, TreeSimulation};

/// Position and velocity gain of every joint.
const GAINS: [f32; 2] = [100.0, 2.0];
/// Rate of the actuators [Hz].
const ACTUATOR_HZ: f64 = 200.0;

fn main() -> miette::Result<()> {
    let path = std::env::args().nth(1).map_or_else(|| PathBuf::from("data/robots/anymal_c.xml"), PathBuf::from);
    let text = std::fs::read_to_string(&path).into_diagnostic()?;
    let file = read_robot(&text, path.parent()).into_diagnostic().wrap_err_with(|| path.display().to_string())?;
    file.notes.iter().for_each(|note| eprintln!("note: {note}"));
    let robot = TreeModel::new(file.tree).into_diagnostic()?;
    let untouched = robot.tree.shapes_without_contact();
    if !untouched.is_empty() {
        eprintln!("note: these shapes do not touch the ground: {}", untouched.join(", "));
    }

    // All joints at 0, or at the middle of a range that does not contain it.
    let middle = |[low, high]: [f64; 2]| if low > 0.0 || high < 0.0 { f64::midpoint(low, high) } else { 0.0 };
    let pose: Vec<f64> = robot.joints.iter().map(|joint| middle(joint.range)).collect();
    let start = Placement::of(&robot.tree, pose.clone());
    let command = TreeCommand::hold(pose.iter().map(|q| *q as f32).collect(), GAINS[0], GAINS[1]);

    let config = SimConfig::default();
    let mut robots = TreeSimulation::new(&robot, &config, ACTUATOR_HZ, 1, &start).into_diagnostic()?;
    for second in 0..=3 {
        let readings = &robots.states()[0];
        let offset = readings.state.q.iter().zip(&pose).map(|(q, target)| (q - target).abs()).fold(0.0, f64::max);
        println!(
            "{second} s: base at {:.3} m, largest offset of a joint {offset:.4}, force of the ground {:.0} N",
            readings.state.base_position[2],
            readings.shape_force.iter().sum::<f64>().max(0.0)
        );
        robots.step(std::slice::from_ref(&command), ACTUATOR_HZ as usize).into_diagnostic()?;
    }
    Ok(())
}
