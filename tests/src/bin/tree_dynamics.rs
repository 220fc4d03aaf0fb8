//! Equations of motion of a robot file in the states that stdin has, one JSON object a line. `test_tree_dynamics.py` compares them
//! with MuJoCo.
//!
//! `target/release/tree_dynamics ROBOT.xml < states`

use std::io::BufRead;
use std::path::PathBuf;

use clap::Parser;
use serde::{Deserialize, Serialize};
use twinstep_dynamics::tree::{FactoredTree, TreeMotion, TreeParameters, TreeState, TreeStructure, mass_matrix};
use twinstep_dynamics::{JointForces, Vec3};
use twinstep_model::RobotTree;
use twinstep_robot_files::read_robot;
use twinstep_simd::{F32x4, SimdFloat};

/// Gravity [m/s²].
const GRAVITY: f64 = 9.81;

/// Print mass matrix and velocity changes of a robot in given states.
#[derive(Parser)]
struct Arguments {
    /// URDF or MJCF file.
    robot: PathBuf,
}

/// A state, and what acts on the robot.
#[derive(Deserialize)]
struct Request {
    orientation: [f64; 4],
    /// Angular velocity of the base in its own axes [rad/s].
    angular_velocity: [f64; 3],
    q: Vec<f64>,
    dq: Vec<f64>,
    tau: Vec<f64>,
    /// Time step [s].
    dt: f64,
}

/// The equations in one precision. Velocities: angular and linear of a free base in base axes, then joints.
#[derive(Serialize)]
struct Equations {
    mass: Vec<Vec<f64>>,
    /// Change of the velocities in a step.
    change: Vec<f64>,
}

#[derive(Serialize)]
struct Reply {
    double: Equations,
    single: Equations,
}

fn main() -> Result<(), String> {
    let Arguments { robot } = Arguments::parse();
    let text = std::fs::read_to_string(&robot).map_err(|error| error.to_string())?;
    let tree = read_robot(&text, robot.parent()).map_err(|error| error.to_string())?.tree;
    for line in std::io::stdin().lock().lines() {
        let line = line.map_err(|error| error.to_string())?;
        let request: Request = serde_json::from_str(&line).map_err(|error| error.to_string())?;
        let reply = Reply { double: equations::<f64>(&tree, &request), single: equations::<F32x4>(&tree, &request) };
        println!("{}", serde_json::to_string(&reply).map_err(|error| error.to_string())?);
    }
    Ok(())
}

fn equations<T: SimdFloat>(tree: &RobotTree, request: &Request) -> Equations {
    let structure = TreeStructure::new(tree);
    let parameters = TreeParameters::<T>::splat(tree);
    let splat = |values: &[f64]| values.iter().map(|value| T::splat(*value)).collect::<Vec<T>>();
    let state = TreeState {
        orientation: request.orientation.map(T::splat),
        angular_velocity: Vec3(request.angular_velocity.map(T::splat)),
        q: splat(&request.q),
        dq: splat(&request.dq),
        ..TreeState::origin(structure.num_joints())
    };
    let mut motion = TreeMotion::empty(&parameters);
    motion.set(&parameters, &state, T::splat(GRAVITY));
    let damping: Vec<f64> = tree.joints.iter().map(|joint| joint.damping).collect();
    let forces = JointForces { damping: splat(&damping), ..JointForces::frictionless(splat(&request.tau)) };
    let mut factored = FactoredTree::empty(&parameters);
    let mass = mass_matrix(&structure, &parameters, &motion);
    factored.set_up(&parameters, &mut motion, &state, &forces, T::splat(request.dt));
    let mut joints = vec![T::splat(0.0); structure.num_joints()];
    let base = factored.solution(&structure, &mut joints);
    let get = |values: &[T]| values.iter().map(|value| value.get(0)).collect::<Vec<f64>>();
    Equations {
        mass: mass.iter().map(|row| get(row)).collect(),
        change: [get(&base[..structure.num_base_velocities()]), get(&joints)].concat(),
    }
}
