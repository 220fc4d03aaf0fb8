"""TorchRL's checker passes."""

import gymnasium as gym
import pytest

import twinstep

pytest.importorskip("torchrl", reason="TorchRL is not installed: pip install torchrl")

from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

gym.register_envs(twinstep)


def test_torchrl_checks_the_environment() -> None:
    env = GymWrapper(gym.make("twinstep/Go2-Walk-v0"))
    check_env_specs(env)
    env.close()
