//! Motion of a robot file in an engine under commands that stdin has, one JSON object a line. `test_tree_motion.py` compares it
//! with MuJoCo.
//!
//! `target/release/tree_motion ROBOT.xml < commands`

use std::io::BufRead;
use std::path::PathBuf;

use clap::Parser;
use serde::{Deserialize, Serialize};
use twinstep_model::TreeModel;
use twinstep_robot_files::read_robot;
use twinstep_sim::{Engine, Placement, SimConfig, SimdPrecision, TreeCommand, TreeSimulation};
use twinstep_simd::InstructionSet;

/// Print the motion of a robot under given commands.
#[derive(Parser)]
struct Arguments {
    /// URDF or MJCF file.
    robot: PathBuf,
}

/// Start of a motion, and its commands.
#[derive(Deserialize)]
struct Request {
    engine: Engine,
    physics_hz: u32,
    actuator_hz: f64,
    /// Iterations of the contact solver.
    iterations: Option<u32>,
    /// True for double precision.
    double: bool,
    position: [f64; 3],
    orientation: [f64; 4],
    linear_velocity: [f64; 3],
    angular_velocity: [f64; 3],
    q: Vec<f64>,
    dq: Vec<f64>,
    kp: f32,
    kd: f32,
    /// Commanded positions in each actuator period.
    targets: Vec<Vec<f32>>,
}

/// State after an actuator period.
#[derive(Serialize)]
struct Reply {
    position: [f64; 3],
    orientation: [f64; 4],
    linear_velocity: [f64; 3],
    angular_velocity: [f64; 3],
    q: Vec<f64>,
    dq: Vec<f64>,
    tau: Vec<f64>,
    shape_force: Vec<f64>,
}

fn main() -> Result<(), String> {
    let Arguments { robot } = Arguments::parse();
    let text = std::fs::read_to_string(&robot).map_err(|error| error.to_string())?;
    let tree = read_robot(&text, robot.parent()).map_err(|error| error.to_string())?.tree;
    let model = TreeModel::new(tree).map_err(|error| error.to_string())?;
    for line in std::io::stdin().lock().lines() {
        let line = line.map_err(|error| error.to_string())?;
        let request: Request = serde_json::from_str(&line).map_err(|error| error.to_string())?;
        let replies = motion(&model, request)?;
        println!("{}", serde_json::to_string(&replies).map_err(|error| error.to_string())?);
    }
    Ok(())
}

fn motion(model: &TreeModel, request: Request) -> Result<Vec<Reply>, String> {
    let start = Placement {
        base_position: request.position,
        base_orientation: request.orientation,
        base_linear_velocity: request.linear_velocity,
        base_angular_velocity: request.angular_velocity,
        q: request.q,
        dq: request.dq,
    };
    let config = SimConfig {
        engine: request.engine,
        physics_hz: Some(request.physics_hz),
        solver_iterations: request.iterations,
        threads: 1,
        ..SimConfig::default()
    };
    let precision = if request.double { SimdPrecision::Double } else { SimdPrecision::Single(InstructionSet::best()) };
    let mut robots = TreeSimulation::with_precision(model, &config, request.actuator_hz, precision, 1, &start)
        .map_err(|error| error.to_string())?;
    let reply = |target: Vec<f32>| {
        let command = TreeCommand::hold(target, request.kp, request.kd);
        robots.step(&[command], 1).map_err(|error| error.to_string())?;
        let readings = robots.states()[0].clone();
        Ok(Reply {
            position: readings.state.base_position,
            orientation: readings.state.base_orientation,
            linear_velocity: readings.state.base_linear_velocity,
            angular_velocity: readings.state.base_angular_velocity,
            q: readings.state.q,
            dq: readings.state.dq,
            tau: readings.tau,
            shape_force: readings.shape_force,
        })
    };
    request.targets.into_iter().map(reply).collect()
}
