"""Checks of the results of ``reset`` and ``step_wait`` of a ``VecEnv``, for :mod:`twinstep.checker`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from .errors import Error

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

Array = NDArray[Any]
AnySpace = spaces.Space[Any]


class VecEnvError(Error, AssertionError):
    """A ``VecEnv`` violates the contract of Stable-Baselines3.

    Attributes
    ----------
    env : int or None
        Index of the environment; ``None`` if it is not a single one.
    expected : str
        What Stable-Baselines3 requires.
    """

    def __init__(self, found: str, *, expected: str, env: int | None = None) -> None:
        where = "" if env is None else f"environment {env}: "
        super().__init__(f"{where}{found}\n  expected: {expected}")
        self.env = env
        self.expected = expected


@dataclass(frozen=True)
class ReturnedArray:
    """An array that a ``VecEnv`` returned.

    Attributes
    ----------
    name
        Name of the result.
    env
        Index of its environment; ``None`` if it has one row per environment.
    array
        The array, into which the ``VecEnv`` could write later.
    snapshot
        Copy of the array when it was returned.
    """

    name: str
    env: int | None
    array: Array
    snapshot: Array


def check_reset(env: "VecEnv", obs: object) -> list[ReturnedArray]:
    """Check the result of ``reset``, and return its arrays."""
    check_infos(env.reset_infos, "`reset_infos`", env.num_envs)
    return _check_obs(env, obs)


def check_step(env: "VecEnv", returned: object) -> list[ReturnedArray]:
    """Check the result of ``step_wait``, and return its arrays: observations, reward, done, ends of episodes."""
    if not isinstance(returned, tuple) or len(cast(tuple[Any, ...], returned)) != 4:
        found = f"`step_wait` returned {_type_of(returned)}"
        raise VecEnvError(found, expected="a tuple of 4: obs, reward, done, infos")
    obs, reward, done, infos = cast(tuple[Any, ...], returned)
    results = _check_obs(env, obs)
    # The dtype is float32 in DummyVecEnv, float64 in SubprocVecEnv.
    wide = isinstance(reward, np.ndarray) and cast(Array, reward).dtype == np.float64
    reward = _check_array(reward, "reward", (env.num_envs,), "float64" if wide else "float32")
    done = _check_array(done, "done", (env.num_envs,), "bool")
    for index in np.flatnonzero(~np.isfinite(reward)):
        raise VecEnvError(f"reward is {reward[index]}", expected="a finite number", env=int(index))
    check_infos(infos, "infos", env.num_envs)
    ends = [_check_end(env, infos[index], int(index), results) for index in np.flatnonzero(done)]
    return [
        *results,
        ReturnedArray("reward", None, reward, reward.copy()),
        ReturnedArray("done", None, done, done.copy()),
        *(result for end in ends for result in end),
    ]


def check_list(values: object, name: str, length: int) -> None:
    """Check that there is one entry per requested environment. ``SubprocVecEnv`` returns tuples."""
    if not isinstance(values, list | tuple):
        raise VecEnvError(f"{name} returned {_type_of(values)}", expected=f"a list of {length}")
    found = len(cast(Sequence[Any], values))
    if found != length:
        raise VecEnvError(f"{name} returned {found} entries", expected=f"{length}, one per requested environment")


def check_infos(infos: Any, name: str, length: int) -> None:
    """Check that each environment has a separate dict."""
    check_list(infos, name, length)
    for index, info in enumerate(infos):
        if not isinstance(info, dict):
            raise VecEnvError(f"{name}[{index}] is {_type_of(info)}", expected="a dict", env=index)
        if any(info is other for other in infos[:index]):
            expected = "a separate dict per environment, because wrappers write into it"
            raise VecEnvError(f"{name}[{index}] is the same object as another entry", expected=expected, env=index)


def _check_end(env: "VecEnv", info: dict[str, Any], index: int, obs: list[ReturnedArray]) -> list[ReturnedArray]:
    """Check the info at the end of an episode, and return its last observation."""
    if "terminal_observation" not in info:
        expected = "the last observation of the ended episode; obs has the first one of the next"
        raise VecEnvError("done, but infos has no `terminal_observation`", expected=expected, env=index)
    truncated = info.get("TimeLimit.truncated")
    if not isinstance(truncated, bool | np.bool_):
        found = f"done, but infos' `TimeLimit.truncated` is {truncated!r}"
        expected = "a bool, true if the time limit ended the episode and the task did not"
        raise VecEnvError(found, expected=expected, env=index)
    results: list[ReturnedArray] = []
    whole = cast(AnySpace, env.observation_space)
    for name, space, value in _leaves(whole, info["terminal_observation"], "terminal_observation", index):
        # Discrete observations are often of type int, which Stable-Baselines3 accepts.
        value = np.asarray(value, space.dtype) if isinstance(value, int) else value
        array = _check_array(value, name, space.shape or (), space.dtype, index)
        _check_in_space(space, array[np.newaxis], name, [index])
        if any(np.shares_memory(array, current.array) for current in obs):
            found = f"{name} shares memory with obs, which has the first observation of the next episode"
            raise VecEnvError(found, expected="a separate array", env=index)
        results.append(ReturnedArray(name, index, array, array.copy()))
    return results


def _check_obs(env: "VecEnv", obs: object) -> list[ReturnedArray]:
    results: list[ReturnedArray] = []
    for name, space, value in _leaves(cast(AnySpace, env.observation_space), obs, "obs", None):
        array = _check_array(value, name, (env.num_envs, *(space.shape or ())), space.dtype)
        _check_in_space(space, array, name, range(env.num_envs))
        results.append(ReturnedArray(name, None, array, array.copy()))
    return results


def _leaves(space: AnySpace, value: Any, name: str, env: int | None) -> Iterator[tuple[str, AnySpace, Any]]:
    """Yield name, space and value of each array of an observation."""
    if isinstance(space, spaces.Dict):
        parts = cast(dict[str, AnySpace], space.spaces)
        if not isinstance(value, dict) or set(cast(dict[str, Any], value)) != set(parts):
            raise VecEnvError(f"{name} is {_type_of(value)}", expected=f"a dict with the keys {sorted(parts)}", env=env)
        for key, part in parts.items():
            yield from _leaves(part, value[key], f"{name}[{key!r}]", env)
    elif isinstance(space, spaces.Tuple):
        entries = cast(tuple[AnySpace, ...], space.spaces)
        if not isinstance(value, tuple) or len(cast(tuple[Any, ...], value)) != len(entries):
            raise VecEnvError(f"{name} is {_type_of(value)}", expected=f"a tuple of {len(entries)}", env=env)
        for index, part in enumerate(entries):
            yield from _leaves(part, value[index], f"{name}[{index}]", env)
    else:
        yield name, space, value


def _check_array(array: Any, name: str, shape: tuple[int, ...], dtype: Any, env: int | None = None) -> Array:
    # The last observation of a Discrete space is a NumPy scalar, which has a shape and a dtype.
    given = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray | np.generic) else _type_of(array)
    if given != f"{np.dtype(dtype)} {shape}":
        raise VecEnvError(f"{name} is {given}", expected=f"a NumPy array, {np.dtype(dtype)} {shape}", env=env)
    return np.asarray(cast(Any, array))


def _check_in_space(space: AnySpace, rows: Array, name: str, envs: Sequence[int]) -> None:
    """Check that ``rows``, one per environment in ``envs``, are in the space."""
    if isinstance(space, spaces.Box):
        # Written so that NaN is outside.
        outside = ~((rows >= space.low) & (rows <= space.high))
        for row, *entry in cast(list[list[int]], np.argwhere(outside)[:1].tolist()):
            at, value = tuple(entry), rows[row, *entry]
            expected = f"within [{space.low[at]}, {space.high[at]}], the bounds of `observation_space`"
            raise VecEnvError(f"{name}[{', '.join(map(str, entry))}] is {value}", expected=expected, env=envs[row])
        return
    for row, index in enumerate(envs):
        if not space.contains(rows[row]):
            raise VecEnvError(f"{name} is {rows[row]!r}", expected=f"an element of {space}", env=index)


def _type_of(value: Any) -> str:
    """Return the type of ``value``, and its length if it has one."""
    length = f" of {len(value)}" if hasattr(value, "__len__") else ""
    return f"{type(value).__name__}{length}"
