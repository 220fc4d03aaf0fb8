"""Step robots with random actions: the shortest complete program."""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import twinstep

gym.register_envs(twinstep)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--steps", type=int, default=500)
    args = parser.parse_args()

    envs: Any = gym.make_vec("twinstep/Go2-Walk-v0", num_envs=args.envs)
    for part in envs.twinstep_spec.observation:
        print(f"{part.name:22} {part.size:3}  {part.unit:18} {part.description}")

    envs.action_space.seed(1)
    envs.reset(seed=1)
    reward_sum = np.zeros(args.envs)
    ended = 0
    for _ in range(args.steps):
        _, reward, terminated, truncated, _ = envs.step(envs.action_space.sample())
        reward_sum += reward
        ended += int((terminated | truncated).sum())
    print(f"mean reward of a step {reward_sum.mean() / args.steps:.4f}, episodes ended {ended}")
    envs.close()


if __name__ == "__main__":
    main()
