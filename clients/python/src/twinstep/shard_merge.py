"""Environments divided among several leases, and their steps merged into one."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .step import StepBatch


def divide(num_envs: int, parts: int) -> list[slice]:
    """Return the rows of each part. The numbers of rows differ by at most one."""
    bounds = [num_envs * index // parts for index in range(parts + 1)]
    return [slice(start, stop) for start, stop in pairwise(bounds)]


def merge(
    parts: Sequence[tuple[slice, StepBatch]],
    *,
    lost: NDArray[np.int64],
    obs: NDArray[np.float32],
    critic_obs: NDArray[np.float32],
    length: NDArray[np.int64],
    terms: int,
    same_step: bool,
    round_trip_s: float,
) -> StepBatch:
    """Return the step of all environments, as new arrays. Environments in no part are held.

    Parameters
    ----------
    parts
        Rows of each lease, and its step.
    lost : (k,) int
        Environments to truncate, because their server was lost.
    obs, critic_obs : (num_envs, obs_len) and (num_envs, critic_len) float32
        Last observations, which held environments return.
    length : (num_envs,) int
        Policy steps of each episode before this step.
    terms
        Number of reward terms.
    same_step
        True in mode SameStep, in which ended episodes have final observations.
    round_trip_s
        Time from sending the actions to the last reply [s].
    """
    num_envs = len(obs)
    merged = StepBatch(
        obs=obs.copy(),
        reward=np.zeros(num_envs, np.float32),
        terminated=np.zeros(num_envs, np.bool_),
        truncated=np.zeros(num_envs, np.bool_),
        held=np.ones(num_envs, np.bool_),
        critic_obs=critic_obs.copy(),
        round_trip_s=round_trip_s,
        ended=lost,
        ended_length=np.maximum(length[lost], 0),
        ended_terms=np.full((len(lost), terms), np.nan, np.float32),
        ended_diverged=np.zeros(len(lost), np.bool_),
        ended_lost=np.ones(len(lost), np.bool_),
        final_obs=obs[lost if same_step else lost[:0]],
        final_critic_obs=critic_obs[lost if same_step else lost[:0]],
    )
    merged.truncated[lost] = True
    for rows, part in parts:
        for name in ("obs", "reward", "terminated", "truncated", "held", "critic_obs"):
            getattr(merged, name)[rows] = getattr(part, name)
    ended = np.concatenate([lost, *(part.ended + rows.start for rows, part in parts)])
    order = np.argsort(ended)
    merged.ended = ended[order]
    names = ["ended_length", "ended_terms", "ended_diverged", "ended_lost"]
    for name in names + ["final_obs", "final_critic_obs"] * same_step:
        values = np.concatenate([getattr(merged, name), *(getattr(part, name) for _, part in parts)])
        setattr(merged, name, values[order])
    return merged
