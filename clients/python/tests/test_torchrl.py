"""The environment passes TorchRL's checker."""

import gymnasium as gym
import pytest

import twinstep

pytest.importorskip("torchrl", reason="TorchRL is not installed: pip install torchrl")

from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

gym.register_envs(twinstep)


def test_the_environment_passes_torchrls_checker() -> None:
    env = GymWrapper(gym.make("twinstep/Go2-Walk-v0"))
    check_env_specs(env)
    env.close()
