"""Measure how well a policy walks: velocity errors and falls. Rewards do not tell, standing still earns some too."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Unpack, cast

import numpy as np
from numpy.typing import NDArray

from .codec import SpecField
from .env import OptionArguments
from .errors import SpecMismatchError
from .vector_env import Go2VectorEnv

Observations = NDArray[np.float32]


@dataclass(frozen=True)
class WalkingErrors:
    """Errors of robots that have not fallen, from the start of the episodes on, changes of the command included."""

    velocity_rms: float
    """Root mean square of the norm of the horizontal velocity error [m/s]."""
    yaw_rate_rms: float
    """Root mean square error of the yaw rate [rad/s]."""
    up: float
    """Share of the robots that did not fall."""

    def __str__(self) -> str:
        return (
            f"velocity error {self.velocity_rms:.3f} m/s, yaw rate error {self.yaw_rate_rms:.3f} rad/s, "
            f"still up {100 * self.up:.1f} %"
        )


def evaluate_walking(
    act: Callable[[Observations], Observations],
    num_envs: int = 256,
    *,
    seconds: float = 20.0,
    seed: int = 1_000_000,
    **options: Unpack[OptionArguments],
) -> WalkingErrors:
    """Let a policy walk fresh robots with the velocity commands of the task.

    Parameters
    ----------
    act
        The policy: observations (num_envs, 45) float32 to actions (num_envs, 12) float32. Without exploration noise.
    num_envs
        Number of robots.
    seconds
        Simulated time of each robot [s], at most that of an episode.
    seed
        Robot i has the seed ``seed + i``.
    **options
        See :class:`twinstep.ConnectOptions`.

    Raises
    ------
    SpecMismatchError
        The server does not observe the true velocities: it is a real robot, or the task has no velocity command.
    """
    envs = Go2VectorEnv(num_envs, autoreset_mode="NextStep", **cast(Any, {**options, "critic": True}))
    try:
        spec = envs.twinstep_spec
        command = _start(spec.observation, "velocity_command")
        linear = _start(spec.critic_observation, "true_linear_velocity")
        angular = _start(spec.critic_observation, "true_angular_velocity")
        obs, _ = envs.reset(seed=seed)
        up = np.ones(num_envs, np.bool_)
        squares, count = np.zeros(2), 0
        for _ in range(round(seconds / spec.policy_dt)):
            wanted = obs[:, command : command + 3]
            obs, _, terminated, truncated, info = envs.step(act(obs))
            up &= ~terminated
            # The observation after the end of an episode is that of the next one.
            counted = up & ~truncated
            truth = info["critic_obs"][counted]
            velocity = truth[:, linear : linear + 2] - wanted[counted, :2]
            yaw_rate = truth[:, angular + 2] - wanted[counted, 2]
            squares += [np.square(velocity).sum(), np.square(yaw_rate).sum()]
            count += int(counted.sum())
    finally:
        envs.close()
    velocity_rms, yaw_rate_rms = np.sqrt(squares / max(count, 1))
    return WalkingErrors(float(velocity_rms), float(yaw_rate_rms), float(up.mean()))


def _start(fields: tuple[SpecField, ...], name: str) -> int:
    """Return the index of the first entry of a field."""
    names = [field.name for field in fields]
    if name not in names:
        raise SpecMismatchError(f"the server does not observe `{name}`; it observes {names}")
    return sum(field.size for field in fields[: names.index(name)])
