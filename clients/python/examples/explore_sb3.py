"""Train an exploration policy with PPO of Stable-Baselines3: the reward is what an actuator ensemble does not know.

Needs ``pip install "twinstep[sb3]"``, a model file with an ensemble of actuator networks (``twinstep fit``), and a
policy of ``walk``, to whose actions the trained policy adds a bounded residual (U2E, §III-C). Uncertainty and length of
each episode are written to ``<out>/episodes.monitor.csv``.
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

from twinstep.exploration import evaluate_exploration, write_config
from twinstep.sb3 import make_vec_env


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", required=True, help="model file with an [actuator] table: robot.toml of `fit`")
    parser.add_argument("--base", type=Path, required=True, help="policy of `walk`: policy.safetensors")
    parser.add_argument("--uncertainty-weight", type=float, default=10.0, help="per second and nat")
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=2_000_000, help="total number of environment steps")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("explore"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    since = time.monotonic()
    # The network is too small for several threads, which would take cores from the server's simulation.
    torch.set_num_threads(1)

    config = args.out / "server.toml"
    write_config(config, args.base, uncertainty_weight=args.uncertainty_weight)
    robots = make_vec_env(
        "twinstep/Go2-Explore-v0", n_envs=args.envs, seed=args.seed, model=args.model, config=str(config)
    )
    monitored = VecMonitor(robots, str(args.out / "episodes"), info_keywords=("reward_terms",))
    envs = VecNormalize(monitored, gamma=0.98)
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
        policy_kwargs={"net_arch": [128, 128], "activation_fn": torch.nn.ReLU, "log_std_init": -0.7},
        seed=args.seed,
        device="cpu",
    )
    agent.learn(args.steps, progress_bar=sys.stderr.isatty())
    seconds = time.monotonic() - since

    agent.save(args.out / "policy.zip")
    envs.save(str(args.out / "normalization.pkl"))
    (args.out / "spec_hash").write_text(robots.twinstep_spec.hash)
    envs.close()

    def act(obs: NDArray[np.float32]) -> NDArray[np.float32]:
        return agent.predict(np.asarray(envs.normalize_obs(obs)), deterministic=True)[0]

    found = evaluate_exploration(act, uncertainty_weight=args.uncertainty_weight, model=args.model, config=str(config))
    print(f"{agent.num_timesteps} steps in {seconds:.0f} s, {agent.num_timesteps / seconds:.0f} a second: {found}")


if __name__ == "__main__":
    main()
