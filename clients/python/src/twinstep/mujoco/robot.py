"""One robot in MuJoCo: its state, the PD loop of its motors, and its readings."""

import copy
import importlib
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .frames import Layout, Rows

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Command:
    """Command of one robot in double precision: the torque is ``bias - kp q - kd dq``, clipped to the limit."""

    bias: Array
    kp: Array
    kd: Array

    @staticmethod
    def of_all(commands: Rows) -> "list[Command]":
        """Return the command of each row of ``command``."""
        q, dq, tau_ff, kp, kd = (commands[name].astype(np.float64) for name in ("q", "dq", "tau_ff", "kp", "kd"))
        bias = tau_ff + kp * q + kd * dq
        return [Command(*rows) for rows in zip(bias, kp, kd, strict=True)]


class Compiler:
    """Compiles models (MJCF) with the solver settings of the server."""

    def __init__(self, iterations: int) -> None:
        self.mujoco: Any = importlib.import_module("mujoco")
        # The default handler of warnings writes the file MUJOCO_LOG.TXT into the working folder.
        self.mujoco.set_mju_user_warning(_print_warning)
        self._iterations = iterations

    def compile(self, mjcf: str) -> Any:
        """Return the ``MjModel``. Raises ``ValueError`` if the model is invalid."""
        model = self.mujoco.MjModel.from_xml_string(mjcf)
        model.opt.iterations = self._iterations
        # MuJoCo would reset an unstable robot to its default pose, and hide that it diverged.
        model.opt.disableflags |= self.mujoco.mjtDisableBit.mjDSBL_AUTORESET
        return model


def _print_warning(message: str) -> None:
    print(f"mujoco: {message}", file=sys.stderr, flush=True)


class Robot:
    """One robot. The PD loop samples the state once per actuator period, and the torque is held for the period.

    Parameters
    ----------
    compiler
        The compiler of its model.
    model
        Its ``MjModel``, which robots may share.
    layout
        Its joints and geoms.
    base
        Index of the body that is a fixed base; 0 if it is the world.
    """

    def __init__(self, compiler: Compiler, model: Any, layout: Layout, base: int) -> None:
        self._mujoco = compiler.mujoco
        self._layout, self._base = layout, base
        warnings = self._mujoco.mjtWarning
        unstable = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
        self._unstable = [int(getattr(warnings, f"mjWARN_{name}")) for name in unstable]
        self._load(model)

    def _load(self, model: Any) -> None:
        mujoco = self._mujoco
        self._model, self._data = model, mujoco.MjData(model)
        self._floating = model.njnt > 0 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE

        def index(kind: Any, name: str) -> int:
            found = int(mujoco.mj_name2id(model, kind, name))
            if found < 0:
                raise ValueError(f"the model has no joint or geom named {name!r}")
            return found

        joints = np.array([index(mujoco.mjtObj.mjOBJ_JOINT, name) for name in self._layout.joints], np.intp)
        self._geoms = [index(mujoco.mjtObj.mjOBJ_GEOM, name) for name in self._layout.geoms]
        self._q, self._dq = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        # The motor of each joint; the torque of a joint without one is zero.
        of_joint = {int(joint): motor for motor, joint in enumerate(model.actuator_trnid[:, 0])}
        driven = [at for at, joint in enumerate(joints) if int(joint) in of_joint]
        self._driven, self._motors = np.array(driven, np.intp), [of_joint[int(joints[at])] for at in driven]
        self._limit = np.zeros(len(joints))
        for at, motor in zip(driven, self._motors, strict=True):
            limited = model.actuator_ctrllimited[motor]
            self._limit[at] = model.actuator_ctrlrange[motor, 1] if limited else np.inf
        self._tau = np.zeros(len(joints))

    def reset(self, model: Any, initial_state: Rows) -> None:
        """Reset to a row of ``initial_state``, with the parameters of ``model``."""
        values = {name: initial_state[name][0].astype(np.float64) for name in initial_state.dtype.names or ()}
        norm = np.linalg.norm(values["base_orientation"])
        orientation = values["base_orientation"] / norm if norm > 0 else np.array([1.0, 0.0, 0.0, 0.0])
        floating = model.njnt > 0 and model.jnt_type[0] == self._mujoco.mjtJoint.mjJNT_FREE
        if not floating and self._base > 0:
            # A fixed base is where its state has it.
            model = copy.copy(model)
            model.body_pos[self._base], model.body_quat[self._base] = values["base_position"], orientation
        if model is not self._model:
            self._load(model)
        self._mujoco.mj_resetData(self._model, self._data)
        self._tau[:] = 0.0
        if self._floating:
            self._data.qpos[:7] = [*values["base_position"], *orientation]
            self._data.qvel[:6] = [*values["base_linear_velocity"], *values["base_angular_velocity"]]
        self._data.qpos[self._q], self._data.qvel[self._dq] = values["q"], values["dq"]

    def push(self, velocity: list[float]) -> None:
        """Add to the velocity of the floating base, in the world frame [m/s]."""
        self._data.qvel[:3] += velocity

    def advance(self, command: Command, periods: int, steps: int) -> None:
        """Advance by ``periods`` actuator periods of ``steps`` physics steps. A robot that diverged stays as it is."""
        if self.diverged:
            return
        data, low, high = self._data, -self._limit, self._limit
        for _ in range(periods):
            tau = command.bias - command.kp * data.qpos[self._q] - command.kd * data.qvel[self._dq]
            # Both propagate NaN.
            np.minimum(np.maximum(tau, low, out=tau), high, out=self._tau)
            data.ctrl[self._motors] = self._tau[self._driven]
            self._mujoco.mj_step(self._model, data, nstep=steps)

    @property
    def diverged(self) -> bool:
        """True if a position, velocity, acceleration or torque was not finite or huge after the last reset."""
        return bool(self._data.warning.number[self._unstable].any())

    def read(self, measured: Rows, truth: Rows) -> None:
        """Write a row of ``measured`` and a row of ``truth``."""
        if self.diverged:
            for row in (measured, truth):
                for name in row.dtype.names or ():
                    row[name] = np.nan
            return
        data = self._data
        measured["q"], measured["dq"] = data.qpos[self._q], data.qvel[self._dq]
        measured["tau"] = self._tau
        if self._floating:
            measured["orientation"], measured["gyro"] = data.qpos[3:7], data.qvel[3:6]
            truth["base_position"], truth["base_linear_velocity"] = data.qpos[:3], data.qvel[:3]
            truth["base_angular_velocity"] = data.qvel[3:6]
        else:
            measured["orientation"], measured["gyro"] = self._model.body_quat[self._base], 0.0
            truth["base_position"] = self._model.body_pos[self._base]
            truth["base_linear_velocity"] = truth["base_angular_velocity"] = 0.0
        truth["geom_force"] = self._normal_forces()[self._geoms]

    def _normal_forces(self) -> Array:
        """Return the normal force between each geom and the ground in the last physics step [N]."""
        contact = self._data.contact
        address = contact.efc_address
        # With elliptic cones the first row of a contact is its normal force. A contact without rows has no force.
        force = np.where(address >= 0, self._data.efc_force[address], 0.0) if len(address) else np.zeros(0)
        # Which of the two is the robot's depends on their types: a box of the ground comes after a sphere.
        sums = [np.bincount(contact.geom[:, side], force, self._model.ngeom) for side in range(2)]
        return (sums[0] + sums[1]).astype(np.float64)
