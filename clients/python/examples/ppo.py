"""Train a walking policy with PPO of Stable-Baselines3, and store it with the spec hash of the robot.

Needs ``pip install "twinstep[sb3]"``. Reward and length of each episode are written to
``<out>/episodes.monitor.csv``. results/walking.md has the measured errors and minutes.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from twinstep.sb3 import make_vec_env
from twinstep.walking import evaluate_walking


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=12_000_000, help="total number of environment steps")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("walk"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    since = time.monotonic()

    # The network is too small for several threads, which would take cores from the server's simulation.
    torch.set_num_threads(1)

    robots = make_vec_env(n_envs=args.envs, seed=args.seed)
    envs = VecNormalize(VecMonitor(robots, str(args.out / "episodes")), gamma=0.98)
    agent = PPO(
        "MlpPolicy",
        envs,
        n_steps=24,
        batch_size=6 * args.envs,
        n_epochs=2,
        gamma=0.98,
        ent_coef=5e-4,
        max_grad_norm=1.0,
        # Decreases to 0 at the end.
        learning_rate=lambda left: 1.5e-3 * left,
        # Initial standard deviation 0.5 instead of 1: the penalties of noisy actions exceed the reward of walking.
        policy_kwargs={"net_arch": [128, 128], "activation_fn": torch.nn.ReLU, "log_std_init": -0.7},
        seed=args.seed,
        device="cpu",
    )
    agent.learn(args.steps, progress_bar=sys.stderr.isatty())

    agent.save(args.out / "policy.zip")
    envs.save(str(args.out / "normalization.pkl"))
    (args.out / "spec_hash").write_text(robots.twinstep_spec.hash)
    envs.close()

    def act(obs: NDArray[np.float32]) -> NDArray[np.float32]:
        return agent.predict(np.asarray(envs.normalize_obs(obs)), deterministic=True)[0]

    errors = evaluate_walking(act)
    print(f"{agent.num_timesteps} steps in {(time.monotonic() - since) / 60:.1f} min: {errors}")


if __name__ == "__main__":
    main()
