"""Robots of any tree as Gymnasium environments."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import twinstep

ROBOTS = Path(__file__).parents[3] / "data" / "robots"


@pytest.mark.parametrize(("name", "joints"), [("g1", 29), ("so101", 6)])
def test_robot_of_a_model_file_is_reset_and_stepped(name: str, joints: int) -> None:
    envs = gym.make_vec("twinstep/Pose-v0", num_envs=3, robot=str(ROBOTS / f"{name}.toml"))
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


@pytest.mark.parametrize(
    ("robot", "joints", "feet"), [("g1", 29, 2), (str(ROBOTS / "anymal_c.toml"), 12, 4), ("go2", 12, 4)]
)
def test_legged_robot_walks(robot: str, joints: int, feet: int) -> None:
    envs = gym.make_vec("twinstep/Walk-v0", num_envs=2, robot=robot, critic=True)
    try:
        observations, info = envs.reset(seed=1)
        assert observations.shape == (2, 9 + 3 * joints)
        assert info["critic_obs"].shape == (2, 7 + feet)
        observations, rewards, *_ = envs.step(np.zeros((2, joints), np.float32))
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
    finally:
        envs.close()


@pytest.mark.parametrize(("robot", "task", "joints"), [("g1", "Walk", 29), ("so101", "Pose", 6)])
def test_mujoco_steps_the_same_robot(
    robot: str, task: str, joints: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setenv("TWINSTEP_PYTHON", sys.executable)
    observed = []
    for engine in ("batch", "mujoco"):
        config = tmp_path / f"{engine}.toml"
        config.write_text(f'[sim]\nengine = "{engine}"\n')
        envs = gym.make_vec(f"twinstep/{task}-v0", num_envs=2, robot=robot, config=str(config))
        try:
            observations, _ = envs.reset(seed=3)
            for step in range(15):
                observations, *_ = envs.step(np.full((2, joints), 0.2 * np.sin(0.3 * step), np.float32))
            observed.append(observations)
        finally:
            envs.close()
    start = 9 if task == "Walk" else 6
    difference = np.abs(observed[0] - observed[1])
    assert difference[:, 3:6].max() < 0.01, "the base has the same attitude"
    assert difference[:, start : start + joints].max() < 0.01, "joint positions"


def test_arm_has_no_feet_to_walk_on() -> None:
    with pytest.raises(twinstep.ServerStartError, match="`pose` for a robot whose base is fixed"):
        gym.make_vec("twinstep/Walk-v0", num_envs=1, robot="so101")
    with pytest.raises(twinstep.InvalidOptionError, match="`robot` and `model` are both the robot"):
        gym.make_vec("twinstep/Walk-v0", num_envs=1, robot="g1", model="g1")


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
