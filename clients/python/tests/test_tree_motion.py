"""Motion of robots of any tree in the batch engine and in rapier, beside MuJoCo."""

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_tree_dynamics import random_robot

from twinstep.server import find_program

mujoco = pytest.importorskip("mujoco")

Array = NDArray[np.float64]
PHYSICS_HZ, ACTUATOR_HZ = 1000, 200
HALF_STEP_S = 0.5 / PHYSICS_HZ
PERIODS = ACTUATOR_HZ
"""One second."""
PROGRAM = Path(find_program()).with_name("tree_motion")
ROBOTS = Path(__file__).parents[3] / "data" / "robots"

G1_POSE = {"hip_pitch_joint": -0.2, "knee_joint": 0.42, "ankle_pitch_joint": -0.23}
ANYMAL_POSE = {"F_HFE": 0.4, "F_KFE": -0.8, "H_HFE": -0.4, "H_KFE": 0.8}
CHEETAH_POSE = {"thigh_joint": 0.8, "calf_joint": -1.6}
SHIPPED: list[tuple[str, dict[str, float], float, float]] = [
    ("g1", G1_POSE, 100.0, 2.0),
    ("so101", {}, 10.0, 0.5),
    ("anymal_c", ANYMAL_POSE, 300.0, 5.0),
    ("mini_cheetah", CHEETAH_POSE, 30.0, 0.75),
]

pytestmark = pytest.mark.skipif(not PROGRAM.exists(), reason="a program of the Rust tests")


class Robot:
    """A robot file and its MuJoCo model."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.model.opt.timestep, self.model.opt.gravity = 1 / PHYSICS_HZ, [0, 0, -9.81]
        self.is_free = bool(self.model.njnt and self.model.jnt_type[0] == 0)
        self.joints = self.model.njnt - self.is_free
        self.names = [self.model.joint(self.is_free + joint).name for joint in range(self.joints)]

    def start(self, q: Array, dq: Array | None = None) -> dict[str, Any]:
        """Return the state at rest at the pose of the file, with the joints in a state."""
        base = self.model.body(1)
        quat = [1.0, 0, 0, 0] if self.is_free else base.quat.tolist()
        pose = {"position": base.pos.tolist(), "orientation": quat}
        still = {"linear_velocity": [0.0] * 3, "angular_velocity": [0.0] * 3}
        return pose | still | {"q": q.tolist(), "dq": (np.zeros(self.joints) if dq is None else dq).tolist()}

    def data(self, start: dict[str, Any]) -> Any:
        """Return the state of MuJoCo."""
        data = mujoco.MjData(self.model)
        base = [*start["position"], *start["orientation"]] if self.is_free else []
        velocity = [*start["linear_velocity"], *start["angular_velocity"]] if self.is_free else []
        data.qpos[:], data.qvel[:] = [*base, *start["q"]], [*velocity, *start["dq"]]
        return data

    def ours(
        self,
        start: dict[str, Any],
        gains: tuple[float, float],
        targets: Array,
        double: bool = True,
        engine: str = "batch",
        physics_hz: int = PHYSICS_HZ,
    ) -> list[Any]:
        """Return the states of an engine after each actuator period."""
        rates = {"physics_hz": physics_hz, "actuator_hz": float(ACTUATOR_HZ), "double": double, "engine": engine}
        request = start | rates | {"kp": gains[0], "kd": gains[1], "targets": targets.tolist()}
        line = json.dumps(request) + "\n"
        reply = subprocess.run([PROGRAM, self.path], input=line, capture_output=True, text=True, check=True)
        return json.loads(reply.stdout)


def turned(quat: Array, rotation: Array) -> Array:
    """Return an orientation that is turned by a rotation vector in its own axes."""
    result = np.array(quat)
    mujoco.mju_quatIntegrate(result, np.array(rotation), 1.0)
    return result


class FreeMotion:
    """One second of free motion of a random tree, by MuJoCo and by the batch engine."""

    def __init__(self, seed: int, path: Path) -> None:
        random = np.random.default_rng(seed)
        path.write_text(random_robot(random))
        self.robot = robot = Robot(path)
        start = robot.start(random.uniform(-1, 1, robot.joints), 0.5 * random.normal(size=robot.joints))
        if robot.is_free:
            quat = random.normal(size=4)
            start["orientation"] = (quat / np.linalg.norm(quat)).tolist()
            start["linear_velocity"], start["angular_velocity"] = random.normal(size=(2, 3)).tolist()
        self.start = start
        self.theirs, shifted = robot.data(start), robot.data(start)
        shifted.qvel[-robot.joints :] += 1e-12
        for _ in range(PHYSICS_HZ):
            mujoco.mj_step(robot.model, self.theirs)
            mujoco.mj_step(robot.model, shifted)
        self.divergence = float(np.abs(shifted.qpos - self.theirs.qpos).max())
        """Of MuJoCo from a start that is 1e-12 away."""

    def ours(self, double: bool) -> Array:
        """Return the final positions of the batch engine, in the order of MuJoCo."""
        # The engine reads positions half a step back, and places robots half a step ahead.
        given = {name: np.array(value) for name, value in self.start.items()}
        before = self.start | {
            "position": (given["position"] - HALF_STEP_S * given["linear_velocity"]).tolist(),
            "orientation": turned(given["orientation"], -HALF_STEP_S * given["angular_velocity"]).tolist(),
            "q": (given["q"] - HALF_STEP_S * given["dq"]).tolist(),
        }
        end = self.robot.ours(before, (0.0, 0.0), np.zeros((PERIODS, self.robot.joints)), double)[-1]
        end = {name: np.array(value) for name, value in end.items()}
        q = end["q"] + HALF_STEP_S * end["dq"]
        if not self.robot.is_free:
            return q
        position = end["position"] + HALF_STEP_S * end["linear_velocity"]
        return np.concatenate([position, turned(end["orientation"], HALF_STEP_S * end["angular_velocity"]), q])


@pytest.mark.parametrize("seed", range(12))
def test_free_motion_of_random_trees_is_that_of_mujoco(seed: int, tmp_path: Path) -> None:
    motion = FreeMotion(seed, tmp_path / "robot.xml")
    assert np.abs(motion.ours(double=True) - motion.theirs.qpos).max() <= 10 * motion.divergence
    # Free bases fall by metres in single precision.
    assert np.abs(motion.ours(double=False) - motion.theirs.qpos).max() <= 5e-5


BALL_ON_A_TILTED_BASE = """
<mujoco><compiler angle="radian"/><worldbody><body pos="0 0 1" quat="0.5 0.5 -0.3 0.2">
  <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
  <body pos="0.1 0 0">
    <joint name="a" axis="1 0 0" armature="0.01"/><joint name="b" axis="0 1 0" armature="0.01"/>
    <joint name="c" axis="0 0 1" armature="0.01"/>
    <inertial pos="0.1 0.05 0" mass="1" diaginertia="0.01 0.02 0.015"/>
  </body>
</body></worldbody></mujoco>
"""
"""Three joints on a body, which are joints of bodies without mass in the tree."""


def test_free_joint_with_friction_moves_as_in_mujoco(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    free = '<joint type="free" armature="0.2" damping="0.3" frictionloss="0.5"/>'
    path.write_text(BALL_ON_A_TILTED_BASE.replace("<inertial", free + "<inertial", 1))
    robot = Robot(path)
    start = robot.start(np.array([0.3, -0.2, 0.1]))
    # The fast axes slide, the slow one comes to rest.
    start |= {"linear_velocity": [1.0, 0.05, 0.0], "angular_velocity": [0.0, 0.02, -3.0]}
    theirs = robot.data(start)
    for _ in range(PHYSICS_HZ // 2):
        mujoco.mj_step(robot.model, theirs)
    end = robot.ours(start, (0.0, 0.0), np.zeros((PERIODS // 2, robot.joints)))[-1]
    np.testing.assert_allclose(end["linear_velocity"], theirs.qvel[:3], atol=5e-4)
    np.testing.assert_allclose(end["angular_velocity"], theirs.qvel[3:6], atol=2.5e-3)
    without = Robot(path)
    without.model.dof_frictionloss[:6] = 0
    free_fall = without.data(start)
    for _ in range(PHYSICS_HZ // 2):
        mujoco.mj_step(without.model, free_fall)
    assert np.abs(free_fall.qvel[:6] - theirs.qvel[:6]).max() > 0.2, "the friction makes a difference"


@pytest.mark.parametrize("seed", [None, *range(8)])
def test_both_engines_follow_commands_as_mujoco_does(seed: int | None, tmp_path: Path) -> None:
    random = np.random.default_rng(seed or 0)
    path = tmp_path / "robot.xml"
    # rapier has no inertia and friction of a free joint.
    path.write_text(BALL_ON_A_TILTED_BASE if seed is None else random_robot(random, inherits=False))
    robot, gains = Robot(path), (5.0, 0.5)
    q = random.uniform(-0.5, 0.5, robot.joints)
    start = robot.start(q)
    swing = 0.2 * np.sin(2 * np.pi * np.arange(PERIODS // 2) / ACTUATOR_HZ)
    targets = q + np.outer(swing, np.where(np.arange(robot.joints) % 2, 1, -1))
    expected = mujoco_motion(robot, robot.data(start), gains, targets)
    for engine, bound in (("batch", 1e-5), ("rapier", 1e-3)):
        states = robot.ours(start, gains, targets, double=False, engine=engine)
        assert rms(np.array([state["q"] for state in states]) - expected) <= bound, engine


class ShippedMotion:
    """One second of a shipped robot under PD control, by MuJoCo."""

    def __init__(self, name: str, pose: dict[str, float], gains: tuple[float, float], amplitude: float) -> None:
        self.robot = robot = Robot(ROBOTS / f"{name}.xml")
        joints = robot.names
        q = np.array([next((value for end, value in pose.items() if joint.endswith(end)), 0.0) for joint in joints])
        self.start, self.gains = robot.start(q), gains
        theirs = robot.data(self.start)
        if robot.is_free:
            # Puts the feet on the ground.
            mujoco.mj_forward(robot.model, theirs)
            spheres = np.flatnonzero(robot.model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
            lowest = min(theirs.geom_xpos[geom][2] - robot.model.geom_size[geom][0] for geom in spheres)
            theirs.qpos[2] -= lowest
            self.start["position"] = theirs.qpos[:3].tolist()
        sides = np.where(np.arange(robot.joints) % 2, 1, -1)
        swing = amplitude * np.sin(2 * np.pi * np.arange(PERIODS) / ACTUATOR_HZ)
        self.targets = q + np.outer(swing, sides)
        self.theirs = mujoco_motion(robot, theirs, gains, self.targets)

    def positions(self, engine: str) -> Array:
        """Return the joint positions in an engine after each actuator period."""
        states = self.robot.ours(self.start, self.gains, self.targets, double=False, engine=engine)
        return np.array([state["q"] for state in states])


@pytest.mark.parametrize("amplitude", [0.0, 0.1])
@pytest.mark.parametrize(("name", "pose", "kp", "kd"), SHIPPED, ids=[robot[0] for robot in SHIPPED])
def test_shipped_robot_holds_and_swings_alike_in_all_engines(
    name: str, pose: dict[str, float], kp: float, kd: float, amplitude: float
) -> None:
    motion = ShippedMotion(name, pose, (kp, kd), amplitude)
    batch, rapier = motion.positions("batch"), motion.positions("rapier")
    for one, other in ((batch, motion.theirs), (rapier, motion.theirs), (batch, rapier)):
        assert rms(one - other) <= 0.005


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def mujoco_motion(robot: Robot, data: Any, gains: tuple[float, float], targets: Array) -> Array:
    """Return the joint positions of MuJoCo after each actuator period of PD control, read as the engine reads them."""
    model, joints = robot.model, slice(-robot.joints, None)
    limits = np.full(robot.joints, np.inf)
    for motor in range(model.nu):
        limits[model.actuator_trnid[motor, 0] - robot.is_free] = model.actuator_ctrlrange[motor, 1]
    motion = list[Array]()
    for target in targets:
        dq = data.qvel[joints]
        torque = gains[0] * (target - (data.qpos[joints] - HALF_STEP_S * dq)) - gains[1] * dq
        data.qfrc_applied[joints] = np.clip(torque, -limits, limits)
        for _ in range(PHYSICS_HZ // ACTUATOR_HZ):
            mujoco.mj_step(model, data)
        motion.append(data.qpos[joints] - HALF_STEP_S * data.qvel[joints])
    return np.array(motion)


def main() -> None:
    """Print the tables of results/robots.md."""
    print("| joints | base | batch, double | MuJoCo from 1e-12 away | batch, single |\n|---|---|---|---|---|")
    for seed in range(24):
        with tempfile.TemporaryDirectory() as folder:
            motion = FreeMotion(seed, Path(folder) / "robot.xml")
            double, single = (np.abs(motion.ours(double) - motion.theirs.qpos).max() for double in (True, False))
        base = "free" if motion.robot.is_free else "fixed"
        print(f"| {motion.robot.joints} | {base} | {double:.1e} | {motion.divergence:.1e} | {single:.1e} |")
    print("\n| robot | motion | batch - MuJoCo | rapier - MuJoCo | batch - rapier |\n|---|---|---|---|---|")
    for name, pose, kp, kd in SHIPPED:
        for amplitude, what in ((0.0, "hold"), (0.1, "sine of 0.1 rad")):
            motion = ShippedMotion(name, pose, (kp, kd), amplitude)
            batch, rapier = motion.positions("batch"), motion.positions("rapier")
            errors = [rms(batch - motion.theirs), rms(rapier - motion.theirs), rms(batch - rapier)]
            print(f"| {name} | {what} | " + " | ".join(f"{error:.5f}" for error in errors) + " |")


if __name__ == "__main__":
    main()
