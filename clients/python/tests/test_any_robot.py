"""Robots of any tree as Gymnasium environments."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import twinstep

ROBOTS = Path(__file__).parents[3] / "data" / "robots"


@pytest.mark.parametrize(("name", "joints"), [("g1", 29), ("so101", 6)])
def test_robot_of_a_model_file_is_reset_and_stepped(name: str, joints: int) -> None:
    envs = gym.make_vec("twinstep/Pose-v0", num_envs=3, model=str(ROBOTS / f"{name}.toml"))
    try:
        observations, _ = envs.reset(seed=1)
        assert observations.shape == (3, 6 + 4 * joints)
        assert envs.single_action_space.shape == (joints,)
        for _ in range(20):
            observations, rewards, *_ = envs.step(np.zeros((3, joints), np.float32))
        assert np.isfinite(observations).all()
        assert (rewards > -1.1).all()
        assert (rewards <= 0.02).all()
    finally:
        envs.close()


def test_spec_has_the_joints_and_gains_of_the_humanoid() -> None:
    options = twinstep.ConnectOptions(task="pose", model=str(ROBOTS / "g1.toml"))
    envs = twinstep.RemoteVecEnv(options, num_envs=2, autoreset="SameStep", max_episode_steps=None)
    try:
        spec = envs.spec
        assert (spec.robot, len(spec.joint_order), spec.joint_order[3]) == ("g1", 29, "left_knee_joint")
        assert (spec.joint_gains[3], spec.joint_gains[28]) == ((150.0, 4.0), (20.0, 0.5))
        assert spec.action_entry(3) == "joint_position_offset[left_knee_joint]"
    finally:
        envs.close()


def test_humanoid_is_rendered() -> None:
    env = gym.make("twinstep/Pose-v0", model=str(ROBOTS / "g1.toml"), render_mode="rgb_array")
    try:
        env.reset(seed=1)
        image = np.asarray(env.render())
        assert image.ndim == 3
        assert image.std() > 5
    finally:
        env.close()


def test_humanoid_without_gains_is_refused_with_what_is_missing() -> None:
    with pytest.raises(twinstep.ServerStartError, match=r"states no `kp` of joint `left_hip_pitch_joint`"):
        gym.make_vec("twinstep/Pose-v0", num_envs=1, model=str(ROBOTS / "g1.xml"))
