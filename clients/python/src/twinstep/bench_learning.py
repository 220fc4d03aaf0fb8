"""Compare the training rate with rsl_rl and Stable-Baselines3: ``python -m twinstep.bench_learning``.

All three train networks of the same sizes, with as many robots, steps, epochs and minibatches, on the same server, one
after the other and in turn. Needs ``pip install "twinstep[sb3,rsl-rl]"``.
"""

import argparse
import csv
import io
import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from rsl_rl.runners import OnPolicyRunner
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from . import rsl_rl, sb3
from .server import EmbeddedServer, find_program

HORIZON, EPOCHS, MINIBATCHES, HIDDEN = 24, 2, 4, [128, 128]
EVALUATED = 256
"""Robots that ``twinstep train`` evaluates its policy on."""


@dataclass(frozen=True)
class Timing:
    """Times of one training without its first update [s]."""

    rollout: float
    update: float
    env_steps: int

    @property
    def rate(self) -> float:
        """Environment steps per second."""
        return self.env_steps / (self.rollout + self.update)


def train_twinstep(endpoint: str | None, num_envs: int, updates: int) -> Timing:
    """Train with ``twinstep train``, on the server's robots or in its own process."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "config.toml"
        sizes = f"num_envs = {num_envs}\nhorizon = {HORIZON}\nepochs = {EPOCHS}\nminibatches = {MINIBATCHES}\n"
        networks = f"actor_hidden = {HIDDEN}\ncritic_hidden = {HIDDEN}\n"
        config.write_text(f"[sim]\nphysics_hz = 400\n[train]\n{sizes}{networks}")
        out = Path(folder) / "out"
        steps = str(num_envs * HORIZON * (1 + updates))
        command = [find_program(), "train", "--config", str(config), "--steps", steps, "--out", str(out)]
        server = ["--endpoint", endpoint] if endpoint else []
        subprocess.run([*command, *server], check=True, capture_output=True)
        with (out / "progress.csv").open() as file:
            rows = list(csv.DictReader(file))[1:]
    rollout, update = (sum(float(row[column]) for row in rows) for column in ("rollout_s", "update_s"))
    return Timing(rollout, update, num_envs * HORIZON * len(rows))


def train_rsl_rl(endpoint: str, num_envs: int, updates: int) -> Timing:
    """Train with rsl_rl, whose critic also observes the group ``critic``."""
    model = {"class_name": "MLPModel", "hidden_dims": HIDDEN, "activation": "relu", "obs_normalization": True}
    config: dict[str, Any] = {
        "num_steps_per_env": HORIZON,
        "save_interval": 10**9,
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "critic"]},
        "algorithm": {"class_name": "PPO", "num_mini_batches": MINIBATCHES, "num_learning_epochs": EPOCHS},
        "actor": {**model, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5}},
        "critic": dict(model),
    }
    envs = rsl_rl.make_vec_env(num_envs=num_envs, seed=1, critic=True, endpoint=endpoint)
    # It prints its networks and every iteration.
    with redirect_stdout(io.StringIO()):
        runner = cast(Any, OnPolicyRunner(envs, config, log_dir=None, device="cpu"))
        timed = _Timed(runner.alg.update)
        runner.alg.update = timed
        runner.learn(1 + updates)
    envs.close()
    return timed.timing(num_envs * HORIZON * updates)


def train_sb3(endpoint: str, num_envs: int, updates: int) -> Timing:
    """Train with Stable-Baselines3, whose critic has the observation of the actor."""
    envs = VecNormalize(sb3.make_vec_env(n_envs=num_envs, seed=1, endpoint=endpoint))
    agent = PPO(
        "MlpPolicy",
        envs,
        n_steps=HORIZON,
        batch_size=HORIZON * num_envs // MINIBATCHES,
        n_epochs=EPOCHS,
        policy_kwargs={"net_arch": HIDDEN, "activation_fn": torch.nn.ReLU},
        device="cpu",
    )
    timed = _Timed(agent.train)
    cast(Any, agent).train = timed
    agent.learn(num_envs * HORIZON * (1 + updates), callback=cast(BaseCallback, None))
    envs.close()
    return timed.timing(num_envs * HORIZON * updates)


class _Timed:
    """Calls the update of an agent and stores when each call began and ended."""

    def __init__(self, update: Callable[[], Any]) -> None:
        self._update = update
        self._times = list[tuple[float, float]]()

    def __call__(self) -> Any:
        since = time.perf_counter()
        result = self._update()
        self._times.append((since, time.perf_counter()))
        return result

    def timing(self, env_steps: int) -> Timing:
        update = sum(end - since for since, end in self._times[1:])
        total = self._times[-1][1] - self._times[0][1]
        return Timing(total - update, update, env_steps)


def main() -> None:
    """Run the trainings in turn and print the medians."""
    parser = argparse.ArgumentParser(prog="python -m twinstep.bench_learning", description=__doc__)
    parser.add_argument("--envs", type=int, default=1024, help="number of robots")
    parser.add_argument("--updates", type=int, default=20, help="updates of each training")
    parser.add_argument("--rounds", type=int, default=3, help="trainings of each library")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="threads of PyTorch")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    server = EmbeddedServer(("--task", "walk", "--envs", str(2 * arguments.envs + EVALUATED), "--physics-hz", "400"))
    cases: dict[str, Callable[[int, int], Timing]] = {
        "twinstep, in process": lambda envs, updates: train_twinstep(None, envs, updates),
        "twinstep": lambda envs, updates: train_twinstep(server.endpoint, envs, updates),
        "rsl_rl": lambda envs, updates: train_rsl_rl(server.endpoint, envs, updates),
        "Stable-Baselines3": lambda envs, updates: train_sb3(server.endpoint, envs, updates),
    }
    timings: dict[str, list[Timing]] = {name: [] for name in cases}
    for _ in range(arguments.rounds):
        for name, train in cases.items():
            timings[name].append(train(arguments.envs, arguments.updates))
    server.release()
    rows = [_row(name, measured) for name, measured in timings.items()]
    if arguments.json:
        print(json.dumps({"rows": rows, "threads": arguments.threads}))
        return
    print(f"{'':<24}{'env-steps/s':>12}{'rollout':>12}{'update':>12}   per env-step")
    for row in rows:
        print(f"{row['case']:<24}{row['rate']:>12.0f}{row['rollout_us']:>9.2f} µs{row['update_us']:>9.2f} µs")


def _row(name: str, timings: list[Timing]) -> dict[str, Any]:
    """Return the medians over the trainings of a library."""
    return {
        "case": name,
        "rate": statistics.median(timing.rate for timing in timings),
        "rollout_us": statistics.median(1e6 * timing.rollout / timing.env_steps for timing in timings),
        "update_us": statistics.median(1e6 * timing.update / timing.env_steps for timing in timings),
    }


if __name__ == "__main__":
    main()
