"""The ``VecEnv`` for Stable-Baselines3."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import twinstep
from twinstep.sb3 import Go2VecEnv, make_vec_env

ACTIONS = np.zeros((3, 12), np.float32)


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def test_the_environment_passes_the_checker_of_stable_baselines3() -> None:
    env = gym.make("twinstep/Go2-Walk-v0")
    check_env(env)
    env.close()


def test_rows_equal_those_of_the_gymnasium_environment() -> None:
    ours = make_vec_env(n_envs=3, seed=5, max_episode_steps=4)
    envs = gym.make_vec("twinstep/Go2-Walk-v0", num_envs=3, autoreset_mode="SameStep", max_episode_steps=4)
    np.testing.assert_array_equal(ours.reset(), envs.reset(seed=5)[0])
    for _ in range(4):
        obs, reward, done, infos = ours.step(ACTIONS)
        expected_obs, expected_reward, _, truncated, info = envs.step(ACTIONS)
        np.testing.assert_array_equal(obs, expected_obs)
        np.testing.assert_array_equal(reward, expected_reward.astype(np.float32))
        np.testing.assert_array_equal(done, truncated)
    assert done.all()
    for row, one in enumerate(infos):
        np.testing.assert_array_equal(one["terminal_observation"], info["final_obs"][row])
        assert one["TimeLimit.truncated"] is True
        assert one["reward_terms"]["joint_torque"] == info["final_info"]["reward_terms"]["joint_torque"][row]
    ours.close()
    envs.close()


def test_privileged_observations_are_in_the_infos_with_the_option_critic() -> None:
    envs = make_vec_env(n_envs=2, seed=1, critic=True, max_episode_steps=2)
    envs.reset()
    assert envs.reset_infos[0]["critic_obs"].shape == (11,)
    envs.step(ACTIONS[:2])
    *_, done, infos = envs.step(ACTIONS[:2])
    assert done.all()
    assert infos[1]["critic_obs"].shape == infos[1]["terminal_critic_obs"].shape == (11,)
    assert (infos[1]["critic_obs"] != infos[1]["terminal_critic_obs"]).any()
    np.testing.assert_array_equal(infos[1]["critic_obs"], envs.reset_infos[1]["critic_obs"])
    envs.close()


def test_a_seed_is_used_by_one_reset() -> None:
    envs = make_vec_env(n_envs=3)
    assert envs.seed(7) == [7, 8, 9]
    first, second = envs.reset(), envs.reset()
    envs.seed(7)
    np.testing.assert_array_equal(envs.reset(), first)
    np.testing.assert_array_equal(envs.reset(), second)
    assert not np.array_equal(first, second)
    envs._seeds = [7, None, 9]
    np.testing.assert_array_equal(envs.reset()[[0, 2]], first[[0, 2]])
    envs.close()


def test_resetting_a_row_does_not_change_the_others() -> None:
    envs = make_vec_env(n_envs=3, seed=1)
    start = envs.reset()
    for _ in range(5):
        obs, *_ = envs.step(ACTIONS)
    [(again, info)] = envs.env_method("reset", seed=2, indices=1)
    np.testing.assert_array_equal(again, start[1])
    assert not np.array_equal(obs[1], start[1])
    assert info == {}
    envs.close()


def test_rows_have_separate_attributes() -> None:
    envs = make_vec_env(n_envs=3)
    envs.set_attr("level", 1)
    envs.set_attr("level", 2, indices=[2])
    assert envs.get_attr("level") == [1, 1, 2]
    assert envs.get_attr("render_mode", indices=0) == [None]
    assert envs.has_attr("level")
    assert not envs.has_attr("depth")
    with pytest.raises(AttributeError, match="`render_mode` is the same for all robots"):
        envs.set_attr("render_mode", "human")
    envs.close()


def test_options_are_rejected() -> None:
    envs = make_vec_env(n_envs=3)
    envs.set_options({})
    with pytest.raises(twinstep.InvalidOptionError, match=r"`options` has \['slope'\]"):
        envs.set_options({"slope": 1})
    envs.close()


def test_images_are_tiled() -> None:
    envs = make_vec_env(n_envs=3, render_mode="rgb_array")
    envs.reset()
    assert [image.shape for image in envs.get_images() if image is not None] == [(480, 640, 3)] * 3
    picture = envs.render()
    assert picture is not None
    assert picture.shape == (960, 1280, 3)
    assert envs.env_method("render", indices=[1])[0].shape == (480, 640, 3)
    assert envs.metadata["render_fps"] == 50
    envs.close()


def test_other_autoreset_modes_are_rejected() -> None:
    envs: Any = gym.make_vec("twinstep/Go2-Walk-v0", num_envs=1)
    with pytest.raises(twinstep.InvalidOptionError, match="Stable-Baselines3 needs 'SameStep'"):
        Go2VecEnv(envs)
    envs.close()


def test_ppo_trains_for_a_few_hundred_steps() -> None:
    envs = VecNormalize(VecMonitor(make_vec_env(n_envs=8, max_episode_steps=25)))
    agent = PPO("MlpPolicy", envs, n_steps=32, batch_size=64, n_epochs=1, seed=1, device="cpu")
    agent.learn(512)
    assert agent.ep_info_buffer is not None
    assert {episode["l"] for episode in agent.ep_info_buffer} == {25}
    envs.close()


def test_sac_trains_for_a_few_hundred_steps() -> None:
    envs = VecNormalize(VecMonitor(make_vec_env(n_envs=8, max_episode_steps=25)))
    agent = SAC("MlpPolicy", envs, learning_starts=100, batch_size=64, buffer_size=1000, seed=1, device="cpu")
    agent.learn(400)
    assert agent.num_timesteps == 400
    # A time limit is not a failure: the critic bootstraps from the last observation.
    assert agent.replay_buffer is not None
    assert agent.replay_buffer.timeouts.sum() == 16  # type: ignore[attr-defined]
    envs.close()
