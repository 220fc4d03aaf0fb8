"""Command line: draw robots with hidden effects and write their logs and ground truths."""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drive import Array
from families import CATALOGUE, Hidden, Rng
from motion import Motion, draw_motion
from nuisance import draw_drive_nuisance, draw_noise, draw_nuisance
from outside import OUTSIDE
from pairs import combine, draw_pair
from plant import Robot
from record import write_log
from rollout import FallError, simulate

ROOT = Path(__file__).resolve().parents[2]
SUITES = ("single", "healthy", "outside", "pairs")
ATTEMPTS = 6  # motions that are tried before another effect is drawn


def family_of(suite: str, seed: int, case: int) -> str:
    """Return the family of a case: every family once in each shuffled cycle."""
    names = {
        "single": list(CATALOGUE),
        "outside": list(OUTSIDE),
        "healthy": ["nothing"],
    }
    cycle = names.get(suite, ["confounded", "any_two"])
    order = np.random.default_rng([seed, SUITES.index(suite), case // len(cycle)]).permutation(len(cycle))
    return cycle[order[case % len(cycle)]]


def draw_hidden(suite: str, family: str, rng: Rng) -> list[Hidden]:
    """Draw the hidden effects of one robot."""
    if suite == "healthy":
        return []
    if suite == "pairs":
        return draw_pair(rng, family == "confounded")
    draws = CATALOGUE if suite == "single" else OUTSIDE
    return [draws[family](rng, rng.uniform(0.2, 1.0))]


def draw_case(suite: str, family: str, seed: list[int], xml: str) -> tuple[Robot, Motion, list[Hidden], Any, int]:
    """Draw robots and motions until one neither falls nor oscillates; return it with its rows and attempts."""
    rng = np.random.default_rng(seed)
    nuisance_drive, nuisance, noise = (
        draw_drive_nuisance(rng),
        draw_nuisance(rng),
        draw_noise(rng),
    )
    for attempt in range(10 * ATTEMPTS):
        if attempt % ATTEMPTS == 0:
            hidden = draw_hidden(suite, family, rng)
        motion = draw_motion(rng, 0.85 ** (attempt % ATTEMPTS))
        drive, plant = combine(hidden, nuisance_drive)
        robot = Robot(drive, nuisance, noise, plant)
        try:
            return (
                robot,
                motion,
                hidden,
                simulate(robot, motion, xml, seed[-1]),
                attempt + 1,
            )
        except FallError:
            continue
    raise RuntimeError(f"{family}: every robot falls; lower its largest severity")


def information(
    robot: Robot,
    motion: Motion,
    rows: dict[str, Array],
    base: Robot,
    xml: str,
    seed: int,
) -> Any:
    """Return root mean square differences that the hidden effect makes to channels [rad, N·m, m, rad/s]."""
    try:
        other = simulate(base, motion, xml, seed)
    except FallError:
        return None
    hanging = rows["episode"] == 0
    bias = robot.plant.get("gyro_bias", np.zeros(3))
    pairs = {"q": rows["q"] - other["q"], "tau": rows["tau"] - other["tau"]}
    parts = {"hanging": hanging, "standing": ~hanging}
    out = {f"{name}_{part}": _worst(d[mask]) for name, d in pairs.items() for part, mask in parts.items()}
    out["pos_standing"] = _worst((rows["pos"] - other["pos"])[~hanging])
    out["gyro_standing"] = _worst((rows["gyro"] + bias - other["gyro"])[~hanging])
    out["gyro_hanging"] = _worst((rows["gyro"] + bias - other["gyro"])[hanging])
    return out


def _worst(difference: Array) -> float:
    """Return the largest root mean square over the columns."""
    return float(np.sqrt(np.mean(difference**2, axis=0)).max())


def write_case(folder: Path, suite: str, family: str, seed: list[int], xml: str) -> str:
    """Generate one case into a folder and return a line that describes it."""
    start = time.monotonic()
    robot, motion, hidden, rows, attempts = draw_case(suite, family, seed, xml)
    nuisance_drive = draw_drive_nuisance(np.random.default_rng(seed))
    base = replace(robot, drive=nuisance_drive, plant={})
    shown = information(robot, motion, rows, base, xml, seed[-1]) if hidden else None
    if folder.exists():
        shutil.rmtree(folder)
    write_log(folder / "log", rows, robot, motion, np.random.default_rng([*seed, 1]))
    effects = [
        {
            "effect": h.effect,
            "scope": h.scope,
            "parameters": h.parameters,
            "severity": h.severity,
        }
        for h in hidden
    ]
    truth = {
        "suite": suite,
        "family": family,
        "seed": seed,
        "effects": effects,
        "information": shown,
        "attempts": attempts,
        "noise": robot.noise,
        "nuisance": {name: np.asarray(value).tolist() for name, value in robot.nuisance.items()},
        "nuisance_drive": {
            k: nuisance_drive[k].tolist() for k in ("kp_scale", "kd_scale", "viscous", "coulomb", "rotor")
        },
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1))
    names = ", ".join(f"{h.effect}@{h.scope} {h.severity:.2f}" for h in hidden) or "nothing"
    seen = "" if shown is None else " ".join(f"{k} {v:.2g}" for k, v in shown.items())
    return f"{folder.name} {names} | {attempts} attempts, {time.monotonic() - start:.1f} s | {seen}"


def main() -> None:
    """Write the cases of one suite; complete cases are skipped."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--cases", type=int, required=True)
    parser.add_argument("--suite", choices=SUITES, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/twinstep")
    args = parser.parse_args()
    xml = subprocess.run([args.program, "mjcf"], check=True, capture_output=True, text=True).stdout
    for case in range(args.cases):
        folder = args.out / f"case_{case:03d}"
        if (folder / "truth.json").exists():
            continue
        family = family_of(args.suite, args.seed, case)
        line = write_case(folder, args.suite, family, [args.seed, SUITES.index(args.suite), case], xml)
        print(line, flush=True)


if __name__ == "__main__":
    main()
