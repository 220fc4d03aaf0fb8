"""Robots from files, against MuJoCo: the same trot in ``twinstep play`` and in the model of ``twinstep mjcf``."""

import json
import math
import subprocess
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from twinstep.server import find_program

Array = NDArray[np.float64]

ROBOTS = Path(__file__).parents[3] / "data" / "robots"
JOINTS = tuple(f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf"))
ACTUATOR_HZ = 200
TIMESTEP = 0.0005


def motion(pose: Array) -> Array:
    """Return 1 s in the default pose, then 1 s of a trot at 2 Hz: (rows, 12)."""
    rows = np.tile(pose, (2 * ACTUATOR_HZ + 1, 1)).reshape(-1, 4, 3)
    for period in range(ACTUATOR_HZ + 1):
        phase = math.tau * 2 * period / ACTUATOR_HZ
        for leg in range(4):
            swing = math.sin(phase) * (1 if leg in (0, 3) else -1)
            rows[ACTUATOR_HZ + period, leg] += [0.0, 0.1 * max(swing, 0.0), -0.25 * max(swing, 0.0)]
    return rows.reshape(-1, 12)


def play(folder: Path, model: Path, targets: Array, kp: float, kd: float) -> NDArray[np.void]:
    """Simulate ``targets`` with ``twinstep play`` and return the columns of its log."""
    source, log = folder / "motion.csv", folder / "played.csv"
    header = ",".join(["t", *(f"q_cmd_{joint}" for joint in JOINTS)])
    columns = np.column_stack([np.arange(len(targets)) / ACTUATOR_HZ, targets])
    np.savetxt(source, columns, delimiter=",", header=header, comments="", fmt="%.17g")
    meta = {"rate_hz": ACTUATOR_HZ, "tau_sensor": "none", "kp": kp, "kd": kd}
    (folder / "motion.json").write_text(json.dumps({**meta, "segments": [{"name": "motion", "base": "floating"}]}))
    subprocess.run([find_program(), "play", source, "--model", model, "--out", log], check=True)
    return np.genfromtxt(log, delimiter=",", names=True)


def in_mujoco(model_file: Path, targets: Array, kp: float, kd: float) -> tuple[Array, Array]:
    """Simulate in MuJoCo; return joint positions (rows, 12) and the poses of the base (rows, 7)."""
    command = [find_program(), "mjcf", "--model", model_file, "--timestep", str(TIMESTEP)]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    joints, bases = np.zeros((len(targets), 12)), np.zeros((len(targets), 7))
    for row, target in enumerate(targets):
        joints[row], bases[row] = data.qpos[-12:], data.qpos[:7]
        data.ctrl[:] = kp * (target - joints[row]) - kd * data.qvel[-12:]
        mujoco.mj_step(model, data, nstep=round(1 / (ACTUATOR_HZ * TIMESTEP)))
    return joints, bases


@pytest.mark.parametrize("name", ["go1", "a1", "b2", "aliengo", "spot"])
def test_robot_stands_and_trots_as_in_mujoco(tmp_path: Path, name: str) -> None:
    model = ROBOTS / f"{name}.toml"
    control = tomllib.loads(model.read_text())["control"]
    kp, kd, pose = control["kp"], control["kd"], np.array(control["default_pose"])
    targets = motion(pose)
    played = play(tmp_path, model, targets, kp, kd)
    joints, bases = in_mujoco(model, targets, kp, kd)
    ours = np.column_stack([played[f"q_{joint}"] for joint in JOINTS])
    stands = slice(ACTUATOR_HZ // 2, ACTUATOR_HZ)
    standing = abs(played["pos_z"][stands] - bases[stands, 2]).max()
    trotting = float(np.sqrt(np.mean((ours[ACTUATOR_HZ:] - joints[ACTUATOR_HZ:]) ** 2)))
    height = bases[ACTUATOR_HZ - 1, 2]
    print(f"{name}: height {height:.4f} m, difference {1e3 * standing:.2f} mm; joints of the trot {trotting:.4f} rad")
    assert standing < 0.005 * height
    assert trotting < 0.02
    for heights in (played["pos_z"], bases[:, 2]):
        assert heights.min() > 0.8 * height, "the robot falls"
