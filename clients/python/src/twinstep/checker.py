"""Checker for a ``VecEnv``. The checker of Stable-Baselines3 is only for single environments."""

import copy
import warnings
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces

from .checker_results import Array, ReturnedArray, VecEnvError, check_list, check_reset, check_step

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

__all__ = ["VecEnvError", "check_vec_env"]

_SEED, _OTHER_SEED = 1234, 987654
_ATTRIBUTE, _METHOD = "twinstep_check_attribute", "twinstep_check_method"


def check_vec_env(env: "VecEnv", *, steps: int = 200) -> None:
    """Check the contract of any Stable-Baselines3 ``VecEnv``, and close it.

    It is stepped with random actions in three rollouts from the same seed. Check it without ``VecNormalize``, whose
    statistics persist between rollouts.

    Parameters
    ----------
    env
        The environment to check.
    steps
        Number of steps of a rollout. Warns if no episode ends within them, because ends are then not checked.

    Raises
    ------
    VecEnvError
        The contract is violated. The message contains what is wrong, in which environment, and what is expected.
    """
    _check_itself(env)
    _check_attributes(env)
    first = _rollout(env, steps, _step_at_once)
    _check_equal(first, _rollout(env, steps, _step_at_once), "two rollouts from the same seed with the same actions")
    _check_equal(first, _rollout(env, steps, _step_in_two), "`step`, and `step_async` followed by `step_wait`,")
    _check_seed_is_used_once(env)
    for _ in range(2):
        _call("close", env.close)
    if not any(result.name.startswith("terminal_observation") for results in first for result in results):
        warnings.warn(f"no episode ended within {steps} steps, so no end was checked; increase `steps`", stacklevel=2)


def _check_itself(env: object) -> None:
    from stable_baselines3.common.vec_env import VecEnv

    if not isinstance(env, VecEnv):
        kind = f"{type(env).__module__}.{type(env).__qualname__}"
        expected = "a subclass of `stable_baselines3.common.vec_env.VecEnv`"
        raise VecEnvError(f"{kind} is not a `VecEnv`", expected=expected)
    num_envs = cast(object, env.num_envs)
    if not isinstance(num_envs, int) or num_envs < 1:
        raise VecEnvError(f"`num_envs` = {num_envs!r}", expected="an int of at least 1")
    for name in ("observation_space", "action_space"):
        space: object = getattr(env, name, None)
        if not isinstance(space, spaces.Space):
            found = f"`{name}` is {type(space).__name__}"
            raise VecEnvError(found, expected="the `gymnasium.Space` of one environment, not of all")


def _check_attributes(env: "VecEnv") -> None:
    everywhere, last = list(range(env.num_envs)), env.num_envs - 1
    # All indices, a single index, several in another order.
    requests: list[tuple[int | list[int] | None, list[int]]] = [
        (None, everywhere),
        (last, [last]),
        (everywhere[::-1], everywhere[::-1]),
    ]
    for indices, expected_indices in requests:
        _check_set_attr(env, indices, expected_indices)
    for indices, expected_indices in requests:
        _check_getters(env, indices, expected_indices)


def _check_set_attr(env: "VecEnv", indices: int | list[int] | None, expected_indices: list[int]) -> None:
    _call("set_attr", env.set_attr, _ATTRIBUTE, "before")
    _call("set_attr", env.set_attr, _ATTRIBUTE, "after", indices=indices)
    values = _call("get_attr", env.get_attr, _ATTRIBUTE)
    check_list(values, "`get_attr`", env.num_envs)
    for index, value in enumerate(values):
        expected = "after" if index in expected_indices else "before"
        if value != expected:
            found = f"the attribute is {value!r} after `set_attr` with indices={indices}"
            raise VecEnvError(found, expected=f"{expected!r}: set only for the environments in `indices`", env=index)


def _check_getters(env: "VecEnv", indices: int | list[int] | None, expected_indices: list[int]) -> None:
    arguments = f"with indices={indices}"
    for index in range(env.num_envs):
        _call("set_attr", env.set_attr, _ATTRIBUTE, index, indices=index)
    values = _call("get_attr", env.get_attr, _ATTRIBUTE, indices=indices)
    check_list(values, f"`get_attr` {arguments}", len(expected_indices))
    if list(values) != expected_indices:
        found = f"`get_attr` {arguments} returned the attributes of the environments {list(values)}"
        raise VecEnvError(found, expected=f"those of {expected_indices}, in this order")
    _call("set_attr", env.set_attr, _METHOD, _method)
    returned = _call("env_method", cast(Any, env).env_method, _METHOD, 1, indices=indices, keyword=2)
    check_list(returned, f"`env_method` {arguments}", len(expected_indices))
    if any(answer != (1, 2) for answer in returned):
        found = f"`env_method` {arguments} returned {returned!r}"
        raise VecEnvError(found, expected="the return value of the method: (1, 2)")
    wrapped = _call("env_is_wrapped", env.env_is_wrapped, gymnasium.Wrapper, indices=indices)
    check_list(wrapped, f"`env_is_wrapped` {arguments}", len(expected_indices))
    if any(not isinstance(one, bool | np.bool_) for one in wrapped):
        raise VecEnvError(f"`env_is_wrapped` {arguments} returned {wrapped!r}", expected="one bool per environment")


def _method(positional: int, *, keyword: int) -> tuple[int, int]:
    """Return the arguments. Called by ``env_method``; at module level, so that ``SubprocVecEnv`` can pickle it."""
    return positional, keyword


def _call(name: str, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a method of the ``VecEnv`` that must not raise."""
    try:
        return method(*args, **kwargs)
    except Exception as error:
        given = ", ".join([*map(repr, args), *(f"{key}={value!r}" for key, value in kwargs.items())])
        found = f"`{name}({given})` raised {type(error).__name__}: {error}"
        raise VecEnvError(found, expected="no exception: algorithms and wrappers call this method") from error


def _step_at_once(env: "VecEnv", actions: Array) -> object:
    return cast(object, env.step(actions))


def _step_in_two(env: "VecEnv", actions: Array) -> object:
    env.step_async(actions)
    return cast(object, env.step_wait())


def _rollout(env: "VecEnv", steps: int, step: Callable[["VecEnv", Array], object]) -> list[list[ReturnedArray]]:
    """Reset with the seed, step, and check all results; the first entry is that of the reset."""
    space: spaces.Space[Any] = copy.deepcopy(cast(Any, env.action_space))
    space.seed(_SEED)
    check_list(_call("seed", env.seed, _SEED), "`seed`", env.num_envs)
    rollout = [check_reset(env, env.reset())]
    for _ in range(steps):
        actions: Array = np.array([space.sample() for _ in range(env.num_envs)])
        given = actions.copy()
        rollout.append(check_step(env, step(env, given)))
        if not np.array_equal(given, actions):
            raise VecEnvError("a step wrote into its argument `actions`", expected="unchanged actions")
    _check_fresh(rollout)
    return rollout


def _check_fresh(rollout: list[list[ReturnedArray]]) -> None:
    expected = "new arrays from each step, because agents store them"
    for number, (results, after) in enumerate(pairwise(rollout)):
        for old in results:
            if not np.array_equal(old.array, old.snapshot):
                raise VecEnvError(f"a later step overwrote {old.name} of step {number}", expected=expected, env=old.env)
            if any(np.shares_memory(old.array, new.array) for new in after):
                found = f"{old.name} of step {number} shares memory with the result of the next step"
                raise VecEnvError(found, expected=expected, env=old.env)


def _check_equal(one: list[list[ReturnedArray]], other: list[list[ReturnedArray]], which: str) -> None:
    for number, (results, others) in enumerate(zip(one, other, strict=True)):
        # The numbers of entries differ only if `done` differs, which is compared before the entries at ends.
        for a, b in zip(results, others, strict=False):
            if np.array_equal(a.snapshot, b.snapshot):
                continue
            env = a.env if a.env is not None else int(np.argwhere(a.snapshot != b.snapshot)[0, 0])
            found = f"{which} differ in {a.name} of step {number}"
            raise VecEnvError(found, expected="equal results for equal seeds and actions", env=env)


def _check_seed_is_used_once(env: "VecEnv") -> None:
    env.seed(_SEED)
    seeded, next_one = check_reset(env, env.reset()), check_reset(env, env.reset())
    env.seed(_OTHER_SEED)
    other = check_reset(env, env.reset())
    # Not checked if every seed gives the same initial state.
    if _same(seeded, next_one) and not _same(seeded, other):
        found = "the second `reset` after `seed` returned the same observations"
        raise VecEnvError(found, expected="one reset uses the seed (`_reset_seeds`); later the random streams continue")


def _same(one: list[ReturnedArray], other: list[ReturnedArray]) -> bool:
    return all(np.array_equal(a.snapshot, b.snapshot) for a, b in zip(one, other, strict=True))
