"""Actions and results of one step."""

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import codec
from .errors import InvalidActionError, InvalidOptionError


@dataclass
class StepBatch:
    """Result of one step. The arrays are new and not written to later.

    Attributes
    ----------
    obs : (num_envs, obs_len) float32
    reward : (num_envs,) float32
    terminated, truncated : (num_envs,) bool
    ended : (k,) int
        Environments whose episode ended.
    ended_length : (k,) int
        Policy steps of those episodes.
    ended_terms : (k, reward_terms) float32
        Sums of their weighted reward terms.
    ended_diverged : (k,) bool
        True for those whose simulation became NaN or infinite. They are truncated; ``obs`` is that before the step.
    ended_lost : (k,) bool
        True for those whose server was lost, see :class:`twinstep.ShardedVecEnv`. Their ``ended_terms`` are NaN.
    held : (num_envs,) bool
        True for environments whose action was not executed, because they have no server or have just got one.
    final_obs : (k, obs_len) float32, or empty
        Their last observations; empty unless autoreset is SameStep.
    critic_obs : (num_envs, critic_len) float32
        Observations of group ``critic``; ``critic_len`` is 0 unless the option ``critic`` is set.
    final_critic_obs : (k, critic_len) float32, or empty
        As ``final_obs``, of group ``critic``.
    round_trip_s
        Time from sending the actions to the reply [s].
    robot
        Report of a robot in real time: ``tick``, ``stamp_ns``, ``late_ticks``, ``applied``, and ``refused`` and
        ``fault`` if there are any, see ``protocol/SPEC.md``. Empty in a simulation.
    """

    obs: NDArray[np.float32]
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    ended: NDArray[np.int64]
    ended_length: NDArray[np.int64]
    ended_terms: NDArray[np.float32]
    ended_diverged: NDArray[np.bool_]
    ended_lost: NDArray[np.bool_]
    held: NDArray[np.bool_]
    final_obs: NDArray[np.float32]
    critic_obs: NDArray[np.float32]
    final_critic_obs: NDArray[np.float32]
    round_trip_s: float = field(compare=False)
    robot: dict[str, Any] = field(default_factory=dict[str, Any])


def checked_actions(actions: NDArray[Any], num_envs: int, spec: codec.Spec) -> NDArray[np.float32]:
    """Return actions, (num_envs, action_len) finite numbers, as contiguous little-endian float32."""
    given = np.asarray(actions)
    expected = (num_envs, spec.action_len)
    if given.shape != expected:
        raise InvalidActionError(f"`actions` has shape {given.shape}; {expected} is expected")
    if given.dtype.kind not in "fiu":
        raise InvalidActionError(f"`actions` has dtype {given.dtype}; float32 is expected")
    checked = np.ascontiguousarray(given, dtype="<f4")
    if not np.isfinite(checked).all():
        env, entry = (int(index) for index in np.argwhere(~np.isfinite(checked))[0])
        raise InvalidActionError(
            f"the action of environment {env}, {spec.action_entry(entry)}, is {checked[env, entry]}\n"
            "  nothing was stepped; check the policy that computed the action"
        )
    return checked


def checked_velocity_commands(commands: NDArray[Any], num_envs: int, spec: codec.Spec) -> NDArray[np.float32]:
    """Return velocity commands, (num_envs, 3) within the bounds of the spec, as contiguous little-endian float32."""
    return _checked_commands(commands, num_envs, spec, "velocity", {"velocity_command": 3})


def checked_gait_commands(commands: NDArray[Any], num_envs: int, spec: codec.Spec) -> NDArray[np.float32]:
    """Return gait commands, (num_envs, 4) within the bounds of the spec, as contiguous little-endian float32."""
    return _checked_commands(commands, num_envs, spec, "gait", {"step_frequency": 1, "phase_offset": 3})


def _checked_commands(
    commands: NDArray[Any], num_envs: int, spec: codec.Spec, kind: str, sizes: dict[str, int]
) -> NDArray[np.float32]:
    """Return commands whose entries are the parts of the observation with these names and sizes."""
    parts = [part for part in spec.observation if sizes.get(part.name) == part.size]
    if len(parts) != len(sizes):
        raise InvalidOptionError(f"the task `{spec.task}` has no {kind} command")
    entries = [
        (part.name if part.size == 1 else f"{part.name}[{index}]", part.low, part.high)
        for part in parts
        for index in range(part.size)
    ]
    checked = np.ascontiguousarray(commands, dtype="<f4")
    if checked.shape != (num_envs, len(entries)):
        raise InvalidOptionError(f"`commands` has shape {checked.shape}; {(num_envs, len(entries))} is expected")
    allowed = (checked >= [low for _, low, _ in entries]) & (checked <= [high for _, _, high in entries])
    if not allowed.all():
        env, entry = (int(index) for index in np.argwhere(~allowed)[0])
        name, low, high = entries[entry]
        raise InvalidOptionError(
            f"`commands` of environment {env}: {name} is {checked[env, entry]}; {low:g} to {high:g} is allowed"
        )
    return checked


def read_step(reply: dict[str, Any], num_envs: int, spec: codec.Spec, since: float) -> StepBatch:
    """Return the result of a step that was sent at ``since``, on the clock of ``time.monotonic`` [s]."""
    k = len(reply.get("ended_env", b"")) // 4
    num_final = k if reply.get("final_obs") else 0
    return StepBatch(
        obs=codec.tensor(reply, "obs", "<f4", num_envs, spec.obs_len),
        reward=codec.tensor(reply, "reward", "<f4", num_envs),
        terminated=codec.tensor(reply, "terminated", "?", num_envs),
        truncated=codec.tensor(reply, "truncated", "?", num_envs),
        ended=codec.tensor(reply, "ended_env", "<u4", k).astype(np.int64),
        ended_length=codec.tensor(reply, "ended_length", "<u4", k).astype(np.int64),
        ended_terms=codec.tensor(reply, "ended_terms", "<f4", k, len(spec.reward_terms)),
        ended_diverged=codec.tensor(reply, "ended_diverged", "?", k)
        if reply.get("ended_diverged")
        else np.zeros(k, np.bool_),
        ended_lost=np.zeros(k, np.bool_),
        held=np.zeros(num_envs, np.bool_),
        final_obs=codec.tensor(reply, "final_obs", "<f4", num_final, spec.obs_len),
        critic_obs=read_critic(reply, "critic_obs", num_envs, spec),
        final_critic_obs=read_critic(reply, "final_critic_obs", num_final, spec),
        round_trip_s=time.monotonic() - since,
        robot=read_robot(reply, spec),
    )


def read_robot(reply: dict[str, Any], spec: codec.Spec) -> dict[str, Any]:
    """Return the report of a robot in real time, which the reply of a simulation does not contain."""
    names = ("tick", "stamp_ns", "late_ticks", "refused", "fault")
    report = {name: reply[name] for name in names if reply.get(name) is not None}
    if "applied" in reply:
        report["applied"] = codec.tensor(reply, "applied", "<f4", spec.action_len)
    return report


def read_critic(reply: dict[str, Any], name: str, rows: int, spec: codec.Spec) -> NDArray[np.float32]:
    """Return observations of group ``critic``, which a reply without the group does not contain."""
    return codec.tensor({name: b"", **reply}, name, "<f4", rows, spec.critic_len)
