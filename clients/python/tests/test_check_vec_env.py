"""The checker accepts correct environments and names the violation of incorrect ones."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from twinstep.checker import VecEnvError, check_vec_env
from twinstep.sb3 import make_vec_env

N, LENGTH = 3, 5


class Good(VecEnv):
    """A correct ``VecEnv``: random walks of five steps in a square."""

    render_mode = None

    def __init__(self) -> None:
        self.attributes: list[dict[str, Any]] = [{"render_mode": None} for _ in range(N)]
        self.generators = [np.random.default_rng() for _ in range(N)]
        self.position = np.zeros((N, 2), np.float32)
        self.age = np.zeros(N, int)
        super().__init__(N, gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (2,)))

    def start(self, env: int) -> None:
        self.age[env] = 0
        self.position[env] = self.generators[env].uniform(-1, 1, 2)

    def reset(self) -> Any:
        for env, seed in enumerate(self._seeds):
            if seed is not None:
                self.generators[env] = np.random.default_rng(seed)
            self.start(env)
        self._reset_seeds()
        return self.position.copy()

    def step_async(self, actions: Any) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        self.position = np.clip(self.position + 0.1 * self.actions, -1, 1).astype(np.float32)
        self.age += 1
        infos: list[dict[str, Any]] = [{} for _ in range(N)]
        done = self.age >= LENGTH
        for env in np.flatnonzero(done):
            infos[env] = {"terminal_observation": self.position[env].copy(), "TimeLimit.truncated": True}
            self.start(env)
        return self.position.copy(), np.ones(N, np.float32), done, infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [self.attributes[env][attr_name] for env in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        for env in self._get_indices(indices):
            self.attributes[env][attr_name] = value

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        return [method(*method_args, **method_kwargs) for method in self.get_attr(method_name, indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def changed(**methods: Any) -> VecEnv:
    """Create a VecEnv that is correct except for ``methods``."""
    return type("Bad", (Good,), methods)()


def changed_step(change: Any) -> VecEnv:
    """Create a VecEnv that applies ``change`` to the results of a step."""
    return changed(step_wait=lambda self: change(*Good.step_wait(self)))


def with_infos(change: Any) -> VecEnv:
    """Create a VecEnv that applies ``change`` to the infos of ended episodes."""

    def step(obs: Any, reward: Any, done: Any, infos: Any) -> Any:
        for env in np.flatnonzero(done):
            change(infos[env])
        return obs, reward, done, infos

    return changed_step(step)


def late_nan(obs: Any, reward: Any, done: Any, infos: Any) -> Any:
    if done.any():
        reward[1] = np.nan
    return obs, reward, done, infos


def outside(obs: Any, reward: Any, done: Any, infos: Any) -> Any:
    obs[2, 1] = 1.5
    return obs, reward, done, infos


def reused_obs(self: Any) -> Any:
    obs, *rest = Good.step_wait(self)
    self.buffer = getattr(self, "buffer", np.zeros_like(obs))
    self.buffer[:] = obs
    return self.buffer, *rest


def terminal_view(self: Any) -> Any:
    obs, reward, done, infos = Good.step_wait(self)
    for env in np.flatnonzero(done):
        infos[env]["terminal_observation"] = obs[env]
    return obs, reward, done, infos


def unseeded_reset(self: Any) -> Any:
    self._reset_seeds()
    return Good.reset(self)


def reset_that_keeps_seeds(self: Any) -> Any:
    seeds = list(self._seeds)
    obs = Good.reset(self)
    self._seeds = seeds
    return obs


def step_async_that_scales(self: Any, actions: Any) -> None:
    actions *= 0.5
    Good.step_async(self, actions)


def step_that_differs(self: Any, actions: Any) -> Any:
    self.step_async(0.5 * actions)
    return self.step_wait()


def close_once(self: Any) -> None:
    del self.position


def first_only(method: Any) -> Any:
    return lambda self, *args, indices=None, **kwargs: method(self, *args, indices=0, **kwargs)


def set_everywhere(self: Any, attr_name: str, value: Any, indices: Any = None) -> None:
    Good.set_attr(self, attr_name, value)


def raises(self: Any, *args: Any, **kwargs: Any) -> None:
    raise NotImplementedError("not for this simulator")


INCORRECT: dict[str, tuple[Any, str]] = {
    "gymnasium vector env": (lambda: gym.make_vec("CartPole-v1", 2), "is not a `VecEnv`"),
    "float64 obs": (lambda: changed_step(lambda o, *r: (o.astype(float), *r)), r"obs is float64 \(3, 2\)"),
    "list obs": (lambda: changed_step(lambda o, *r: (o.tolist(), *r)), "obs is list of 3"),
    "batched obs shape": (lambda: changed(reset=lambda self: Good.reset(self)[:2]), r"obs is float32 \(2, 2\)"),
    "obs outside": (lambda: changed_step(outside), r"environment 2: obs\[1\] is 1.5\n  expected: within \[-1.0, 1.0\]"),
    "reset gives a tuple": (lambda: changed(reset=lambda self: (Good.reset(self), {})), "obs is tuple of 2"),
    "five results": (lambda: changed_step(lambda o, r, d, i: (o, r, d, d, i)), "`step_wait` returned tuple of 5"),
    "integer reward": (lambda: changed_step(lambda o, r, d, i: (o, r.astype(int), d, i)), "reward is int64"),
    "list reward": (lambda: changed_step(lambda o, r, d, i: (o, r.tolist(), d, i)), "reward is list of 3"),
    "column reward": (lambda: changed_step(lambda o, r, d, i: (o, r[:, None], d, i)), r"reward is float32 \(3, 1\)"),
    "nan reward": (lambda: changed_step(late_nan), "environment 1: reward is nan"),
    "integer done": (lambda: changed_step(lambda o, r, d, i: (o, r, d.astype(int), i)), "done is int64"),
    "infos dict": (lambda: changed_step(lambda o, r, d, i: (o, r, d, {})), "infos returned dict of 0"),
    "short infos": (lambda: changed_step(lambda o, r, d, i: (o, r, d, i[:2])), "infos returned 2 entries"),
    "shared infos": (lambda: changed_step(lambda o, r, d, i: (o, r, d, [{}] * N)), r"infos\[1\] is the same object"),
    "no terminal_observation": (
        lambda: with_infos(lambda info: info.pop("terminal_observation")),
        "environment 0: done, but infos has no `terminal_observation`",
    ),
    "terminal outside": (
        lambda: with_infos(lambda info: info.update(terminal_observation=np.full(2, 9, np.float32))),
        r"environment 0: terminal_observation\[0\] is 9.0",
    ),
    "terminal shape": (
        lambda: with_infos(lambda info: info.update(terminal_observation=np.zeros((1, 2), np.float32))),
        r"terminal_observation is float32 \(1, 2\)",
    ),
    "terminal view": (lambda: changed(step_wait=terminal_view), "terminal_observation shares memory with obs"),
    "no TimeLimit.truncated": (
        lambda: with_infos(lambda info: info.pop("TimeLimit.truncated")),
        "`TimeLimit.truncated` is None",
    ),
    "reused obs": (lambda: changed(step_wait=reused_obs), "a later step overwrote obs of step 1"),
    "unseeded": (lambda: changed(reset=unseeded_reset), "two rollouts .* differ in obs of step 0"),
    "seed kept": (lambda: changed(reset=reset_that_keeps_seeds), "the second `reset` after `seed` returned the same"),
    "actions changed": (lambda: changed(step_async=step_async_that_scales), "wrote into its argument `actions`"),
    "step differs": (lambda: changed(step=step_that_differs), "`step`, and `step_async` .* differ in obs of step 1"),
    "close once": (lambda: changed(close=close_once), r"`close\(\)` raised AttributeError"),
    "get_attr of one": (lambda: changed(get_attr=first_only(Good.get_attr)), "`get_attr` returned 1 entries"),
    "set_attr everywhere": (
        lambda: changed(set_attr=set_everywhere),
        "environment 0: the attribute is 'after' after `set_attr` with indices=2",
    ),
    "no env_method": (lambda: changed(env_method=raises), "raised NotImplementedError: not for this simulator"),
    "env_is_wrapped of none": (
        lambda: changed(env_is_wrapped=lambda *a, **k: False),
        "`env_is_wrapped` .* returned bool",
    ),
}


def test_a_correct_vec_env_passes() -> None:
    check_vec_env(Good(), steps=20)


def test_dummy_vec_env_of_stable_baselines3_passes() -> None:
    check_vec_env(DummyVecEnv([lambda: gym.make("CartPole-v1")] * 3))


def test_discrete_observations_pass() -> None:
    check_vec_env(DummyVecEnv([lambda: gym.make("FrozenLake-v1")] * 2))


def test_dict_observations_pass() -> None:
    check_vec_env(DummyVecEnv([BitFlippingEnv]), steps=50)


def test_robots_pass() -> None:
    check_vec_env(make_vec_env(n_envs=3, max_episode_steps=20), steps=50)


def test_robots_in_a_monitor_pass() -> None:
    check_vec_env(VecMonitor(make_vec_env(n_envs=1, max_episode_steps=20)), steps=30)


def test_a_rollout_without_an_end_of_an_episode_warns() -> None:
    with pytest.warns(UserWarning, match="no episode ended within 4 steps"):
        check_vec_env(Good(), steps=4)


@pytest.mark.parametrize("name", INCORRECT)
def test_the_error_of_an_incorrect_vec_env_names_the_violation(name: str) -> None:
    make, message = INCORRECT[name]
    with pytest.raises(VecEnvError, match=message) as caught:
        check_vec_env(make(), steps=20)
    assert "\n  expected: " in str(caught.value)
