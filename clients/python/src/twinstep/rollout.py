"""Rollouts: a policy runs on the server, next to its robots, and a trajectory comes back."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import codec
from .errors import InvalidOptionError
from .step import read_critic


@dataclass(frozen=True)
class GaussianPolicy:
    """Normal distribution of actions around the output of a network with rectified linear units between its layers.

    The mean action is ``network(clip((obs - mean) / std, -10, 10))``.

    Attributes
    ----------
    layers
        Weight (outputs, inputs) and bias (outputs,) of each linear layer, as in ``torch.nn.Linear``.
    log_std : (action_len,) float
        Logarithm of the standard deviation of each entry of the action, -20 to 20.
    mean, std : (obs_len,) float, optional
        Normalise the observations. ``None``: 0 and 1.
    """

    layers: Sequence[tuple[ArrayLike, ArrayLike]]
    log_std: ArrayLike
    mean: ArrayLike | None = None
    std: ArrayLike | None = None


@dataclass
class Trajectory:
    """Consecutive steps of all environments. The arrays are new and not written to later.

    Attributes
    ----------
    obs : (steps + 1, num_envs, obs_len) float32
        Observations before each step, and after the last one.
    critic_obs : (steps + 1, num_envs, critic_len) float32
        The same of group ``critic``; ``critic_len`` is 0 unless the option ``critic`` is set.
    actions : (steps, num_envs, action_len) float32
        Sampled actions, before the environment clipped them.
    log_prob : (steps, num_envs) float32
        Logarithm of the probability density of each action.
    reward : (steps, num_envs) float32
    terminated, truncated : (steps, num_envs) bool
    ended_step, ended_env : (k,) int
        Step and environment in which each ended episode ended, in the order of the steps.
    ended_length : (k,) int
        Policy steps of those episodes.
    ended_return : (k,) float32
        Sums of their rewards.
    ended_terms : (k, reward_terms) float32
        Sums of their weighted reward terms.
    ended_diverged : (k,) bool
        True for those whose simulation became NaN or infinite.
    final_obs : (k, obs_len) float32, or empty
        Their last observations; empty unless autoreset is SameStep.
    final_critic_obs : (k, critic_len) float32, or empty
        As ``final_obs``, of group ``critic``.
    """

    obs: NDArray[np.float32]
    critic_obs: NDArray[np.float32]
    actions: NDArray[np.float32]
    log_prob: NDArray[np.float32]
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    ended_step: NDArray[np.int64]
    ended_env: NDArray[np.int64]
    ended_length: NDArray[np.int64]
    ended_return: NDArray[np.float32]
    ended_terms: NDArray[np.float32]
    ended_diverged: NDArray[np.bool_]
    final_obs: NDArray[np.float32]
    final_critic_obs: NDArray[np.float32]


def encode_policy(policy: GaussianPolicy, spec: codec.Spec) -> dict[str, object]:
    """Return the field ``policy`` of a rollout request. Raises ``InvalidOptionError`` if an array has another shape."""
    sizes, weights, inputs = [spec.obs_len], list[bytes](), spec.obs_len
    last = len(policy.layers) - 1
    if last < 0:
        raise InvalidOptionError("`layers` is empty; at least one is expected")
    for index, (weight, bias) in enumerate(policy.layers):
        outputs = spec.action_len if index == last else len(np.asarray(bias))
        for name, array, shape in (("weight", weight, (outputs, inputs)), ("bias", bias, (outputs,))):
            weights.append(_checked(f"{name} of layer {index}", array, shape).tobytes())
        sizes.append(outputs)
        inputs = outputs
    mean = np.zeros(spec.obs_len) if policy.mean is None else policy.mean
    std = np.ones(spec.obs_len) if policy.std is None else policy.std
    return {
        "sizes": sizes,
        "weights": b"".join(weights),
        "mean": _checked("mean", mean, (spec.obs_len,)).tobytes(),
        "std": _checked("std", std, (spec.obs_len,)).tobytes(),
        "log_std": _checked("log_std", policy.log_std, (spec.action_len,)).tobytes(),
    }


def _checked(name: str, array: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return finite numbers of this shape as contiguous little-endian float32."""
    given = np.asarray(array)
    if given.shape != shape or given.dtype.kind not in "fiu":
        raise InvalidOptionError(f"the policy's {name} is {given.dtype} {given.shape}; float32 {shape} is expected")
    checked = np.ascontiguousarray(given, dtype="<f4")
    if not np.isfinite(checked).all():
        raise InvalidOptionError(f"the policy's {name} has an entry that is NaN or infinite")
    return checked


def read_trajectory(reply: dict[str, Any], steps: int, num_envs: int, spec: codec.Spec) -> Trajectory:
    """Return the trajectory in the reply to a rollout."""
    k = len(reply.get("ended_env", b"")) // 4
    num_final = k if reply.get("final_obs") else 0
    terms = len(spec.reward_terms)
    critic_obs = read_critic(reply, "critic_obs", (steps + 1) * num_envs, spec)
    diverged = codec.tensor(reply, "ended_diverged", "?", k) if reply.get("ended_diverged") else np.zeros(k, np.bool_)
    return Trajectory(
        obs=codec.tensor(reply, "obs", "<f4", steps + 1, num_envs, spec.obs_len),
        critic_obs=critic_obs.reshape(steps + 1, num_envs, spec.critic_len),
        actions=codec.tensor(reply, "actions", "<f4", steps, num_envs, spec.action_len),
        log_prob=codec.tensor(reply, "log_prob", "<f4", steps, num_envs),
        reward=codec.tensor(reply, "reward", "<f4", steps, num_envs),
        terminated=codec.tensor(reply, "terminated", "?", steps, num_envs),
        truncated=codec.tensor(reply, "truncated", "?", steps, num_envs),
        ended_step=codec.tensor(reply, "ended_step", "<u4", k).astype(np.int64),
        ended_env=codec.tensor(reply, "ended_env", "<u4", k).astype(np.int64),
        ended_length=codec.tensor(reply, "ended_length", "<u4", k).astype(np.int64),
        ended_return=codec.tensor(reply, "ended_return", "<f4", k),
        ended_terms=codec.tensor(reply, "ended_terms", "<f4", k, terms),
        ended_diverged=diverged,
        final_obs=codec.tensor(reply, "final_obs", "<f4", num_final, spec.obs_len),
        final_critic_obs=read_critic(reply, "final_critic_obs", num_final, spec),
    )
