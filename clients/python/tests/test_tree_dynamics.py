"""Equations of motion of random trees, beside MuJoCo: mass matrix, and the velocities after one step."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from twinstep.server import find_program

mujoco = pytest.importorskip("mujoco")

Array = NDArray[np.float64]
STEP_S = 0.001
STATES = 3
PROGRAM = Path(find_program()).with_name("tree_dynamics")

pytestmark = pytest.mark.skipif(not PROGRAM.exists(), reason="a program of the Rust tests")


def numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)


def random_robot(random: np.random.Generator, inherits: bool = True) -> str:
    """Return an MJCF robot of 5 to 40 joints with any axes and frames, a third of them slides."""
    count = int(random.integers(5, 41))
    children: dict[int, list[int]] = {}
    for body in range(1, count + 1):
        children.setdefault(int(random.integers(0, body)), []).append(body)

    def inertial() -> str:
        moments = random.uniform(0.02, 0.04, 3)
        place, turn = random.uniform(-0.1, 0.1, 3), random.normal(size=4)
        mass = random.uniform(0.2, 3)
        return (
            f'<inertial pos="{numbers(place)}" quat="{numbers(turn)}" mass="{mass}" diaginertia="{numbers(moments)}"/>'
        )

    def body(index: int) -> str:
        place, turn = random.uniform(-0.3, 0.3, 3), random.normal(size=4)
        if index == 0:
            inherited = f'<joint type="free" armature="{random.uniform(0, 0.3)}" damping="{random.uniform(0, 0.5)}"/>'
            joint = ("<freejoint/>", inherited if inherits else "<freejoint/>", "", "")[random.integers(4)]
        else:
            kind = "slide" if random.random() < 1 / 3 else "hinge"
            axis, at = random.normal(size=3), random.uniform(-0.05, 0.05, 3)
            armature, damping = random.uniform(0, 0.05), random.uniform(0, 0.5)
            joint = f'<joint name="j{index}" type="{kind}" axis="{numbers(axis)}" pos="{numbers(at)}"'
            joint += f' armature="{armature}" damping="{damping}"/>'
        below = "".join(body(child) for child in children.get(index, []))
        return f'<body name="b{index}" pos="{numbers(place)}" quat="{numbers(turn)}">{joint}{inertial()}{below}</body>'

    return f'<mujoco><compiler angle="radian"/><worldbody>{body(0)}</worldbody></mujoco>'


def expected(model, state: dict, is_free: bool) -> tuple[Array, Array]:
    """Return mass matrix and velocity changes of MuJoCo, in the order and the axes of the program."""
    data = mujoco.MjData(model)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.array(state["orientation"]))
    rotation = rotation.reshape(3, 3)
    # Velocities of the program from those of MuJoCo: linear in the world, then angular in the base.
    to_ours = np.eye(model.nv)
    if is_free:
        to_ours[:6, :6] = np.block([[np.zeros((3, 3)), np.eye(3)], [rotation.T, np.zeros((3, 3))]])
        data.qpos[:] = [0, 0, 0, *state["orientation"], *state["q"]]
        data.qvel[:] = [0, 0, 0, *state["angular_velocity"], *state["dq"]]
    else:
        data.qpos[:], data.qvel[:] = state["q"], state["dq"]
    before = data.qvel.copy()
    data.qfrc_applied[6 if is_free else 0 :] = state["tau"]
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    mujoco.mj_step(model, data)
    from_ours = np.linalg.inv(to_ours)
    return from_ours.T @ mass @ from_ours, to_ours @ (data.qvel - before)


@pytest.mark.parametrize("seed", range(24))
def test_equations_of_random_trees_are_those_of_mujoco(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    text = random_robot(random)
    path = tmp_path / "robot.xml"
    path.write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep, model.opt.gravity = STEP_S, [0, 0, -9.81]
    is_free = bool(model.njnt and model.jnt_type[0] == 0)
    joints = model.njnt - is_free
    states = []
    for _ in range(STATES):
        turn = random.normal(size=4)
        # A fixed base has the pose of its body.
        orientation = turn / np.linalg.norm(turn) if is_free else model.body_quat[1]
        base_velocity = random.normal(size=3) if is_free else np.zeros(3)
        state = {"orientation": orientation.tolist(), "angular_velocity": base_velocity.tolist(), "dt": STEP_S}
        states.append(state | {name: random.normal(size=joints).tolist() for name in ("q", "dq", "tau")})
    lines = "".join(json.dumps(state) + "\n" for state in states)
    printed = subprocess.run([PROGRAM, path], input=lines, capture_output=True, text=True, check=True).stdout
    for state, line in zip(states, printed.splitlines(), strict=True):
        reply = json.loads(line)
        mass, change = expected(model, state, is_free)
        for precision, bound in (("double", 1e-9), ("single", 2e-5)):
            found = reply[precision]
            assert np.abs(np.array(found["mass"]) - mass).max() <= bound * np.abs(mass).max(), precision
            if precision == "double":
                assert np.abs(np.array(found["change"]) - change).max() <= bound * np.abs(change).max()
