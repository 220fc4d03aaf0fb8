"""Comparison with MuJoCo: the same motions in ``twinstep play`` and in the model of ``twinstep mjcf``.

Both start from the same state. The PD torque is held for each actuator period of 5 ms.
"""

import json
import math
import subprocess
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from twinstep.server import find_program

Array = NDArray[np.float64]

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = tuple(f"{leg}_{part}" for leg in LEGS for part in ("hip", "thigh", "calf"))
POSE = np.array([[0.1 if leg[1] == "L" else -0.1, 0.8 if leg[0] == "F" else 1.0, -1.5] for leg in LEGS]).ravel()
ACTUATOR_HZ = 200
KP, KD = 40.0, 1.0
SETTLING_ROWS = ACTUATOR_HZ // 2
GRAVITY = 9.81


def step_target(_: int) -> Array:
    """Return a step of all joint targets."""
    return POSE + np.tile([0.1, 0.1, -0.2], 4)


def trot_target(period: int) -> Array:
    """Return the joint targets of a trot at 2 Hz, in which diagonal legs alternate."""
    phase = math.tau * 2 * period / ACTUATOR_HZ
    target = POSE.reshape(4, 3).copy()
    for leg in range(4):
        swing = math.sin(phase) * (1 if leg in (0, 3) else -1)
        target[leg] += [0.0, 0.1 * math.cos(phase) * math.copysign(1.0, swing), -0.25 * max(swing, 0.0)]
    return target.ravel()


def motion(target: Callable[[int], Array]) -> Array:
    """Return 0.5 s in the default pose, then 1 s of ``target``: (rows, 12)."""
    return np.array([*[POSE] * SETTLING_ROWS, *[target(period) for period in range(ACTUATOR_HZ + 1)]])


def play(folder: Path, targets: Array, base: str, physics_hz: int) -> dict[str, Array]:
    """Simulate ``targets`` with ``twinstep play`` and return the columns of its log."""
    source, log = folder / "motion.csv", folder / "played.csv"
    columns = np.column_stack([np.arange(len(targets)) / ACTUATOR_HZ, targets])
    header = ",".join(["t", *(f"q_cmd_{joint}" for joint in JOINTS)])
    np.savetxt(source, columns, delimiter=",", header=header, comments="", fmt="%.17g")
    meta = {"rate_hz": ACTUATOR_HZ, "tau_sensor": "none", "kp": KP, "kd": KD}
    (folder / "motion.json").write_text(json.dumps({**meta, "segments": [{"name": "motion", "base": base}]}))
    engine = ["--engine", "batch", "--physics-hz", str(physics_hz)]
    subprocess.run([find_program(), "play", source, *engine, "--out", log], check=True)
    played = np.genfromtxt(log, delimiter=",", names=True)
    return {name: played[name] for name in played.dtype.names}


def rows_of(played: dict[str, Array], quantity: str, parts: tuple[str, ...]) -> Array:
    return np.column_stack([played[f"{quantity}_{part}"] for part in parts])


def in_mujoco(targets: Array, played: dict[str, Array], base: str, timestep: float) -> tuple[Array, Array]:
    """Simulate in MuJoCo from the first row of ``played``; return joint (rows, 12) and base positions (rows, 3)."""
    command = [find_program(), "mjcf", "--base", base, "--timestep", str(timestep)]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    start = rows_of(played, "q", JOINTS)[0]
    if base == "floating":
        position = rows_of(played, "pos", ("x", "y", "z"))[0]
        orientation = rows_of(played, "quat", ("w", "x", "y", "z"))[0]
        start = np.concatenate([position, orientation, start])
    data.qpos[:] = start
    steps = round(1 / (ACTUATOR_HZ * timestep))
    joints, bases = np.zeros((len(targets), 12)), np.zeros((len(targets), 3))
    for row, target in enumerate(targets):
        joints[row], bases[row] = data.qpos[-12:], data.qpos[:3]
        data.ctrl[:] = KP * (target - joints[row]) - KD * data.qvel[-12:]
        mujoco.mj_step(model, data, nstep=steps)
    return joints, bases


def rmse(one: Array, other: Array) -> float:
    return float(np.sqrt(np.mean((one - other) ** 2)))


@pytest.mark.parametrize("target", [step_target, trot_target])
def test_fixed_base_is_closer_to_fine_mujoco_than_mujoco_at_the_same_step(
    tmp_path: Path, target: Callable[[int], Array]
) -> None:
    targets = motion(target)
    played = play(tmp_path, targets, "fixed", 1000)
    fine, _ = in_mujoco(targets, played, "fixed", 0.00005)
    coarse, _ = in_mujoco(targets, played, "fixed", 0.001)
    ours, theirs = (rmse(q, fine) for q in (rows_of(played, "q", JOINTS), coarse))
    print(f"{target.__name__}, fixed base, 1 kHz: {ours:.2e} rad, MuJoCo {theirs:.2e} rad from MuJoCo at 20 kHz")
    assert ours < min(1e-4, theirs / 3)


@pytest.mark.parametrize(("target", "limit"), [(step_target, 0.003), (trot_target, 0.015)])
def test_floating_base_moves_as_in_fine_mujoco(tmp_path: Path, target: Callable[[int], Array], limit: float) -> None:
    targets = motion(target)
    played = play(tmp_path, targets, "floating", 1000)
    joints, _ = in_mujoco(targets, played, "floating", 0.0005)
    error = rmse(rows_of(played, "q", JOINTS)[SETTLING_ROWS:], joints[SETTLING_ROWS:])
    print(f"{target.__name__}: {error:.5f} rad")
    assert error < limit


@pytest.mark.parametrize("target", [step_target, trot_target])
@pytest.mark.parametrize("physics_hz", [200, 400, 1000])
def test_accuracy_at_each_rate_is_close_to_that_of_mujoco(
    tmp_path: Path, target: Callable[[int], Array], physics_hz: int
) -> None:
    targets = motion(target)
    played = play(tmp_path, targets, "floating", physics_hz)
    fine, _ = in_mujoco(targets, played, "floating", 0.0005)
    coarse, _ = in_mujoco(targets, played, "floating", 1 / physics_hz)
    ours, theirs = (rmse(q[SETTLING_ROWS:], fine[SETTLING_ROWS:]) for q in (rows_of(played, "q", JOINTS), coarse))
    print(f"{target.__name__} {physics_hz} Hz: {ours:.5f} rad, MuJoCo {theirs:.5f} rad from MuJoCo at 2 kHz")
    # Tolerance: a quarter, and 0.5 mrad for the difference of the contact models at any rate.
    assert ours < 1.25 * theirs + 0.0005


def test_feet_carry_the_weight_and_the_creep_is_at_most_twice_that_of_mujoco(tmp_path: Path) -> None:
    targets = np.tile(POSE, (60 * ACTUATOR_HZ + 1, 1))
    played = play(tmp_path, targets, "floating", 1000)
    mass = 15.206408
    force = rows_of(played, "foot_force", LEGS)[-ACTUATOR_HZ:].sum(axis=1).mean()
    print(f"feet carry {force:.3f} N of {mass * GRAVITY:.3f} N")
    assert abs(force / (mass * GRAVITY) - 1) < 1e-3
    _, bases = in_mujoco(targets, played, "floating", 0.001)
    ours, theirs = (creep(path) for path in (rows_of(played, "pos", ("x", "y", "z")), bases))
    print(f"creep in 5..60 s: {1e3 * ours:.2f} mm, MuJoCo {1e3 * theirs:.2f} mm")
    assert ours <= 2 * theirs


def creep(path: Array) -> float:
    """Return the distance that the base moved after the first 5 s [m]."""
    return float(np.linalg.norm(path[-1] - path[5 * ACTUATOR_HZ]))
