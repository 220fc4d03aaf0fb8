"""Train a walking policy with PPO of Stable-Baselines3, and store it with the spec hash of the robot.

Needs ``pip install "twinstep[sb3]"``. Reward and length of each episode are written to
``<out>/episodes.monitor.csv``.
"""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import cast

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from twinstep.sb3 import make_vec_env


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=1_000_000, help="total number of environment steps")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("walk"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    # The network is too small for several threads, which would take cores from the server's simulation.
    torch.set_num_threads(1)

    robots = make_vec_env(n_envs=args.envs, seed=args.seed)
    envs = VecNormalize(VecMonitor(robots, str(args.out / "episodes")))
    agent = PPO(
        "MlpPolicy",
        envs,
        n_steps=64,
        batch_size=16 * args.envs,
        n_epochs=5,
        # Initial standard deviation 0.37 instead of 1: the penalties of noisy actions exceed the reward of walking.
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -1.0},
        seed=args.seed,
        device="cpu",
    )
    agent.learn(args.steps, progress_bar=sys.stderr.isatty())

    agent.save(args.out / "policy.zip")
    envs.save(str(args.out / "normalization.pkl"))
    (args.out / "spec_hash").write_text(robots.twinstep_spec.hash)
    rewards = [episode["r"] for episode in cast(Iterable[dict[str, float]], agent.ep_info_buffer)]
    print(f"mean reward of the last {len(rewards)} episodes: {np.mean(rewards or np.nan):.3f}")
    envs.close()


if __name__ == "__main__":
    main()
