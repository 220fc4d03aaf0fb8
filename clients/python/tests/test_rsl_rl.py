"""The ``VecEnv`` for rsl_rl."""

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rsl_rl", reason='rsl_rl is not installed: pip install "twinstep[rsl-rl]"')

import torch
from rsl_rl.runners import OnPolicyRunner

from twinstep.rsl_rl import make_vec_env

MODEL = {"class_name": "MLPModel", "hidden_dims": [32], "activation": "elu"}


def config() -> dict[str, Any]:
    """Return the configuration of a small PPO."""
    gaussian = {"class_name": "GaussianDistribution", "init_std": 0.4}
    return {
        "num_steps_per_env": 12,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "algorithm": {"class_name": "PPO", "num_mini_batches": 2, "num_learning_epochs": 1},
        "actor": {**MODEL, "distribution_cfg": gaussian},
        "critic": dict(MODEL),
    }


def test_the_runner_trains_for_two_iterations(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    envs = make_vec_env(num_envs=8, seed=1, max_episode_steps=10)
    runner = OnPolicyRunner(envs, config(), log_dir=str(tmp_path), device="cpu")
    runner.learn(2, init_at_random_ep_len=True)
    envs.close()
    assert (tmp_path / "model_1.pt").exists()


def test_the_runner_trains_with_a_privileged_critic(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    envs = make_vec_env(num_envs=4, seed=1, critic=True)
    runner = OnPolicyRunner(
        envs,
        {**config(), "obs_groups": {"actor": ["policy"], "critic": ["policy", "critic"]}},
        log_dir=str(tmp_path),
        device="cpu",
    )
    runner.learn(1)
    observations = envs.get_observations()
    envs.close()
    assert observations["policy"].shape == (4, 45)
    assert observations["critic"].shape == (4, 11)


def test_time_outs_are_distinguished_from_failures() -> None:
    envs = make_vec_env(num_envs=3, seed=1, max_episode_steps=4)
    ends = [envs.step(torch.zeros(3, 12)) for _ in range(4)]
    envs.close()
    assert [done.tolist() for _, _, done, _ in ends] == [[False] * 3] * 3 + [[True] * 3]
    _, reward, _, extras = ends[-1]
    assert reward.dtype == torch.float32
    assert extras["time_outs"].tolist() == [1.0] * 3
    assert "/reward/joint_torque" in extras["log"]
    assert envs.episode_length_buf.tolist() == [0] * 3


def test_an_episode_length_written_by_the_runner_ends_the_episode_early() -> None:
    envs = make_vec_env(num_envs=3, seed=1, max_episode_steps=4)
    envs.episode_length_buf = torch.tensor([0, 3, 0])
    _, _, done, extras = envs.step(torch.zeros(3, 12))
    envs.close()
    assert done.tolist() == [False, True, False]
    assert extras["time_outs"].tolist() == [0.0, 1.0, 0.0]
    assert envs.episode_length_buf.tolist() == [1, 0, 1]
