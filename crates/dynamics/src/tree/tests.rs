//! Random trees: the equations agree with each other.

use glam::{DAffine3, DQuat, DVec3, dvec3};
use proptest::prelude::*;
use twinstep_model::{
    BaseMount, FreeJoint, JointSpring, RigidBody, RobotTree, TreeBody, TreeJoint, TreeJointKind, go2,
};

use super::{
    FactoredTree, TreeAcceleration, TreeMotion, TreeParameters, TreeState, TreeStructure, inverse_dynamics, mass_matrix,
};
use crate::{JointForces, Vec3};

const GRAVITY: f64 = 9.81;

fn vector(range: f64) -> impl Strategy<Value = DVec3> {
    prop::array::uniform3(-range..range).prop_map(DVec3::from_array)
}

fn rotation() -> impl Strategy<Value = DQuat> {
    (vector(1.0), -3.0..3.0f64).prop_map(|(axis, angle)| DQuat::from_axis_angle(axis.normalize_or(DVec3::X), angle))
}

fn body() -> impl Strategy<Value = RigidBody> {
    (0.1..3.0f64, vector(0.1), vector(0.04), rotation()).prop_map(|(mass, com, moments, turn)| {
        RigidBody::from_principal(mass, com, moments.abs() + DVec3::splat(0.05), turn)
    })
}

fn joint(index: usize) -> impl Strategy<Value = TreeJoint> {
    let place = (vector(0.3), rotation());
    (0..=index, any::<bool>(), place, vector(1.0), 0.0..0.05f64).prop_map(
        move |(parent, slides, (at, turn), axis, armature)| TreeJoint {
            name: format!("joint{index}"),
            kind: if slides { TreeJointKind::Prismatic } else { TreeJointKind::Revolute },
            parent,
            parent_from_child: DAffine3::from_rotation_translation(turn, at),
            axis: axis.try_normalize().unwrap_or(DVec3::Z),
            range: [f64::NEG_INFINITY, f64::INFINITY],
            effort: None,
            speed_limit: f64::INFINITY,
            armature,
            damping: 0.0,
            friction: 0.0,
            spring: JointSpring::NONE,
        },
    )
}

fn tree() -> impl Strategy<Value = RobotTree> {
    (5..20usize, any::<bool>())
        .prop_flat_map(|(num, is_free)| {
            let joints: Vec<_> = (0..num).map(joint).collect();
            (Just(is_free), joints, prop::collection::vec(body(), num + 1))
        })
        .prop_map(|(is_free, joints, bodies)| RobotTree {
            free_joint: FreeJoint { armature: 0.3, damping: 0.2, friction: 0.0 },
            name: "random".to_owned(),
            base: Some(if is_free { BaseMount::Floating } else { BaseMount::Fixed }),
            world_from_base: DAffine3::IDENTITY,
            bodies: bodies.into_iter().map(|inertia| TreeBody { name: String::new(), inertia }).collect(),
            joints,
            shapes: Vec::new(),
        })
}

/// Returns numbers between −1 and 1 that are not regular.
fn numbers(seed: u64, count: usize) -> Vec<f64> {
    use rand::RngExt;
    let mut random = twinstep_model::stream(seed, "dynamics::tests", 0);
    (0..count).map(|_| random.random_range(-1.0..1.0)).collect()
}

struct Case {
    structure: TreeStructure,
    parameters: TreeParameters<f64>,
    motion: TreeMotion<f64>,
    state: TreeState<f64>,
}

impl Case {
    fn new(tree: &RobotTree, seed: u64) -> Self {
        let structure = TreeStructure::new(tree);
        let parameters = TreeParameters::<f64>::splat(tree);
        let joints = structure.num_joints();
        let values = numbers(seed, 2 * joints + 7);
        let turn = DQuat::from_axis_angle(dvec3(0.3, -0.5, 0.8).normalize(), 2.0 * values[6]);
        let still = if structure.is_free { 1.0 } else { 0.0 };
        let state = TreeState {
            orientation: [turn.w, turn.x, turn.y, turn.z],
            angular_velocity: Vec3([values[0], values[1], values[2]].map(|value| still * value)),
            q: values[7..7 + joints].to_vec(),
            dq: values[7 + joints..].to_vec(),
            linear_velocity: Vec3([values[3], values[4], values[5]].map(|value| still * value)),
            ..TreeState::origin(joints)
        };
        let mut motion = TreeMotion::empty(&parameters);
        motion.set(&parameters, &state, GRAVITY);
        Self { structure, parameters, motion, state }
    }

    fn inverse(&self, acceleration: &[f64]) -> Vec<f64> {
        let Self { structure, parameters, motion, .. } = self;
        let base = structure.num_base_velocities();
        let of_base = |index: usize| if structure.is_free { acceleration[index] } else { 0.0 };
        let acceleration = TreeAcceleration {
            angular: Vec3([of_base(0), of_base(1), of_base(2)]),
            linear: Vec3([of_base(3), of_base(4), of_base(5)]),
            ddq: acceleration[base..].to_vec(),
        };
        let forces = inverse_dynamics(structure, parameters, motion, &acceleration);
        let of_base = forces.moment.0.into_iter().chain(forces.force.0).take(base);
        of_base.chain(forces.tau).collect()
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn mass_matrix_is_the_change_of_inverse_dynamics_with_acceleration(tree in tree(), seed in 0..1000u64) {
        let case = Case::new(&tree, seed);
        let matrix = mass_matrix(&case.structure, &case.parameters, &case.motion);
        let size = case.structure.num_velocities();
        let still = case.inverse(&vec![0.0; size]);
        for column in 0..size {
            let mut unit = vec![0.0; size];
            unit[column] = 1.0;
            for (row, (force, still)) in case.inverse(&unit).into_iter().zip(&still).enumerate() {
                let scale = matrix[row][row].max(matrix[column][column]).max(still.abs());
                prop_assert!((matrix[row][column] - (force - still)).abs() < 1e-10 * scale.max(1.0));
            }
        }
    }

    #[test]
    fn factored_step_is_forward_dynamics(tree in tree(), seed in 0..1000u64) {
        let case = Case::new(&tree, seed);
        let Case { structure, parameters, motion, state } = &case;
        let joints = structure.num_joints();
        let load = JointForces::frictionless(numbers(seed + 1, joints));
        let mut factored = FactoredTree::empty(parameters);
        factored.set_up(parameters, &mut motion.clone(), state, &load, 1.0);
        let mut ddq = vec![0.0; joints];
        let base = factored.solution(structure, &mut ddq);
        let acceleration: Vec<f64> = base.into_iter().take(structure.num_base_velocities()).chain(ddq).collect();
        let forces = case.inverse(&acceleration);
        // The damping of the base is integrated implicitly: it acts on the velocity at the end of the step.
        let end = state.base_velocity().into_iter().zip(base).map(|(velocity, change)| velocity + change);
        let damping = end.take(structure.num_base_velocities()).map(|velocity| -tree.free_joint.damping * velocity);
        let expected: Vec<f64> = damping.chain(load.tau).collect();
        for (force, expected) in forces.into_iter().zip(expected) {
            prop_assert!((force - expected).abs() < 1e-7, "{force} {expected}");
        }
    }

    #[test]
    fn row_of_a_body_is_whitened_along_its_branch(tree in tree(), seed in 0..1000u64) {
        let case = Case::new(&tree, seed);
        let Case { structure, parameters, motion, state } = &case;
        let joints = structure.num_joints();
        let load = JointForces::frictionless(vec![0.0; joints]);
        let mut factored = FactoredTree::empty(parameters);
        factored.set_up(parameters, &mut motion.clone(), state, &load, 1.0);
        let body = seed as usize % (joints + 1);
        let branch = &structure.branches[body];
        let (base, mut along) = ([0.3, -0.2, 0.5, 0.1, 0.7, -0.4], numbers(seed, branch.len()));
        let row: Vec<f64> = along.clone();
        let whitened = factored.whiten(structure, body, base, &mut along);
        // J M⁻¹ Jᵀ by the solution for an impulse along the row.
        factored.base_u = whitened;
        factored.u.iter_mut().for_each(|value| *value = 0.0);
        branch.iter().zip(&along).for_each(|(joint, value)| factored.u[*joint] = *value);
        let mut change = vec![0.0; joints];
        let of_base = factored.solution(structure, &mut change);
        let along_joints: f64 = branch.iter().zip(&row).map(|(joint, entry)| entry * change[*joint]).sum();
        let along_base: f64 = if structure.is_free { base.iter().zip(of_base).map(|(one, other)| one * other).sum() } else { 0.0 };
        let response: f64 = whitened.iter().chain(&along).map(|entry| entry * entry).sum();
        prop_assert!((response - along_joints - along_base).abs() < 1e-8 * response.max(1.0));
    }
}

#[test]
fn go2_has_the_mass_matrix_of_its_own_equations() {
    let tree = RobotTree::from(&go2());
    let case = Case::new(&tree, 3);
    let matrix = mass_matrix(&case.structure, &case.parameters, &case.motion);
    let q: [f64; 12] = case.state.q.clone().try_into().expect("twelve joints");
    let own = crate::quadruped::KinematicTree::<f64>::splat(&go2());
    let expected = crate::quadruped::mass_matrix(&own, &q);
    for (row, expected) in matrix.iter().zip(expected) {
        for (entry, expected) in row.iter().zip(expected) {
            assert!((entry - expected).abs() < 1e-12, "{entry} {expected}");
        }
    }
}
