"""Facts about the drives and the robots of the generator."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from drive import Command, Drive, neutral
from families import CATALOGUE, joints_of
from motion import FLOATING, HANG_POSE, Motion, Phase, draw_motion, inverse_kinematics
from nuisance import draw_drive_nuisance, draw_nuisance
from outside import OUTSIDE
from pairs import combine
from plant import Robot
from rollout import simulate

PROGRAM = Path(__file__).parents[2] / "target/release/twinstep"


def held_torque(drive: Drive, error: float, speed: float) -> np.ndarray:
    """Return the sensor reading 30 ms after a constant position error and speed begin."""
    for _ in range(6):
        drive.receive(Command(np.full(12, error), 30.0, 0.8), np.zeros(12), np.full(12, speed))
        for _ in range(5):
            reading, _ = drive.motor(np.zeros(12), np.full(12, speed))
    return reading


def test_ideal_drive_follows_the_pd_law():
    assert np.allclose(held_torque(Drive(neutral()), 0.2, 1.5), 30.0 * 0.2 - 0.8 * 1.5)


def test_saturation_stays_below_kappa():
    drive = Drive(neutral() | {"kappa": np.full(12, 5.0)})
    for error in np.linspace(-1.0, 1.0, 21):
        assert np.abs(held_torque(drive, error, 0.0)).max() <= 5.0


@pytest.mark.parametrize(("delay", "steps"), [(0.002, 2), (0.0075, 7)])
def test_torque_delay_delays_a_step(delay, steps):
    drive = Drive(neutral() | {"torque_delay": np.full(12, delay)})
    readings = []
    for _ in range(4):
        drive.receive(Command(np.full(12, 0.1), 10.0, 0.0), np.zeros(12), np.zeros(12))
        readings += [drive.motor(np.zeros(12), np.zeros(12))[0][0] for _ in range(5)]
    assert np.allclose(readings[:steps], 0.0)
    assert np.allclose(readings[steps + 1 :], 1.0)
    assert np.isclose(readings[steps], 1.0 - (delay * 1000.0 - steps))


def test_command_delay_of_half_a_row_interpolates():
    drive = Drive(neutral() | {"command_delay": np.full(12, 0.0025)})
    for target in (0.0, 1.0):
        drive.receive(Command(np.full(12, target), 2.0, 0.0), np.zeros(12), np.zeros(12))
    assert np.allclose(drive.requested, 1.0)


def test_lag_reaches_63_percent_after_its_time_constant():
    drive = Drive(neutral() | {"lag": np.full(12, 0.01)})
    for _ in range(2):
        drive.receive(Command(np.full(12, 0.1), 10.0, 0.0), np.zeros(12), np.zeros(12))
        for _ in range(5):
            reading, _ = drive.motor(np.zeros(12), np.zeros(12))
    assert np.allclose(reading, 1.0 - np.exp(-1.0))


@pytest.mark.parametrize(
    ("scope", "count"),
    [("all", 12), ("calf", 4), ("FL", 3), ("FL_calf", 1), ("base", 0)],
)
def test_scopes_contain_their_joints(scope, count):
    assert joints_of(scope).sum() == count


@pytest.mark.parametrize("name", [*CATALOGUE, *OUTSIDE])
def test_every_family_changes_the_robot(name):
    rng = np.random.default_rng(1)
    ideal = draw_drive_nuisance(rng)
    drive, plant = combine([(CATALOGUE | OUTSIDE)[name](rng, 0.6)], ideal)
    assert plant or any(not np.array_equal(drive[key], ideal[key]) for key in ideal)


def test_inverse_kinematics_of_straight_legs_is_symmetric():
    feet = np.zeros((1, 4, 3))
    feet[..., 1] = 0.0955 * np.array([1.0, -1.0, 1.0, -1.0])
    feet[..., 2] = -0.3
    angles = inverse_kinematics(feet).reshape(4, 3)
    assert np.allclose(angles[:, 0], 0.0)
    assert np.allclose(angles[:, 1], -0.5 * angles[:, 2])


@pytest.fixture
def xml():
    if not PROGRAM.exists():
        pytest.skip("build `twinstep` in release mode first")
    return subprocess.run([PROGRAM, "mjcf"], check=True, capture_output=True, text=True).stdout


def test_healthy_robot_stands_and_measures_its_pd_torque(xml):
    rng = np.random.default_rng(2)
    noise = {"q": 0.0, "dq": 0.0}
    robot = Robot(neutral(), draw_nuisance(rng), noise)
    sway = next(p for p in draw_motion(rng, 1.0).phases if p.name == "sway")
    pose = np.repeat(sway.commands[:1], 200, axis=0)
    rows = simulate(robot, Motion((Phase("stand", FLOATING, 60.0, 1.5, pose),), 0.29), xml, 0)
    expected = 60.0 * (rows["command"] - rows["q"]) - 1.5 * rows["dq"]
    assert np.allclose(rows["tau"], expected, atol=1e-9)
    assert rows["pos"][:, 2].min() > 0.22
    assert rows["contact"].all()


def test_gear_with_a_stiff_spring_moves_like_a_rigid_one(xml):
    nuisance = draw_nuisance(np.random.default_rng(3)) | {"gear_rotor": 0.0}
    t = np.arange(200)[:, None] / 200.0
    pose = HANG_POSE + 0.1 * np.sin(2.0 * np.pi * 2.0 * t)
    motion = Motion((Phase("hang", "fixed", 30.0, 0.8, pose),), 0.29)
    noise = {"q": 0.0, "dq": 0.0}
    stiff = neutral() | {"stiffness": np.full(12, 5000.0)}
    one, two = (simulate(Robot(drive, nuisance, noise), motion, xml, 0)["q"] for drive in (neutral(), stiff))
    assert np.abs(one - two).max() < 0.004
