//! Layout of observation and action, and the observation of U2E, eq. 14, for simulator, log and robot.

use twinstep_model::{EnvSpec, JOINT_NAMES, NUM_JOINTS, PerJoint, RobotModel, RobotStates, SpecField, frames};

use crate::{RewardWeights, TaskConfig};

/// Length of an observation.
pub const OBS_LEN: usize = 45;

/// Returns the spec of the task `walk`: layouts, periods, gains and limits.
pub fn walk_spec(robot: &RobotModel, task: &TaskConfig) -> EnvSpec {
    let control = &robot.control;
    EnvSpec {
        task: "walk".to_owned(),
        robot: robot.name.clone(),
        observation: vec![
            field("base_angular_velocity", 3, "rad/s", 50.0, "angular velocity of the base in the base frame, omega_t"),
            field("projected_gravity", 3, "", 1.0, "unit vector of gravity in the base frame, g_t"),
            field(
                "velocity_command",
                3,
                "m/s, m/s, rad/s",
                5.0,
                "commanded velocity in the base frame: forward, left, yaw rate, c_t",
            ),
            field("joint_position", NUM_JOINTS, "rad", 6.3, "position relative to the default pose, q - q_default"),
            field("joint_velocity", NUM_JOINTS, "rad/s", 100.0, "velocity, dq"),
            field("previous_action", NUM_JOINTS, "", 1.0, "action of the previous step, clipped, a_(t-1)"),
        ],
        action: vec![field(
            "joint_position_offset",
            NUM_JOINTS,
            "action_scale",
            1.0,
            "commanded joint position relative to the default pose, in units of action_scale",
        )],
        joint_order: JOINT_NAMES.map(str::to_owned).to_vec(),
        policy_dt: control.policy_dt(),
        actuator_dt: control.actuator_dt(),
        kp: control.kp,
        kd: control.kd,
        action_scale: control.action_scale,
        default_pose: control.default_pose.to_vec(),
        reward_terms: RewardWeights::NAMES.iter().map(|name| (*name).to_owned()).collect(),
        max_episode_steps: (f64::from(task.max_episode_s) / control.policy_dt()).round() as u32,
    }
}

fn field(name: &str, size: usize, unit: &str, bound: f32, text: &str) -> SpecField {
    SpecField {
        name: name.to_owned(),
        size,
        unit: unit.to_owned(),
        low: -bound,
        high: bound,
        description: text.to_owned(),
    }
}

/// Writes the observation of `robot` into `obs` (45 values), clipped to the bounds of [`walk_spec`].
pub fn observe(
    states: &RobotStates,
    robot: usize,
    command: [f32; 3],
    default_pose: &PerJoint,
    previous_action: &PerJoint,
    obs: &mut [f32],
) {
    let gravity = frames::projected_gravity(states.base_orientation[robot]);
    write_clipped(&mut obs[0..3], states.base_angular_velocity[robot], 50.0);
    write_clipped(&mut obs[3..6], gravity.to_array(), 1.0);
    write_clipped(&mut obs[6..9], command, 5.0);
    let q = &states.q[robot];
    write_clipped(&mut obs[9..21], std::array::from_fn::<f32, NUM_JOINTS, _>(|j| q[j] - default_pose[j]), 6.3);
    write_clipped(&mut obs[21..33], states.dq[robot], 100.0);
    obs[33..45].copy_from_slice(previous_action);
}

fn write_clipped<const N: usize>(entries: &mut [f32], values: [f32; N], bound: f32) {
    for (entry, value) in entries.iter_mut().zip(values) {
        *entry = value.clamp(-bound, bound);
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::go2;

    use super::*;

    #[test]
    fn layout_is_that_of_equation_14() {
        let spec = walk_spec(&go2(), &TaskConfig::default());
        assert_eq!((spec.obs_len(), spec.action_len()), (OBS_LEN, 12));
        assert_eq!(spec.observation_entry(9), "joint_position[FL_hip]");
        assert_eq!(spec.observation_entry(44), "previous_action[RR_calf]");
        assert_eq!((spec.policy_dt, spec.actuator_dt, spec.max_episode_steps), (0.02, 0.005, 1000));
    }

    #[test]
    fn each_quantity_has_its_index() {
        let robot = go2();
        let mut states = RobotStates::new(1);
        states.base_angular_velocity[0] = [1.0, 2.0, 3.0];
        states.q[0] = std::array::from_fn(|j| robot.control.default_pose[j] as f32 + 0.01 * j as f32);
        states.dq[0] = std::array::from_fn(|j| j as f32 - 5.0);
        let action: PerJoint = std::array::from_fn(|j| 0.05 * j as f32);
        let mut obs = [f32::NAN; OBS_LEN];
        observe(&states, 0, [0.4, 0.5, 0.6], &robot.control.default_pose_f32(), &action, &mut obs);
        assert_eq!(obs[..9], [1.0, 2.0, 3.0, 0.0, 0.0, -1.0, 0.4, 0.5, 0.6]);
        for j in 0..NUM_JOINTS {
            assert!((obs[9 + j] - 0.01 * j as f32).abs() < 1e-6);
            assert_eq!((obs[21 + j], obs[33 + j]), (states.dq[0][j], action[j]));
        }
    }

    #[test]
    fn hash_depends_on_the_gains_but_not_on_the_episode_length() {
        let task = TaskConfig::default();
        let spec = walk_spec(&go2(), &task);
        let mut other_gain = go2();
        other_gain.control.kp += 1.0;
        assert_ne!(walk_spec(&other_gain, &task).hash(), spec.hash());
        let longer = TaskConfig { max_episode_s: 30.0, ..task };
        assert_eq!(walk_spec(&go2(), &longer).hash(), spec.hash());
    }
}
