//! Robots of any tree on one core: speed of the batch engine beside MuJoCo, with the same contact points and motion.

use std::path::Path;

use twinstep_model::{MjcfActuator, TreeModel};
use twinstep_robot_files::{TreeMjcf, read_robot, write_mjcf};
use twinstep_sim::{Placement, SimConfig, TreeCommand, TreeSimulation};
use twinstep_simd::InstructionSet;

use crate::Measurement;
use crate::baselines::{Baselines, Setup};
use crate::error::{BenchError, Interrupted, check, failed};
use crate::sim::{ROBOTS, compare_with_baseline};

/// Rate of the actuators [Hz], and of the physics.
const ACTUATOR_HZ: u32 = 200;
const PHYSICS_HZ: u32 = 1000;
/// Number of actuator periods of a policy period.
const DECIMATION: usize = 4;
/// Policy periods of a cycle of the motion: one second.
const CYCLE: usize = 50;

/// A shipped robot and the motion in which it is measured.
struct Case {
    name: &'static str,
    /// The robot's file.
    text: &'static str,
    /// Position and velocity gain of every joint.
    gains: [f32; 2],
    /// Joints that the pose bends, by their suffix, with their positions [rad].
    pose: &'static [(&'static str, f64)],
    /// Amplitude of the motion of every joint about the pose [rad].
    amplitude: f64,
}

const G1: Case = Case {
    name: "g1, standing",
    text: include_str!("../../../data/robots/g1.xml"),
    gains: [100.0, 2.0],
    pose: &G1_POSE,
    amplitude: 0.0,
};

const SO101: Case = Case {
    name: "so101, sine of all joints",
    text: include_str!("../../../data/robots/so101.xml"),
    gains: [10.0, 0.5],
    pose: &[],
    amplitude: 0.3,
};

const CASES: [Case; 3] = [G1, Case { name: "g1, sine of all joints", amplitude: 0.05, ..G1 }, SO101];

/// Bent knees, on flat feet.
const G1_POSE: [(&str, f64); 3] = [("hip_pitch_joint", -0.2), ("knee_joint", 0.42), ("ankle_pitch_joint", -0.23)];

/// Measures the env-steps/s of each case, and of MuJoCo in the interpreter `python`.
pub fn measure(python: &Path, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let mut rows = Vec::new();
    for case in &CASES {
        check(interrupted)?;
        let motion = Motion::of(case)?;
        let mut baselines = Baselines::start(python, &motion.setup(window_s));
        let (ours, theirs) = compare_with_baseline(motion.stepping()?, &mut baselines, MUJOCO, window_s)?;
        rows.push(Measurement {
            case: format!("{}, batch {} {PHYSICS_HZ} Hz, one core", case.name, InstructionSet::best()),
            value: ours,
            unit: "env-steps/s",
            reference: theirs.map(|_| MUJOCO.to_owned()),
            ratio: theirs.map(|theirs| ours / theirs),
        });
        rows.extend(theirs.map(|theirs| Measurement {
            case: format!("{}, {MUJOCO}", case.name),
            value: theirs,
            unit: "env-steps/s",
            reference: None,
            ratio: None,
        }));
    }
    Ok(rows)
}

/// Name of the baseline.
const MUJOCO: &str = "MuJoCo C 1000 Hz, one thread";

/// A robot with its commands.
struct Motion {
    model: TreeModel,
    gains: [f32; 2],
    pose: Vec<f64>,
    amplitude: f64,
}

impl Motion {
    fn of(case: &Case) -> Result<Self, BenchError> {
        let model = TreeModel::new(read_robot(case.text, None).map_err(failed)?.tree).map_err(failed)?;
        let bent = |name: &str| case.pose.iter().find(|(suffix, _)| name.ends_with(suffix)).map_or(0.0, |(_, q)| *q);
        let pose = model.tree.joints.iter().map(|joint| bent(&joint.name)).collect();
        Ok(Self { model, gains: case.gains, pose, amplitude: case.amplitude })
    }

    /// Returns the joint position targets of a policy period: neighbours move against each other.
    fn target(&self, period: usize) -> Vec<f32> {
        let swing = self.amplitude * (std::f64::consts::TAU * period as f64 / CYCLE as f64).sin();
        let side = |joint: usize| if joint.is_multiple_of(2) { -swing } else { swing };
        self.pose.iter().enumerate().map(|(joint, q)| (q + side(joint)) as f32).collect()
    }

    fn setup(&self, window_s: f64) -> Setup {
        let options = TreeMjcf {
            contact: self.model.contact,
            timestep: 1.0 / f64::from(PHYSICS_HZ),
            actuator: MjcfActuator::Position { kp: self.gains[0].into(), kd: self.gains[1].into() },
            start: Some(self.pose.clone()),
        };
        Setup {
            models: [(MUJOCO.to_owned(), write_mjcf(&self.model.tree, &options))].into(),
            threads: Vec::new(),
            targets: (0..CYCLE).map(|period| self.target(period)).collect(),
            actions: Vec::new(),
            policy_dt: DECIMATION as f64 / f64::from(ACTUATOR_HZ),
            restarts: true,
            num_envs: ROBOTS,
            window_s,
        }
    }

    /// Returns a function that steps all robots by one policy period. They are reset each second, so that none lies on the ground.
    fn stepping(&self) -> Result<impl FnMut() -> Result<(), BenchError>, BenchError> {
        let start = Placement::of(&self.model.tree, self.pose.clone());
        let config = SimConfig { physics_hz: Some(PHYSICS_HZ), threads: 1, ..SimConfig::default() };
        let mut robots =
            TreeSimulation::new(&self.model, &config, ACTUATOR_HZ.into(), ROBOTS, &start).map_err(failed)?;
        let mut commands = vec![TreeCommand::hold(self.target(0), self.gains[0], self.gains[1]); ROBOTS];
        let mut period = 0;
        Ok(move || {
            if period % CYCLE == 0 {
                (0..ROBOTS).try_for_each(|robot| robots.reset(robot, &self.model, &start)).map_err(failed)?;
            }
            let target = self.target(period % CYCLE);
            for command in &mut commands {
                command.q.clone_from(&target);
            }
            period += 1;
            robots.step(&commands, DECIMATION).map_err(failed)
        })
    }
}
