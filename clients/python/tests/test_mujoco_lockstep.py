"""``python -m twinstep.mujoco`` as a process, and its robots."""

import io
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

import twinstep
from twinstep.mujoco.frames import (
    PROTOCOL,
    Hello,
    Layout,
    Reset,
    Step,
    read_frame,
    reset_body,
    step_body,
    write_frame,
)
from twinstep.mujoco.lockstep import ModelError, Robots, serve
from twinstep.server import find_program

POSE = np.tile([0.0, 0.8, -1.5], 4)
WEIGHT = 15.206408 * 9.81
STEPS = 5
LEGS = ("FL", "FR", "RL", "RR")
LAYOUT = Layout(
    tuple(f"{leg}_{kind}" for leg in LEGS for kind in ("hip", "thigh", "calf")),
    (*(f"{leg}_foot" for leg in LEGS), "trunk", *(f"{leg}_knee" for leg in LEGS)),
)


def exported(*flags: str) -> str:
    return subprocess.run([find_program(), "mjcf", *flags], check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def model() -> str:
    return exported()


def initial_state(height: float) -> NDArray[np.void]:
    state = np.zeros(1, LAYOUT.initial_state)
    state["base_position"][0] = [0, 0, height]
    state["base_orientation"][0] = [2, 0, 0, 0]
    state["q"] = POSE
    return state


def hold(robots: int) -> NDArray[np.void]:
    commands = np.zeros(robots, LAYOUT.command)
    commands["q"], commands["kp"], commands["kd"] = POSE, 40, 1
    return commands


def states(reply: bytes, robots: int) -> tuple[NDArray[np.void], NDArray[np.void]]:
    measured = np.frombuffer(reply, LAYOUT.measured, robots)
    return measured, np.frombuffer(reply, LAYOUT.truth, robots, measured.nbytes)


def standing(model: str, robots: int, threads: int = 1) -> Robots:
    created = Robots(Hello(robots, threads, 64, STEPS, 1, LAYOUT, model))
    created.reset([Reset(robot, initial_state(0.33), "") for robot in range(robots)])
    return created


def test_standing_robot_is_carried_by_its_feet(model: str) -> None:
    robots = standing(model, 1)
    measured, truth = states(robots.step(Step(400, np.ones(1, np.bool_), hold(1))), 1)
    assert truth["geom_force"][0, :4].sum() == pytest.approx(WEIGHT, rel=0.01)
    assert (truth["geom_force"][0, 4:] == 0).all()
    assert np.abs(measured["q"] - POSE).max() < 0.2
    assert np.linalg.norm(measured["orientation"]) == pytest.approx(1, abs=1e-6)


def test_torque_is_held_for_an_actuator_period_and_clipped(model: str) -> None:
    robots, commands = standing(model, 1), hold(1)
    commands["q"][0, 0] += 0.1
    commands["tau_ff"][0, 2] = 1000
    start = np.frombuffer(robots.reset([Reset(0, initial_state(0.5), "")]), LAYOUT.measured, 1)
    assert (start["q"] == POSE.astype("<f4")).all()
    measured, _ = states(robots.step(Step(1, np.ones(1, np.bool_), commands)), 1)
    # 40 N·m/rad times 0.1 rad, from the state at the start of the period.
    assert measured["tau"][0, 0] == pytest.approx(4, rel=1e-4)
    assert measured["tau"][0, 2] == pytest.approx(45.43)
    assert measured["q"][0, 2] > POSE[2] + 0.02


def test_robots_are_equal_for_any_number_of_threads_and_actuator_periods_per_request(model: str) -> None:
    one, many = standing(model, 3), standing(model, 3, threads=3)
    active = np.array([True, False, True])
    for _ in range(4):
        expected = one.step(Step(1, active, hold(3)))
    assert many.step(Step(4, active, hold(3))) == expected
    measured, _ = states(expected, 3)
    assert (measured["q"][0] == measured["q"][2]).all()
    assert (measured["q"][1] == POSE.astype("<f4")).all()


def test_only_the_robot_with_a_command_that_is_not_finite_diverges(model: str) -> None:
    robots, commands = standing(model, 2), hold(2)
    commands["q"][1, 4] = np.nan
    measured, truth = states(robots.step(Step(4, np.ones(2, np.bool_), commands)), 2)
    assert np.isfinite(measured["q"][0]).all()
    assert np.isnan(measured["dq"][1]).all()
    assert np.isnan(truth["base_position"][1]).all()
    robots.reset([Reset(1, initial_state(0.33), "")])
    measured, _ = states(robots.step(Step(4, np.ones(2, np.bool_), hold(2))), 2)
    assert np.isfinite(measured["q"]).all()


def test_model_of_a_reset_acts_until_the_next_reset(model: str) -> None:
    robots = standing(model, 1)
    heavy = model.replace('armature="0.', 'frictionloss="5" armature="0.')
    assert heavy != model
    step = Step(40, np.ones(1, np.bool_), hold(1))
    nominal = robots.step(step)
    robots.reset([Reset(0, initial_state(0.33), heavy)])
    assert robots.step(step) != nominal
    robots.reset([Reset(0, initial_state(0.33), "")])
    assert robots.step(step) == nominal


def test_fixed_base_stays_where_it_is_placed() -> None:
    robots = standing(exported("--base", "fixed"), 2)
    robots.reset([Reset(1, initial_state(0.7), "")])
    _, truth = states(robots.step(Step(20, np.ones(2, np.bool_), hold(2))), 2)
    assert truth["base_position"][:, 2] == pytest.approx([0.33, 0.7])
    assert (truth["base_linear_velocity"] == 0).all()


def test_joint_that_the_model_does_not_have_is_named(model: str) -> None:
    layout = Layout(("knee",), ())
    with pytest.raises(ModelError, match="the model has no joint or geom named 'knee'"):
        Robots(Hello(1, 1, 64, STEPS, 1, layout, model))


def test_invalid_model_is_rejected(model: str) -> None:
    with pytest.raises(ModelError, match="MuJoCo rejects the model of a robot"):
        standing(model, 1).reset([Reset(0, initial_state(0.33), "<mujoco><nonsense/></mujoco>")])


def hello(model: str, version: int = PROTOCOL) -> bytes:
    names = "\t".join(LAYOUT.joints) + "\n" + "\t".join(LAYOUT.geoms)
    return f"twinstep-mujoco {version} robots=1 threads=1 iterations=64 steps={STEPS} base=1\n{names}\n{model}".encode()


@pytest.mark.parametrize(
    ("kind", "body", "message"),
    [
        (b"Q", b"", "b'Q' is not a request"),
        (b"P", b"\x01\0\0\0", "a push has 4 bytes; 16 are expected"),
        (b"P", b"\x07\0\0\0" + bytes(12), "robot 7 does not exist; there are 1"),
        (b"S", b"\x01\0\0\0", "a step of 1 robots has 4 bytes; 245 are expected"),
        (b"R", b"\x01\0\0\0", "ends too early"),
        (b"R", reset_body([Reset(7, initial_state(0.3), "")]), "robot 7 does not exist; there are 1"),
    ],
)
def test_reply_to_a_bad_request_is_its_error(model: str, kind: bytes, body: bytes, message: str) -> None:
    requests, replies = io.BytesIO(), io.BytesIO()
    write_frame(requests, b"H", hello(model))
    write_frame(requests, kind, body)
    requests.seek(0)
    serve(requests, replies)
    replies.seek(0)
    assert read_frame(replies) is not None
    answer = read_frame(replies)
    assert answer is not None
    assert answer[0] == b"E"
    assert message in answer[1].decode()
    assert read_frame(replies) is None


def test_process_answers_in_lock_step_and_terminates_with_its_stdin(model: str, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "twinstep.mujoco"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(twinstep.__file__).parents[1])},
    )
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    write_frame(process.stdin, b"H", hello(model))
    assert read_frame(process.stdout) == (b"H", f"twinstep-mujoco {PROTOCOL} mujoco={mujoco.__version__}".encode())
    commands = hold(1)
    commands["kp"] = np.inf
    for body in (step_body(Step(4, np.ones(1, np.bool_), hold(1))), step_body(Step(4, np.ones(1, np.bool_), commands))):
        write_frame(process.stdin, b"S", body)
        answer = read_frame(process.stdout)
        assert answer is not None
        assert answer[0] == b"D"
    process.stdin.close()
    assert process.wait(20) == 0
    # MuJoCo's warning about the infinite gain is on stderr, not in a file, and stdout has frames only.
    assert process.stdout.read() == b""
    assert b"mujoco: " in process.stderr.read()
    assert list(tmp_path.iterdir()) == []
    process.stdout.close()
    process.stderr.close()


def test_bundled_server_simulates_in_the_mujoco_of_this_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(twinstep.__file__).parents[1]))
    monkeypatch.delenv("TWINSTEP_PYTHON", raising=False)
    config = tmp_path / "server.toml"
    config.write_text('[sim]\nengine = "mujoco"\n')
    envs = twinstep.Go2VectorEnv(2, config=str(config))
    envs.reset(seed=1)
    obs, *_ = envs.step(np.zeros((2, 12), np.float32))
    assert np.isfinite(obs).all()
    envs.close()
