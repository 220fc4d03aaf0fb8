"""Environments cannot be pickled; their factory can."""

import copy
import multiprocessing
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv

import twinstep
from twinstep import ConnectOptions, EnvFactory
from twinstep.remote import RemoteVecEnv


def sb3_env() -> Any:
    pytest.importorskip("stable_baselines3")
    from twinstep.sb3 import make_vec_env

    return make_vec_env(n_envs=2)


def rsl_rl_env() -> Any:
    pytest.importorskip("rsl_rl")
    from twinstep.rsl_rl import make_vec_env

    return make_vec_env(num_envs=2)


@pytest.mark.parametrize(
    "create",
    [
        lambda: twinstep.Go2Env(task="counter"),
        lambda: twinstep.Go2VectorEnv(2, task="counter"),
        lambda: RemoteVecEnv(ConnectOptions(), num_envs=1, autoreset="Disabled", max_episode_steps=None),
        lambda: gym.make("twinstep/Go2-Walk-v0"),
        sb3_env,
        rsl_rl_env,
    ],
)
@pytest.mark.parametrize("copied", [pickle.dumps, copy.deepcopy])
def test_error_of_pickling_an_environment_names_the_factory(
    create: Callable[[], Any], copied: Callable[[Any], Any]
) -> None:
    env = create()
    with pytest.raises(twinstep.NotPicklableError, match=r"holds a lease on a server\n(.*)`twinstep\.EnvFactory"):
        copied(env)
    env.close()


def test_a_pickled_factory_creates_the_same_environment() -> None:
    factory = EnvFactory(ConnectOptions(critic=True), max_episode_steps=3)
    again = pickle.loads(pickle.dumps(factory))
    assert again == factory
    rows: list[Any] = []
    for create in (factory, again):
        env = create()
        obs, info = env.reset(seed=4)
        steps = [env.step(np.zeros(12, np.float32)) for _ in range(3)]
        rows.append([obs, info["critic_obs"], *(step[0] for step in steps)])
        assert [step[3] for step in steps] == [False, False, True], "truncated after three steps"
        env.close()
    np.testing.assert_equal(rows[0], rows[1])


def test_factories_run_in_the_asynchronous_vector_environments_with_spawn() -> None:
    server = twinstep.EmbeddedServer(("--task", "walk", "--envs", "8"))
    factory = EnvFactory(ConnectOptions(endpoint=server.endpoint))
    with factory() as env:
        expected = env.reset(seed=3)[0]
    envs = AsyncVectorEnv([factory] * 2, context="spawn")
    np.testing.assert_array_equal(envs.reset(seed=3)[0][0], expected)
    envs.close()
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
    envs = vec_env.SubprocVecEnv([factory] * 2, start_method="spawn")
    envs.seed(3)
    np.testing.assert_array_equal(envs.reset()[0], expected)
    envs.close()
    assert not multiprocessing.active_children()
    server.release()
