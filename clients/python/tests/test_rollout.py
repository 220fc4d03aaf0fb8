"""Rollouts on the server: the numbers of a policy in this process, and errors that name the argument."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import twinstep
from twinstep import codec
from twinstep.rollout import encode_policy, read_trajectory

GOLDEN = Path(__file__).parents[3] / "protocol" / "golden"
STEPS, NUM_ENVS = 12, 3


def golden(name: str) -> dict[str, Any]:
    return codec.decode((GOLDEN / f"{name}.msgpack").read_bytes())


def policy(seed: int = 0, std: float = 0.2) -> twinstep.GaussianPolicy:
    random = np.random.default_rng(seed)
    layers = [
        (random.normal(size=(20, 45)) * 0.1, random.normal(size=20)),
        (random.normal(size=(12, 20)) * 0.1, np.zeros(12)),
    ]
    return twinstep.GaussianPolicy(layers, np.full(12, np.log(std)), np.full(45, 0.1), np.full(45, 0.7))


def mean_actions(policy: twinstep.GaussianPolicy, obs: NDArray[np.float32]) -> NDArray[np.float64]:
    assert policy.mean is not None
    assert policy.std is not None
    units = np.clip((obs - np.asarray(policy.mean)) / np.asarray(policy.std), -10, 10)
    for index, (weight, bias) in enumerate(policy.layers):
        units = units @ np.asarray(weight).T + np.asarray(bias)
        if index + 1 < len(policy.layers):
            units = np.maximum(units, 0)
    return units


def test_trajectory_is_that_of_steps_with_its_actions() -> None:
    rolled = twinstep.Go2VectorEnv(NUM_ENVS, autoreset_mode="SameStep", max_episode_steps=5, critic=True)
    stepped = twinstep.Go2VectorEnv(NUM_ENVS, autoreset_mode="SameStep", max_episode_steps=5, critic=True)
    obs, info = rolled.reset(seed=3)
    stepped.reset(seed=3)
    first = rolled.rollout(policy(), STEPS, noise_seed=1)
    np.testing.assert_array_equal(first.obs[0], obs)
    np.testing.assert_array_equal(first.critic_obs[0], info["critic_obs"])
    ended = 0
    for step in range(STEPS):
        obs, reward, terminated, truncated, info = stepped.step(first.actions[step])
        np.testing.assert_array_equal(first.obs[step + 1], obs)
        np.testing.assert_array_equal(first.reward[step], reward)
        np.testing.assert_array_equal(first.terminated[step], terminated)
        np.testing.assert_array_equal(first.truncated[step], truncated)
        for row in np.flatnonzero(first.ended_step == step):
            env = first.ended_env[row]
            np.testing.assert_array_equal(first.final_obs[row], info["final_obs"][env])
            np.testing.assert_array_equal(first.final_critic_obs[row], info["final_info"]["critic_obs"][env])
            ended += 1
    assert ended == len(first.ended_env) >= 2 * NUM_ENVS
    # The held policy gives the same as one that is sent.
    again = rolled.rollout(policy(), STEPS, noise_seed=2)
    assert not np.array_equal(again.actions, first.actions)
    np.testing.assert_array_equal(again.obs[0], first.obs[-1])
    rolled.close()
    stepped.close()


def test_equal_seeds_give_equal_numbers_and_the_density_is_that_of_the_actions() -> None:
    env = twinstep.Go2VectorEnv(NUM_ENVS)
    env.reset(seed=3)
    first = env.rollout(policy(), STEPS, noise_seed=7)
    env.reset(seed=3)
    again = env.rollout(policy(), STEPS, noise_seed=7)
    np.testing.assert_array_equal(first.obs, again.obs)
    np.testing.assert_array_equal(first.actions, again.actions)
    noise = (first.actions - mean_actions(policy(), first.obs[:-1])) / 0.2
    expected = (-0.5 * noise**2 - np.log(0.2) - 0.5 * np.log(2 * np.pi)).sum(axis=-1)
    np.testing.assert_allclose(first.log_prob, expected, atol=2e-3)
    env.close()


def test_golden_messages_are_written_and_read() -> None:
    lease = golden("lease_reply")
    spec = codec.read_spec(lease, "")
    request = golden("rollout_request")
    weights = np.frombuffer(request["policy"]["weights"], "<f4")
    one_layer = twinstep.GaussianPolicy(
        [(weights[:10].reshape(2, 5), weights[10:])],
        np.frombuffer(request["policy"]["log_std"], "<f4"),
        np.frombuffer(request["policy"]["mean"], "<f4"),
        np.frombuffer(request["policy"]["std"], "<f4"),
    )
    assert encode_policy(one_layer, spec) == request["policy"]
    trajectory = read_trajectory(golden("rollout_reply"), 2, 2, spec)
    assert trajectory.obs.shape == (3, 2, 5)
    assert trajectory.actions[1, 0].tolist() == [1.5, 0.25]
    assert trajectory.truncated.tolist() == [[True, False], [False, False]]
    assert trajectory.ended_env.tolist() == trajectory.ended_step.tolist() == [0, 1]
    assert trajectory.final_obs.shape == (2, 5)
    with pytest.raises(twinstep.MalformedError, match="`obs` has"):
        read_trajectory(golden("rollout_reply"), 3, 2, spec)


def test_errors_name_the_argument_and_nothing_is_stepped() -> None:
    env = twinstep.Go2VectorEnv(NUM_ENVS)
    with pytest.raises(twinstep.ResetNeededError):
        env.rollout(policy(), 1, noise_seed=1)
    env.reset(seed=3)
    good = policy()
    with pytest.raises(twinstep.InvalidOptionError, match="`steps` = 129 is not allowed: 1 to 128"):
        env.rollout(good, 129, noise_seed=1)
    with pytest.raises(twinstep.InvalidOptionError, match="`noise_seed` = -1"):
        env.rollout(good, 1, noise_seed=-1)
    bad = twinstep.GaussianPolicy([(np.zeros((12, 44)), np.zeros(12))], np.zeros(12))
    with pytest.raises(twinstep.InvalidOptionError, match=r"weight of layer 0 is float64 \(12, 44\)"):
        env.rollout(bad, 1, noise_seed=1)
    nan = twinstep.GaussianPolicy([(np.full((12, 45), np.nan), np.zeros(12))], np.zeros(12))
    with pytest.raises(twinstep.InvalidOptionError, match="weight of layer 0 has an entry that is NaN"):
        env.rollout(nan, 1, noise_seed=1)
    loud = twinstep.GaussianPolicy(good.layers, np.full(12, 30.0))
    with pytest.raises(twinstep.RequestRejectedError, match=r"`policy\.log_std` has 30"):
        env.rollout(loud, 1, noise_seed=1)
    first = env.rollout(good, 1, noise_seed=1)
    env.reset(seed=3)
    np.testing.assert_array_equal(env.rollout(good, 1, noise_seed=1).obs, first.obs)
    env.close()


def test_rollout_is_not_offered_without_autoreset_or_with_several_servers() -> None:
    env = twinstep.Go2VectorEnv(NUM_ENVS, autoreset_mode="Disabled")
    env.reset(seed=3)
    with pytest.raises(twinstep.RequestRejectedError, match="autoreset `Disabled`"):
        env.rollout(policy(), 1, noise_seed=1)
    env.close()
