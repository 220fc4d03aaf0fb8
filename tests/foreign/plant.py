"""MuJoCo model of one robot with its manufacturing errors, and the simulation of a log."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from drive import JOINTS, NOMINAL_ROTOR, PHYSICS_DT, ROW_STEPS, Array, Command, Drive

GEAR_SUBSTEPS = 4  # physics steps per ms with a gear whose rotor moves against the link
LEGS = ("FL", "FR", "RL", "RR")


@dataclass(frozen=True)
class Robot:
    """One robot: parameters of its drives, nuisances of its bodies, and changes of its plant."""

    drive: dict[str, Array]
    nuisance: dict[str, Any]
    noise: dict[str, float]
    plant: dict[str, Any] = field(default_factory=dict)


def _pseudo_shape(inertia: Array) -> Array:
    """Return the second moment of mass [kg·m²] of a rotational inertia about the centre of mass."""
    return 0.5 * np.trace(inertia) * np.eye(3) - inertia


def _set_inertial(body: mujoco.MjsBody, mass: float, com: Array, second_moment: Array) -> None:
    """Write mass [kg], centre of mass [m] and second moment [kg·m²] about it to a body."""
    inertia = np.trace(second_moment) * np.eye(3) - second_moment
    body.mass = mass
    body.ipos = com
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _trunk_changes(plant: dict[str, Any], late: bool) -> tuple[float, Array, Array, Array]:
    """Return point mass [kg], its place [m], shift of the centre of mass [m] and scales of the trunk's axes."""
    mass, place = plant.get("payload", (0.0, np.zeros(3)))
    if "moving_payload" in plant:
        mass, early_place, late_place = plant["moving_payload"]
        place = late_place if late else early_place
    return (
        mass,
        np.asarray(place),
        plant.get("com_shift", np.zeros(3)),
        plant.get("trunk_scale", np.ones(3)),
    )


def build(robot: Robot, xml: str, *, fixed: bool, late: bool = False) -> mujoco.MjModel:
    """Compile the MuJoCo model of a robot that hangs (`fixed`) or stands; `late` is after a payload's shift."""
    spec = mujoco.MjSpec.from_string(xml)
    n, plant = robot.nuisance, robot.plant
    for index, name in enumerate(("trunk", *JOINTS)):
        body = spec.body(name)
        full = body.fullinertia
        inertia = np.array(
            [
                [full[0], full[3], full[4]],
                [full[3], full[1], full[5]],
                [full[4], full[5], full[2]],
            ]
        )
        mass, com = body.mass, np.array(body.ipos) + n["com"][index]
        stretch = np.eye(3) + n["shape"][index]
        ratio = n["trunk_mass"] if index == 0 else n["link_mass"][index - 1]
        moment = stretch @ _pseudo_shape(inertia) @ stretch.T * ratio
        mass *= ratio
        if index == 0:
            extra, place, shift, scale = _trunk_changes(plant, late)
            moment = np.diag(scale) @ moment @ np.diag(scale)
            com = com + shift
            total = (mass * com + extra * place) / (mass + extra)
            moment = moment + mass * np.outer(com - total, com - total) + extra * np.outer(place - total, place - total)
            mass, com = mass + extra, total
        _set_inertial(body, mass, com, moment)
    for leg, name in enumerate(LEGS):
        hip = spec.body(f"{name}_hip")
        hip.pos = np.array(hip.pos) + n["mount"][leg]
        foot = spec.geom(f"{name}_foot")
        foot.size[0] += n["foot_radius"][leg]
    geared = Drive(robot.drive).geared
    for joint, name in enumerate(JOINTS):
        rotor = n["gear_rotor"] if geared[joint] else NOMINAL_ROTOR + robot.drive["rotor"][joint]
        spec.joint(name).armature = rotor
    friction = plant.get("ground_friction", 0.8) * n["floor_friction"]
    for geom in spec.geoms:
        geom.friction = [friction, 0.0, 0.0]
        geom.solref = [
            plant.get("ground_time", n["contact_time"]),
            n["contact_damping"],
        ]
    if "slope" in plant:
        spec.geom("ground").quat = small_turn(plant["slope"])
    trunk = spec.body("trunk")
    trunk.add_site(name="imu", pos=[0.0, 0.0, 0.0])
    spec.add_sensor(
        name="acc",
        type=mujoco.mjtSensor.mjSENS_ACCELEROMETER,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="imu",
    )
    for key in spec.keys:
        spec.delete(key)
    if fixed:
        spec.delete(spec.joint("base"))
        trunk.pos = [0.0, 0.0, 1.0]
        trunk.quat = small_turn(n["tilt"])
    # Errors of the second moments may leave the triangle inequality.
    spec.compiler.balanceinertia = True
    spec.option.timestep = PHYSICS_DT / (GEAR_SUBSTEPS if bool(np.any(geared)) else 1)
    model = spec.compile()
    model.dof_solref[:] = [0.002, 1.0]
    model.dof_solimp[:, :2] = [0.99, 0.999]
    return model


def small_turn(angles: Array) -> Array:
    """Return the quaternion (w, x, y, z) of small turns about x and y [rad]."""
    quat = np.array([1.0, 0.5 * angles[0], 0.5 * angles[1], 0.0])
    return quat / np.linalg.norm(quat)


class Simulation:
    """A robot in MuJoCo, stepped by log rows of 5 ms."""

    def __init__(
        self,
        robot: Robot,
        xml: str,
        *,
        fixed: bool,
        start_time: float,
        temperature: Array,
    ) -> None:
        self.robot, self.xml, self.fixed = robot, xml, fixed
        self.model = build(robot, xml, fixed=fixed)
        self.data = mujoco.MjData(self.model)
        self.drive = Drive(robot.drive, time=start_time, temperature=temperature.copy())
        self.first_joint = self.model.nv - 12
        self.substeps = GEAR_SUBSTEPS if self.drive.has_gear else 1
        self.trunk = self.model.body("trunk").id
        self.feet = np.array([self.model.geom(f"{leg}_foot").id for leg in LEGS])

    def place(self, joints: Array, height: float) -> None:
        """Set joint angles [rad] and, with a floating base, the height of its origin [m]; all at rest."""
        if not self.fixed:
            self.data.qpos[:7] = [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]
        self.data.qpos[-12:] = joints
        if not self.fixed:
            self.data.xfrc_applied[self.trunk, :3] = self.robot.plant.get("tether", np.zeros(3))

    def shift_payload(self) -> None:
        """Replace the model by that after the payload's shift, in the same state."""
        old = self.data
        self.model = build(self.robot, self.xml, fixed=self.fixed, late=True)
        self.data = mujoco.MjData(self.model)
        for name in ("qpos", "qvel", "qacc_warmstart", "xfrc_applied"):
            getattr(self.data, name)[:] = getattr(old, name)

    def row(self, command: Command, noise_q: Array, noise_dq: Array) -> dict[str, Array]:
        """Simulate one row; return its readings, without noise except in q and dq [SI]."""
        model, data, drive = self.model, self.data, self.drive
        q, dq = data.qpos[-12:].copy(), data.qvel[-12:].copy()
        read_q, read_dq = drive.encoder(q, dq)
        out = {"q": read_q + noise_q, "dq": read_dq + noise_dq}
        drive.receive(command, out["q"], out["dq"])
        if not self.fixed:
            out |= {
                "pos": data.qpos[:3].copy(),
                "vel": data.qvel[:3].copy(),
                "gyro": data.qvel[3:6].copy(),
            }
            out["quat"] = data.qpos[3:7].copy()
        total = np.zeros(12)
        dt = PHYSICS_DT / self.substeps
        for step in range(ROW_STEPS):
            reading, motor = drive.motor(data.qpos[-12:], data.qvel[-12:])
            total += reading
            for _ in range(self.substeps):
                q, dq = data.qpos[-12:], data.qvel[-12:]
                link = drive.gear(motor, q, dq, dt) if drive.has_gear else motor
                dry, viscous = drive.friction(q, dq, motor)
                model.dof_frictionloss[self.first_joint :] = dry
                model.dof_damping[self.first_joint :] = viscous
                data.qfrc_applied[self.first_joint :] = link + drive.springs(q, dq, dt)
                mujoco.mj_step(model, data)
            if step == 0:
                out["acc"] = data.sensordata[:3].copy()
                touching = data.contact.geom[data.contact.dist < 0.0].ravel()
                out["contact"] = np.isin(self.feet, touching).astype(float)
        out["tau"] = total / ROW_STEPS
        return out
