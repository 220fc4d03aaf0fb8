"""Collect rollouts with Ray: each worker steps its own robots, and one learner updates a linear policy.

The servers are behind a router: start ``zenohd``, then ``twinstep serve --connect tcp/ROUTER:7447`` on each machine.
Each worker takes the server with the most free robots.
"""

import argparse
import importlib
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

import twinstep

Array = NDArray[np.float32]


class Worker:
    """Robots with the seeds from ``seed`` on, at one server."""

    def __init__(self, endpoint: str, envs: int, seed: int) -> None:
        self.envs = twinstep.Go2VectorEnv(envs, endpoint=endpoint, autoreset_mode="SameStep")
        self.obs, _ = self.envs.reset(seed=seed)
        self.generator = np.random.default_rng(seed)

    def lease(self) -> str:
        """Return the id of the lease, as in the log of the server."""
        return self.envs.lease

    def rollout(self, weights: Array, steps: int) -> tuple[Array, Array, Array]:
        """Return observations (steps, envs, 45), noise of actions (steps, envs, 12) and rewards (steps, envs)."""
        rows: list[tuple[Array, Array, Array]] = []
        for _ in range(steps):
            obs, noise = self.obs, self.generator.normal(0, 0.1, (len(self.obs), 12)).astype(np.float32)
            self.obs, reward, *_ = self.envs.step(obs @ weights + noise)
            rows.append((obs, noise, reward.astype(np.float32)))
        obs, noise, reward = zip(*rows, strict=True)
        return np.stack(obs), np.stack(noise), np.stack(reward)


def improve(weights: Array, rollouts: list[tuple[Array, Array, Array]]) -> tuple[Array, float]:
    """Return weights after a step along the policy gradient of the reward, and the mean reward of a step."""
    obs, noise, reward = (np.concatenate(parts, axis=1) for parts in zip(*rollouts, strict=True))
    gradient = np.einsum("tno,tna,tn->oa", obs, noise, reward - reward.mean()) / reward.size
    return (weights + gradient).astype(np.float32), float(reward.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--endpoint", required=True, help="router, such as tcp/192.168.1.7:7447")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--envs", type=int, default=64, help="robots of each worker")
    parser.add_argument("--steps", type=int, default=50, help="steps of a rollout")
    parser.add_argument("--updates", type=int, default=10)
    args = parser.parse_args()
    try:
        ray: Any = importlib.import_module("ray")
    except ImportError:
        sys.exit("Ray is not installed here\n  pip install ray")

    ray.init(num_cpus=args.workers, include_dashboard=False)
    workers: list[Any] = []
    for index in range(args.workers):
        workers.append(ray.remote(Worker).remote(args.endpoint, args.envs, index * args.envs))
        # One after the other: the choice of the server depends on the robots that the others have leased.
        print(f"worker {index}: lease {ray.get(workers[-1].lease.remote())}")
    weights = np.zeros((45, 12), np.float32)
    for update in range(args.updates):
        weights, reward = improve(weights, ray.get([one.rollout.remote(weights, args.steps) for one in workers]))
        print(f"update {update}: mean reward of a step {reward:.4f}")
    ray.shutdown()


if __name__ == "__main__":
    main()
