"""Train exploration policies in the simulator's process and over the wire, and judge all by the same robots.

Needs ``pip install "twinstep[sb3,rsl-rl]" onnxruntime``. The steps are those of one training; trainings run one after
the other. Example:

    python explore_remote.py --model robot.toml --base walk.safetensors --seeds 3
"""

import argparse
import csv
import re
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from twinstep import EmbeddedServer
from twinstep.exploration import ExplorationMeasure, evaluate_exploration, write_config
from twinstep.server import find_program

EXAMPLES = Path(__file__).resolve().parent
Result = tuple[float, float, float]
"""Environment steps per second, uncertainty [nat], falls a minute."""


def judged(policy: Path, args: argparse.Namespace) -> ExplorationMeasure:
    """Return what a policy of ``twinstep train`` explores."""
    session = onnxruntime.InferenceSession(str(policy), providers=["CPUExecutionProvider"])

    def act(obs: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(session.run(["action"], {"obs": obs})[0], np.float32)

    config = str(args.out / "server.toml")
    return evaluate_exploration(act, uncertainty_weight=args.uncertainty_weight, model=args.model, config=config)


def train_rust(args: argparse.Namespace, seed: int, out: Path, is_remote: bool) -> Result:
    """Train with ``twinstep train``, in its process or on the robots of a server."""
    config = args.out / "server.toml"
    command = [find_program(), "train", "explore", "--out", str(out), "--seed", str(seed), "--steps", str(args.steps)]
    command += ["--envs", str(args.envs), "--base", str(args.base)]
    if is_remote:
        # Its process evaluates 256 robots at the end.
        server = EmbeddedServer(
            ("--task", "explore", "--envs", str(args.envs + 256), "--config", str(config), "--model", args.model)
        )
        command += ["--endpoint", server.endpoint]
        subprocess.run(command, check=True, capture_output=True)
        server.release()
    else:
        local = ["--config", str(config), "--model", args.model]
        subprocess.run([*command, *local], check=True, capture_output=True)
    with (out / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    seconds = sum(float(row["rollout_s"]) + float(row["update_s"]) for row in rows)
    found = judged(out / "policy.onnx", args)
    return float(rows[-1]["env_steps"]) / seconds, found.uncertainty, found.falls_per_minute


def train_example(args: argparse.Namespace, seed: int, out: Path, name: str) -> Result:
    """Train with an example of the Python client."""
    command = [sys.executable, str(EXAMPLES / name), "--model", args.model, "--base", str(args.base)]
    command += ["--uncertainty-weight", str(args.uncertainty_weight)]
    command += ["--envs", str(args.envs), "--steps", str(args.steps), "--seed", str(seed), "--out", str(out)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    line = re.search(r"([\d.]+) a second: uncertainty ([\d.]+) nat, ([\d.]+) falls", printed)
    assert line, printed
    return float(line[1]), float(line[2]), float(line[3])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", required=True, help="model file with an [actuator] table")
    parser.add_argument("--base", type=Path, required=True, help="policy of `walk`: policy.safetensors")
    parser.add_argument("--uncertainty-weight", type=float, default=10.0, help="per second and nat")
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=2_000_000, help="environment steps of one training")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("remote-exploration"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    write_config(args.out / "server.toml", args.base, uncertainty_weight=args.uncertainty_weight)
    ways: dict[str, Callable[[int, Path], Result]] = {
        "twinstep train, in process": lambda seed, out: train_rust(args, seed, out, is_remote=False),
        "twinstep train, over the wire": lambda seed, out: train_rust(args, seed, out, is_remote=True),
        "Stable-Baselines3": lambda seed, out: train_example(args, seed, out, "explore_sb3.py"),
        "rsl_rl": lambda seed, out: train_example(args, seed, out, "explore_rsl_rl.py"),
    }
    found: dict[str, list[Result]] = {way: [] for way in ways}
    for seed in range(1, args.seeds + 1):
        for index, (way, train) in enumerate(ways.items()):
            found[way].append(train(seed, args.out / f"{seed}-{index}"))
            print(seed, way, found[way][-1], file=sys.stderr, flush=True)
    idle = evaluate_exploration(
        lambda obs: np.zeros((len(obs), 12), np.float32),
        uncertainty_weight=args.uncertainty_weight,
        model=args.model,
        config=str(args.out / "server.toml"),
    )
    print("| trained by | env-steps/s, median | uncertainty by seed [nat] | mean | falls a minute, mean |")
    print("|---|---|---|---|---|")
    print(f"| base policy alone | | {idle.uncertainty:.3f} | {idle.uncertainty:.3f} | {idle.falls_per_minute:.2f} |")
    for way, results in found.items():
        rates, nats, falls = zip(*results, strict=True)
        by_seed = ", ".join(f"{nat:.3f}" for nat in nats)
        print(
            f"| {way} | {statistics.median(rates):,.0f} | {by_seed} | {statistics.mean(nats):.3f} "
            f"| {statistics.mean(falls):.2f} |"
        )


if __name__ == "__main__":
    main()
