//! Observation and action entries that tasks share: U2E, eq. 14, and privileged entries for a critic.

use glam::Vec3;
use twinstep_model::{EnvSpec, RobotModel, SpecField, frames};

use crate::ControlledRobot;
use crate::task::{RobotView, Truth};

/// Length of the observation of U2E, eq. 14, of a quadruped with twelve joints.
pub const OBS_LEN: usize = 45;
/// Length of the privileged observation of a quadruped.
pub const CRITIC_OBS_LEN: usize = 11;

/// Returns the spec of a task with the observation of U2E, eq. 14, and joint position offsets as actions.
///
/// `reward_terms` are the names of the terms, `max_episode_s` is the time after which an episode is truncated [s].
pub fn base_spec(task: &str, robot: &RobotModel, reward_terms: Vec<String>, max_episode_s: f32) -> EnvSpec {
    let robot = ControlledRobot::from(robot);
    let observation = policy_fields(robot.joints.len());
    spec_of(task, &robot, observation, reward_terms, max_episode_s)
}

/// Returns the spec of a task with these observations, and joint position offsets as actions.
pub(crate) fn spec_of(
    task: &str,
    robot: &ControlledRobot,
    observation: Vec<SpecField>,
    reward_terms: Vec<String>,
    max_episode_s: f32,
) -> EnvSpec {
    let alike = robot.gains.iter().all(|gains| *gains == robot.gains[0]);
    let [kp, kd] = robot.gains[0];
    EnvSpec {
        task: task.to_owned(),
        robot: robot.name.clone(),
        observation,
        critic_observation: Vec::new(),
        action: vec![field(
            "joint_position_offset",
            robot.joints.len(),
            "action_scale",
            1.0,
            "commanded joint position relative to the default pose, in units of action_scale",
        )],
        joint_order: robot.joints.clone(),
        policy_dt: robot.policy_dt(),
        actuator_dt: robot.actuator_dt,
        kp,
        kd,
        joint_gains: if alike { Vec::new() } else { robot.gains.clone() },
        action_scale: robot.action_scale,
        default_pose: robot.default_pose.clone(),
        reward_terms,
        max_episode_steps: (f64::from(max_episode_s) / robot.policy_dt()).round() as u32,
    }
}

/// Returns the entries of U2E, eq. 14, which [`observe`] writes, of a robot with this number of joints.
pub(crate) fn policy_fields(joints: usize) -> Vec<SpecField> {
    vec![
        field("base_angular_velocity", 3, "rad/s", 50.0, "angular velocity of the base in the base frame, omega_t"),
        field("projected_gravity", 3, "", 1.0, "unit vector of gravity in the base frame, g_t"),
        field(
            "velocity_command",
            3,
            "m/s, m/s, rad/s",
            5.0,
            "commanded velocity in the base frame: forward, left, yaw rate, c_t",
        ),
        field("joint_position", joints, "rad", 6.3, "position relative to the default pose, q - q_default"),
        field("joint_velocity", joints, "rad/s", 100.0, "velocity, dq"),
        field("previous_action", joints, "", 1.0, "action of the previous step, clipped, a_(t-1)"),
    ]
}

/// Returns the privileged entries of a quadruped, which [`observe_privileged`] writes.
pub fn privileged_fields() -> Vec<SpecField> {
    privileged_fields_of(&["FL", "FR", "RL", "RR"])
}

/// Returns the privileged entries of a robot with these feet.
pub(crate) fn privileged_fields_of(feet: &[&str]) -> Vec<SpecField> {
    let force = format!("normal force on each foot: {}", feet.join(", "));
    vec![
        field("true_linear_velocity", 3, "m/s", 50.0, "velocity of the base in the base frame"),
        field("true_angular_velocity", 3, "rad/s", 50.0, "angular velocity of the base in the base frame"),
        field("base_height", 1, "m", 5.0, "height of the base above the ground under it"),
        field("foot_force", feet.len(), "N", 1000.0, &force),
    ]
}

/// Returns the number of privileged entries of a robot with this number of feet.
pub(crate) fn privileged_len(feet: usize) -> usize {
    7 + feet
}

/// Returns the fields of this number of frames: the present one, and those of `n` policy steps before, whose names end in `_n`.
pub(crate) fn framed(present: &[SpecField], frames: usize) -> Vec<SpecField> {
    let earlier = |field: &SpecField, before: usize| SpecField {
        name: format!("{}_{before}", field.name),
        description: format!("{}, {before} policy steps before", field.description),
        ..field.clone()
    };
    let earlier = (1..frames).flat_map(|before| present.iter().map(move |field| earlier(field, before)));
    present.iter().cloned().chain(earlier).collect()
}

/// Points at which a critic sees the ground, by their distances from the base along its heading and to the left [m].
const GROUND_POINTS: [&[f32]; 2] = [&[-0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6], &[-0.4, -0.2, 0.0, 0.2, 0.4]];

/// Returns the field of the heights of the ground, which [`observe_ground`] writes.
pub(crate) fn ground_heights_field() -> SpecField {
    let points = GROUND_POINTS[0].len() * GROUND_POINTS[1].len();
    field(
        "ground_depth",
        points,
        "m",
        2.0,
        "depth of the ground below the base, on a grid along its heading: rows from -0.6 to 0.6 m forward, columns from -0.4 to 0.4 m to the left",
    )
}

/// Writes the depth of the ground below the base at the points around it.
pub(crate) fn observe_ground(robot: &RobotView, truth: &Truth, obs: &mut [f32]) {
    let forward = frames::world_from_base(robot.orientation) * Vec3::X;
    let length = forward.x.hypot(forward.y).max(1e-3);
    let [cos, sin] = [forward.x / length, forward.y / length];
    let [x, y, z] = truth.base_position;
    let points = GROUND_POINTS[0].iter().flat_map(|along| GROUND_POINTS[1].iter().map(move |across| (along, across)));
    let depths = points
        .map(|(along, across)| z - robot.ground.height(x + cos * along - sin * across, y + sin * along + cos * across));
    write_clipped(obs, depths, 2.0);
}

/// Returns a field whose entries are within ±`bound`.
pub(crate) fn field(name: &str, size: usize, unit: &str, bound: f32, text: &str) -> SpecField {
    SpecField {
        name: name.to_owned(),
        size,
        unit: unit.to_owned(),
        low: -bound,
        high: bound,
        description: text.to_owned(),
    }
}

/// Writes the observation of U2E, eq. 14, into `obs` (9 values and 3 for each joint), clipped to the bounds of [`base_spec`].
pub fn observe(robot: &RobotView, command: [f32; 3], default_pose: &[f32], action: &[f32], obs: &mut [f32]) {
    let joints = robot.q.len();
    let gravity = frames::projected_gravity(robot.orientation);
    write_clipped(&mut obs[0..3], robot.gyro, 50.0);
    write_clipped(&mut obs[3..6], gravity.to_array(), 1.0);
    write_clipped(&mut obs[6..9], command, 5.0);
    let (q, rest) = obs[9..].split_at_mut(joints);
    let (dq, actions) = rest.split_at_mut(joints);
    write_clipped(q, robot.q.iter().zip(default_pose).map(|(q, pose)| q - pose), 6.3);
    write_clipped(dq, robot.dq.iter().copied(), 100.0);
    actions[..joints].copy_from_slice(action);
}

/// Writes the privileged observation into `obs` (7 values and one for each foot), clipped to the bounds of [`privileged_fields`].
pub fn observe_privileged(robot: &RobotView, truth: &Truth, obs: &mut [f32]) {
    let velocity = linear_velocity_in_base(robot, truth);
    write_clipped(&mut obs[0..3], velocity.to_array(), 50.0);
    write_clipped(&mut obs[3..6], truth.base_angular_velocity, 50.0);
    write_clipped(&mut obs[6..7], [base_height(robot, truth)], 5.0);
    write_clipped(&mut obs[7..], truth.foot_force.iter().copied(), 1000.0);
}

/// Returns the velocity of the base in the base frame [m/s].
pub fn linear_velocity_in_base(robot: &RobotView, truth: &Truth) -> Vec3 {
    frames::world_from_base(robot.orientation).inverse() * Vec3::from(truth.base_linear_velocity)
}

/// Half the side of the square under the base whose mean height counts [m].
const UNDER_BASE: f32 = 0.15;

/// Returns the height of the base above the ground under it [m]: above the mean of nine points, so that it does not jump by a step
/// at its edge.
pub fn base_height(robot: &RobotView, truth: &Truth) -> f32 {
    let [x, y, z] = truth.base_position;
    if robot.ground.height_field.is_none() {
        return z - robot.ground.height(x, y);
    }
    let offsets = [-UNDER_BASE, 0.0, UNDER_BASE];
    let heights = offsets.into_iter().flat_map(|dx| offsets.map(|dy| robot.ground.height(x + dx, y + dy)));
    z - heights.sum::<f32>() / 9.0
}

fn write_clipped(entries: &mut [f32], values: impl IntoIterator<Item = f32>, bound: f32) {
    for (entry, value) in entries.iter_mut().zip(values) {
        *entry = value.clamp(-bound, bound);
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, NUM_JOINTS, PerJoint, RobotStates, go2};

    use super::*;

    #[test]
    fn layout_is_that_of_equation_14() {
        let spec = base_spec("walk", &go2(), Vec::new(), 20.0);
        assert_eq!((spec.obs_len(), spec.action_len()), (OBS_LEN, 12));
        assert_eq!(spec.observation_entry(9), "joint_position[FL_hip]");
        assert_eq!(spec.observation_entry(44), "previous_action[RR_calf]");
        assert_eq!((spec.policy_dt, spec.actuator_dt, spec.max_episode_steps), (0.02, 0.005, 1000));
        assert_eq!(privileged_fields().iter().map(|field| field.size).sum::<usize>(), CRITIC_OBS_LEN);
    }

    #[test]
    fn each_quantity_has_its_index() {
        let robot = go2();
        let mut states = RobotStates::new(1);
        states.measured.gyro[0] = [1.0, 2.0, 3.0];
        states.measured.q[0] = std::array::from_fn(|j| robot.control.default_pose[j] as f32 + 0.01 * j as f32);
        states.measured.dq[0] = std::array::from_fn(|j| j as f32 - 5.0);
        let action: PerJoint = std::array::from_fn(|j| 0.05 * j as f32);
        let mut obs = [f32::NAN; OBS_LEN];
        let ground = Ground::FLAT;
        let view = RobotView::of(&states.measured, Some(&states.truth), &ground, 0);
        observe(&view, [0.4, 0.5, 0.6], &robot.control.default_pose_f32(), &action, &mut obs);
        assert_eq!(obs[..9], [1.0, 2.0, 3.0, 0.0, 0.0, -1.0, 0.4, 0.5, 0.6]);
        for j in 0..NUM_JOINTS {
            assert!((obs[9 + j] - 0.01 * j as f32).abs() < 1e-6);
            assert_eq!((obs[21 + j], obs[33 + j]), (states.measured.dq[0][j], action[j]));
        }
    }

    #[test]
    fn privileged_velocity_is_in_the_base_frame_and_without_the_bias_of_the_gyroscope() {
        let mut states = RobotStates::new(1);
        // Turned to the left by 90 degrees: forward is the world's y axis.
        let half = std::f32::consts::FRAC_1_SQRT_2;
        states.measured.orientation[0] = [half, 0.0, 0.0, half];
        states.measured.gyro[0] = [0.2; 3];
        states.truth.base_position[0] = [3.0, 0.0, 0.9];
        states.truth.base_linear_velocity[0] = [0.0, 0.7, 0.1];
        states.truth.base_angular_velocity[0] = [0.1; 3];
        states.truth.foot_force[0] = [10.0, 20.0, 30.0, 40.0];
        let ground = Ground { point: [0.0, 0.0, 0.5], ..Ground::FLAT };
        let view = RobotView::of(&states.measured, Some(&states.truth), &ground, 0);
        let mut obs = [f32::NAN; CRITIC_OBS_LEN];
        observe_privileged(&view, &view.truth.expect("a simulator"), &mut obs);
        let expected = [0.7, 0.0, 0.1, 0.1, 0.1, 0.1, 0.4, 10.0, 20.0, 30.0, 40.0];
        assert!(obs.iter().zip(expected).all(|(one, other)| (one - other).abs() < 1e-6), "{obs:?}");
    }
}
