"""Overlap policy and simulation with ``send`` and ``recv``.

Two groups of robots alternate: while the server steps one, the policy computes the actions of the other.
"""

import argparse
import time

import numpy as np
from numpy.typing import NDArray

import twinstep

Obs = NDArray[np.float32]

WEIGHTS = [np.random.default_rng(1).normal(0, 0.05, size).astype(np.float32) for size in ((45, 1024), (1024, 12))]


def policy(obs: Obs) -> Obs:
    """Compute actions (envs, 12) from observations (envs, 45) with a random network."""
    for weight in WEIGHTS:
        obs = np.tanh(obs @ weight)
    return obs


def wait(groups: list[twinstep.Go2VectorEnv], obs: list[Obs], steps: int) -> None:
    for _ in range(steps):
        obs = [envs.step(policy(before))[0] for envs, before in zip(groups, obs, strict=True)]


def overlap(groups: list[twinstep.Go2VectorEnv], obs: list[Obs], steps: int) -> None:
    one, other = groups
    one.send(policy(obs[0]))
    for _ in range(steps):
        other.send(policy(obs[1]))  # while the server steps `one`
        obs[0] = one.recv()[0]
        one.send(policy(obs[0]))  # while the server steps `other`
        obs[1] = other.recv()[0]
    one.recv()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=64, help="robots in each of the two groups")
    parser.add_argument("--steps", type=int, default=200)
    args = parser.parse_args()

    groups = [twinstep.Go2VectorEnv(args.envs) for _ in range(2)]
    for run in (wait, overlap):
        obs = [envs.reset(seed=1)[0] for envs in groups]
        start = time.perf_counter()
        run(groups, obs, args.steps)
        rate = 2 * args.envs * args.steps / (time.perf_counter() - start)
        print(f"{run.__name__:8} {rate:8.0f} environment steps per second")
    for envs in groups:
        envs.close()


if __name__ == "__main__":
    main()
