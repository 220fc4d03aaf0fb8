"""Measured log of a simulation: sensor noise, clock jitter and the two files of the log format."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np

from drive import JOINTS, Array
from motion import Motion
from plant import LEGS, Robot

JITTER = 5e-5  # [s], standard deviation of the time stamps


def _turn(quat: Array, angles: Array) -> Array:
    """Return quaternions (rows, 4) turned by small angles about the body's x, y and z [rad]."""
    w, v = quat[:, :1], quat[:, 1:]
    half = 0.5 * angles
    turned = np.hstack([w - np.sum(v * half, axis=1, keepdims=True), v + w * half + np.cross(v, half)])
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def measured_columns(clean: dict[str, Array], robot: Robot, rng: np.random.Generator) -> dict[str, Array]:
    """Return the columns of a log with sensor noise; `q` and `dq` have their noise already."""
    rows = len(clean["t"])
    noise = robot.noise

    def noisy(values: Array, sigma: float) -> Array:
        return values + sigma * rng.standard_normal(values.shape)

    columns: dict[str, Array] = {"t": clean["t"] + JITTER * rng.standard_normal(rows)}
    columns |= {"segment": clean["segment"], "episode": clean["episode"]}
    columns |= {"kp": clean["gains"][:, 0], "kd": clean["gains"][:, 1]}
    torque = noisy(clean["tau"], noise["tau_measured"])
    for index, joint in enumerate(JOINTS):
        columns[f"q_cmd_{joint}"] = clean["command"][:, index]
        columns[f"dq_cmd_{joint}"] = np.zeros(rows)
        columns[f"tau_ff_{joint}"] = np.zeros(rows)
        columns[f"q_{joint}"] = clean["q"][:, index]
        columns[f"dq_{joint}"] = clean["dq"][:, index]
        columns[f"tau_measured_{joint}"] = torque[:, index]
        columns[f"temp_{joint}"] = np.round(clean["temperature"][:, index] + 0.1 * rng.standard_normal(rows), 1)
    bias = robot.plant.get("gyro_bias", np.zeros(3))
    imu_tilt = np.append(robot.nuisance["imu_tilt"], 0.0)
    quat = _turn(clean["quat"], imu_tilt + noise["quat"] * rng.standard_normal((rows, 3)))
    vectors = {
        "gyro": noisy(clean["gyro"] + bias, noise["gyro"]),
        "acc": noisy(clean["acc"], noise["acc"]),
        "pos": noisy(clean["pos"], noise["pos"]),
        "vel": noisy(clean["vel"], noise["vel"]),
    }
    columns |= {f"quat_{axis}": quat[:, i] for i, axis in enumerate("wxyz")}
    columns |= {f"{name}_{axis}": v[:, i] for name, v in vectors.items() for i, axis in enumerate("xyz")}
    columns |= {f"contact_{leg}": clean["contact"][:, i] for i, leg in enumerate(LEGS)}
    columns["battery_V"] = np.round(noisy(clean["voltage"], 0.01), 3)
    return columns


def write_log(
    folder: Path,
    clean: dict[str, Array],
    robot: Robot,
    motion: Motion,
    rng: np.random.Generator,
) -> None:
    """Write `data.csv.gz` and `meta.json` of a simulation; the stated noise is wrong by up to 40 %."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = measured_columns(clean, robot, rng)
    table = np.column_stack(list(columns.values()))
    # Without a time stamp equal seeds give equal files.
    with gzip.GzipFile(folder / "data.csv.gz", "wb", compresslevel=3, mtime=0) as file:
        file.write((",".join(columns) + "\n").encode())
        np.savetxt(file, table, fmt="%.7g", delimiter=",")
    meta = {
        "rate_hz": 200,
        "policy_hz": 200,
        "joints": list(JOINTS),
        "tau_sensor": "current",
        "segments": [{"name": phase.name, "base": phase.base} for phase in motion.phases],
        "noise": {name: sigma * rng.uniform(0.7, 1.4) for name, sigma in robot.noise.items()},
        "pd": "kp (q_cmd - q) - kd dq at 200 Hz, held for 5 ms",
        "source": "tests/foreign: MuJoCo with actuators of its own",
    }
    (folder / "meta.json").write_text(json.dumps(meta, indent=1))
