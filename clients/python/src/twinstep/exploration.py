"""Measure how well a policy explores: the disagreement of the actuator networks that it visits, and its falls (U2E)."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack, cast

import numpy as np
from numpy.typing import NDArray

from .env import OptionArguments
from .errors import SpecMismatchError
from .vector_env import Go2VectorEnv

TERM = "epistemic_uncertainty"
"""Name of the reward term."""


@dataclass(frozen=True)
class ExplorationMeasure:
    """What robots visited in their first episodes."""

    uncertainty: float
    """Epistemic uncertainty of the actuator networks, mean over joints and time [nat]."""
    falls_per_minute: float
    """Falls in a minute of one robot."""

    def __str__(self) -> str:
        return f"uncertainty {self.uncertainty:.4f} nat, {self.falls_per_minute:.2f} falls a minute of robot time"


def write_config(path: Path, base: Path, *, uncertainty_weight: float = 10.0, max_residual: float = 0.5) -> None:
    """Write the config file of a server with the task ``explore``.

    Parameters
    ----------
    path
        File to write (TOML).
    base
        Policy of ``walk`` whose actions are corrected: ``policy.safetensors`` of ``twinstep train walk``.
    uncertainty_weight
        Weight of the uncertainty in the reward, per second and nat (U2E, eq. 13).
    max_residual
        Largest correction of an action, in units of the action scale.
    """
    settings = {"name": "explore", "base": str(base.resolve())}
    numbers = {"uncertainty_weight": uncertainty_weight, "max_residual": max_residual}
    lines = [f"{name} = {json.dumps(value)}" for name, value in {**settings, **numbers}.items()]
    path.write_text("\n".join(["[task]", *lines, ""]))


def evaluate_exploration(
    act: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    num_envs: int = 64,
    *,
    uncertainty_weight: float = 10.0,
    steps: int = 500,
    seed: int = 1_000_000,
    **options: Unpack[OptionArguments],
) -> ExplorationMeasure:
    """Let a policy explore with fresh robots, each for one episode.

    Parameters
    ----------
    act
        The policy: observations (num_envs, 45) float32 to actions (num_envs, 12) float32. Without exploration noise.
    num_envs
        Number of robots.
    uncertainty_weight
        The server's weight of the uncertainty in the reward, per second and nat.
    steps
        Policy steps of an episode. A fall ends it.
    seed
        Robot i has the seed ``seed + i``.
    **options
        See :class:`twinstep.ConnectOptions`.

    Raises
    ------
    SpecMismatchError
        The task is not ``explore``.
    """
    arguments = cast(Any, {"task": "explore", **options})
    envs = Go2VectorEnv(num_envs, autoreset_mode="NextStep", max_episode_steps=steps, **arguments)
    try:
        if envs.twinstep_spec.task != "explore":
            raise SpecMismatchError(f"the task is `{envs.twinstep_spec.task}`; only `explore` rewards uncertainty")
        obs, _ = envs.reset(seed=seed)
        is_running = np.ones(num_envs, np.bool_)
        moved, falls, total = 0, 0, 0.0
        while is_running.any():
            obs, _, terminated, truncated, info = envs.step(act(obs))
            moved += int(is_running.sum())
            ended = is_running & (terminated | truncated)
            falls += int((is_running & terminated).sum())
            if ended.any():
                total += float(info["reward_terms"][TERM][ended].sum())
            is_running &= ~ended
        minutes = moved * envs.twinstep_spec.policy_dt / 60.0
    finally:
        envs.close()
    return ExplorationMeasure(total / (uncertainty_weight * 60.0 * minutes), falls / minutes)
