"""Train an exploration policy with PPO of rsl_rl: the reward is what an actuator ensemble does not know.

Needs ``pip install "twinstep[rsl-rl]"``, a model file with an ensemble of actuator networks (``twinstep fit``), and a
policy of ``walk``, to whose actions the trained policy adds a bounded residual (U2E, §III-C).
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from ppo_rsl_rl import STEPS_PER_ENV, config
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from twinstep.exploration import evaluate_exploration, write_config
from twinstep.rsl_rl import make_vec_env


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", required=True, help="model file with an [actuator] table: robot.toml of `fit`")
    parser.add_argument("--base", type=Path, required=True, help="policy of `walk`: policy.safetensors")
    parser.add_argument("--uncertainty-weight", type=float, default=10.0, help="per second and nat")
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=2_000_000, help="total number of environment steps")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("explore-rsl-rl"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    since = time.monotonic()
    torch.manual_seed(args.seed)
    # The network is too small for several threads, which would take cores from the server's simulation.
    torch.set_num_threads(1)

    server = args.out / "server.toml"
    write_config(server, args.base, uncertainty_weight=args.uncertainty_weight)
    envs = make_vec_env(
        "twinstep/Go2-Explore-v0",
        num_envs=args.envs,
        seed=args.seed,
        critic=True,
        model=args.model,
        config=str(server),
    )
    runner = OnPolicyRunner(envs, config(args.seed), log_dir=str(args.out), device="cpu")
    iterations = max(1, args.steps // (STEPS_PER_ENV * args.envs))
    runner.learn(iterations, init_at_random_ep_len=True)
    policy = runner.get_inference_policy()
    seconds = time.monotonic() - since
    envs.close()

    def act(obs: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.inference_mode():
            return policy(TensorDict({"policy": torch.from_numpy(obs)}, batch_size=[len(obs)])).numpy()

    found = evaluate_exploration(act, uncertainty_weight=args.uncertainty_weight, model=args.model, config=str(server))
    steps = iterations * STEPS_PER_ENV * args.envs
    print(f"{steps} steps in {seconds:.0f} s, {steps / seconds:.0f} a second: {found}")


if __name__ == "__main__":
    main()
