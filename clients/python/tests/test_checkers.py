"""The environments pass Gymnasium's checkers and work with its wrappers."""

import pickle
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.utils.env_match import check_environments_match
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

import twinstep

WALK = "twinstep/Go2-Walk-v0"
MODES = ["NextStep", "SameStep", "Disabled"]


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    server = twinstep.EmbeddedServer(("--task", "walk", "--envs", "64"))
    yield server.endpoint
    server.release()


def random_actions(steps: int, num_envs: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return actions (steps, num_envs, 12)."""
    return np.random.default_rng(3).uniform(-1, 1, (steps, num_envs, 12)).astype(np.float32)


TASKS = ("Track", "Jump", "Gait", "Attitude", "Getup")


@pytest.mark.parametrize("task", [WALK, *(f"twinstep/Go2-{task}-v0" for task in TASKS)])
def test_the_environment_passes_gymnasiums_checker(task: str) -> None:
    env = gym.make(task)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_the_rendered_environment_passes_gymnasiums_checker() -> None:
    env = gym.make(WALK, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_a_remote_environment_passes_gymnasiums_checker(endpoint: str) -> None:
    env = gym.make(WALK, endpoint=endpoint)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_remote_and_embedded_match(endpoint: str) -> None:
    embedded, remote = gym.make(WALK), gym.make(WALK, endpoint=endpoint)
    check_environments_match(embedded, remote, num_steps=1000)
    embedded.close()
    remote.close()


@pytest.mark.parametrize("mode", MODES)
def test_recorded_lengths_are_exact(mode: str) -> None:
    envs = RecordEpisodeStatistics(gym.make_vec(WALK, num_envs=3, autoreset_mode=mode, max_episode_steps=20))
    envs.reset(seed=1)
    for actions in random_actions(70, 3):
        _, _, terminated, truncated, _ = envs.step(actions)
        done = terminated | truncated
        if mode == "Disabled" and done.any():
            envs.reset(options={"reset_mask": done})
    envs.close()
    assert list(envs.length_queue) == [20] * 9


def test_recorded_returns_are_the_sum_of_the_reward_terms() -> None:
    envs = RecordEpisodeStatistics(gym.make_vec(WALK, num_envs=2, max_episode_steps=20))
    envs.reset(seed=1)
    for actions in random_actions(20, 2):
        *_, info = envs.step(actions)
    envs.close()
    terms = sum(value for name, value in info["reward_terms"].items() if not name.startswith("_"))
    np.testing.assert_allclose(info["episode"]["r"], terms, rtol=1e-4, atol=1e-5)


def test_vector_observations_are_normalised() -> None:
    envs = NormalizeObservation(gym.make_vec(WALK, num_envs=8))
    envs.reset(seed=1)
    obs = np.stack([envs.step(actions)[0] for actions in random_actions(100, 8)])
    envs.close()
    assert np.isfinite(obs).all()
    assert np.abs(obs[50:].mean(axis=(0, 1))).max() < 2


def test_the_spec_survives_json_and_pickle() -> None:
    envs = gym.make(WALK, max_episode_steps=30)
    spec = envs.spec
    assert spec is not None
    envs.close()
    for read in (EnvSpec.from_json(spec.to_json()), pickle.loads(pickle.dumps(spec))):
        assert read == spec
        again = gym.make(read)
        assert again.spec == spec
        again.close()


@pytest.mark.parametrize("mode", MODES)
def test_a_row_is_the_single_environment_of_its_seed(mode: str, endpoint: str) -> None:
    steps = 15
    envs = gym.make_vec(WALK, num_envs=4, autoreset_mode=mode, endpoint=endpoint)
    single = gym.make(WALK, endpoint=endpoint)
    actions = random_actions(steps, 4)
    first, _ = envs.reset(seed=11)
    rows = [envs.step(action) for action in actions]
    for row in (0, 3):
        obs, _ = single.reset(seed=11 + row)
        np.testing.assert_array_equal(obs, first[row])
        for action, (obs_all, reward, terminated, truncated, _) in zip(actions, rows, strict=True):
            expected = (obs_all[row], reward[row], terminated[row], truncated[row])
            assert data_equivalence(single.step(action[row])[:4], tuple(map(_plain, expected)))
    envs.close()
    single.close()


def _plain(value: Any) -> Any:
    return value.item() if np.ndim(value) == 0 else value
