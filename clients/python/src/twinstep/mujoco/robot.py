"""One robot in MuJoCo: its state, the PD loop of its motors, and its readings."""

import copy
import importlib
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .frames import Rows

LEGS = ("FL", "FR", "RL", "RR")
_JOINTS = 12

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Command:
    """Command of one robot in double precision: the torque is ``bias - kp q - kd dq``, clipped to the limit."""

    bias: Array
    kp: Array
    kd: Array

    @staticmethod
    def of_all(commands: Rows) -> "list[Command]":
        """Return the command of each row of ``COMMAND``."""
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
    """

    def __init__(self, compiler: Compiler, model: Any) -> None:
        self._mujoco = compiler.mujoco
        warnings = self._mujoco.mjtWarning
        unstable = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
        self._unstable = [int(getattr(warnings, f"mjWARN_{name}")) for name in unstable]
        self._load(model)

    def _load(self, model: Any) -> None:
        mujoco = self._mujoco
        self._model, self._data = model, mujoco.MjData(model)
        self._floating = model.nq > _JOINTS
        self._q, self._dq = self._data.qpos[-_JOINTS:], self._data.qvel[-_JOINTS:]
        self._ctrl = self._data.ctrl
        self._limit = model.actuator_ctrlrange[:, 1].copy()

        def geom(name: str) -> int:
            return int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name))

        self._feet = [geom(f"{leg}_foot") for leg in LEGS]
        # A knee is the lower end of a thigh.
        self._body = [geom("trunk"), *(geom(f"{leg}_knee") for leg in LEGS)]

    def reset(self, model: Any, initial_state: Rows) -> None:
        """Reset to a row of ``INITIAL_STATE``, with the parameters of ``model``."""
        values = {name: initial_state[name][0].astype(np.float64) for name in initial_state.dtype.names or ()}
        norm = np.linalg.norm(values["base_orientation"])
        orientation = values["base_orientation"] / norm if norm > 0 else np.array([1.0, 0.0, 0.0, 0.0])
        if model.nq == _JOINTS:
            # A fixed base is where its model has it.
            model = copy.copy(model)
            model.body_pos[1], model.body_quat[1] = values["base_position"], orientation
        if model is not self._model:
            self._load(model)
        self._mujoco.mj_resetData(self._model, self._data)
        self._ctrl[:] = 0.0
        if self._floating:
            self._data.qpos[:7] = [*values["base_position"], *orientation]
            self._data.qvel[:6] = [*values["base_linear_velocity"], *values["base_angular_velocity"]]
        self._q[:], self._dq[:] = values["q"], values["dq"]

    def push(self, velocity: list[float]) -> None:
        """Add to the velocity of the floating base, in the world frame [m/s]."""
        self._data.qvel[:3] += velocity

    def advance(self, command: Command, periods: int, steps: int) -> None:
        """Advance by ``periods`` actuator periods of ``steps`` physics steps. A robot that diverged stays as it is."""
        if self.diverged:
            return
        low, high = -self._limit, self._limit
        for _ in range(periods):
            tau = command.bias - command.kp * self._q - command.kd * self._dq
            # Both propagate NaN.
            np.minimum(np.maximum(tau, low, out=tau), high, out=self._ctrl)
            self._mujoco.mj_step(self._model, self._data, nstep=steps)

    @property
    def diverged(self) -> bool:
        """True if a position, velocity, acceleration or torque was not finite or huge after the last reset."""
        return bool(self._data.warning.number[self._unstable].any())

    def read(self, measured: Rows, truth: Rows) -> None:
        """Write a row of ``MEASURED`` and a row of ``GROUND_TRUTH``."""
        if self.diverged:
            for row in (measured, truth):
                for name in row.dtype.names or ():
                    row[name] = np.nan
            return
        data = self._data
        measured["q"], measured["dq"], measured["tau"] = self._q, self._dq, self._ctrl
        if self._floating:
            measured["orientation"], measured["gyro"] = data.qpos[3:7], data.qvel[3:6]
            truth["base_position"], truth["base_linear_velocity"] = data.qpos[:3], data.qvel[:3]
            truth["base_angular_velocity"] = data.qvel[3:6]
        else:
            measured["orientation"], measured["gyro"] = self._model.body_quat[1], 0.0
            truth["base_position"] = self._model.body_pos[1]
            truth["base_linear_velocity"] = truth["base_angular_velocity"] = 0.0
        force = self._normal_forces()
        truth["foot_force"], truth["body_contact"] = force[self._feet], (force[self._body] > 0).any()

    def _normal_forces(self) -> Array:
        """Return the normal force between each geom and the ground in the last physics step [N]."""
        contact = self._data.contact
        address = contact.efc_address
        # With elliptic cones the first row of a contact is its normal force. A contact without rows has no force.
        force = np.where(address >= 0, self._data.efc_force[address], 0.0) if len(address) else np.zeros(0)
        return np.bincount(contact.geom[:, 1], force, self._model.ngeom).astype(np.float64)
