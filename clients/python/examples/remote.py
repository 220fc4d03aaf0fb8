"""Run the agent of ``ppo.py`` on another server or on a robot: only ``--endpoint`` changes."""

import argparse
from pathlib import Path

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from twinstep.sb3 import make_vec_env


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--endpoint", help="such as tcp/192.168.1.7:7447. Default: a server on this machine")
    parser.add_argument("--policy", type=Path, default=Path("walk"), help="output folder of `ppo.py`")
    parser.add_argument("--envs", type=int, default=1)
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()

    # The server rejects the hash if joints, gains, periods or observation differ from those in training.
    spec_hash = (args.policy / "spec_hash").read_text()
    robots = make_vec_env(n_envs=args.envs, endpoint=args.endpoint, spec_hash=spec_hash, seed=1)
    envs = VecNormalize.load(str(args.policy / "normalization.pkl"), VecMonitor(robots))
    envs.training = False
    envs.norm_reward = False
    agent = PPO.load(args.policy / "policy.zip", device="cpu")

    obs = envs.reset()
    rewards: list[float] = []
    for _ in range(args.steps):
        actions, _ = agent.predict(np.asarray(obs), deterministic=True)
        envs.step_async(actions)
        obs, reward = envs.step_wait()[:2]
        rewards.append(float(np.mean(reward)))
    print(f"mean reward of a step: {np.mean(rewards):.4f}")
    envs.close()


if __name__ == "__main__":
    main()
