"""Laws of the twelve actuators of one robot, written independently of the product."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JOINTS = tuple(f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf"))
TORQUE_LIMIT = np.array([23.7, 23.7, 45.43] * 4)  # [N·m], from the exported nominal model
NOMINAL_ROTOR = 0.01  # [kg·m²], armature of the exported nominal model
PHYSICS_DT = 0.001  # [s]
ROW_STEPS = 5  # physics steps per 200 Hz row
GEAR_STIFFNESS = 2000.0  # [N·m/rad], of a gear with backlash and without elasticity
HISTORY = 64  # torques kept for delays, at 1 kHz

# Value of each law at which it does nothing; one number per joint.
NEUTRAL: dict[str, float] = {
    "command_delay": 0.0,  # [s]
    "encoder_offset": 0.0,  # [rad]
    "kp_scale": 1.0,
    "kd_scale": 1.0,
    "kappa": np.inf,  # [N·m]
    "sag_exponent": 0.0,
    "derating": 0.0,  # [1/K]
    "derating_above": 35.0,  # [°C]
    "torque_delay": 0.0,  # [s]
    "no_load_speed": np.inf,  # [rad/s]
    "dead_zone": 0.0,  # [N·m]
    "lag": 0.0,  # [s]
    "sensor_delay": 0.0,  # [s]
    "sensor_scale": 1.0,
    "sensor_offset": 0.0,  # [N·m]
    "gain": 1.0,
    "ripple": 0.0,  # [N·m]
    "ripple_cycles": 42.0,
    "ripple_phase": 0.0,  # [rad]
    "gap": 0.0,  # [rad]
    "stiffness": np.inf,  # [N·m/rad]
    "coulomb": 0.0,  # [N·m]
    "viscous": 0.0,  # [N·m·s/rad]
    "stribeck": 0.0,  # [N·m]
    "stribeck_speed": 0.1,  # [rad/s]
    "load_friction": 0.0,
    "rotor": 0.0,  # [kg·m²], in addition to the nominal rotor
    "spring": 0.0,  # [N·m/rad]
    "spring_rest": 0.0,  # [rad]
    # Laws outside the product's catalogue.
    "warm_viscous": 0.0,  # [N·m·s/rad] at 30 °C; decays by 1/e in 20 K
    "oneway_friction": 0.0,  # [N·m], for positive speed only
    "crosstalk": 0.0,  # share of the previous joint's torque in the leg
    "encoder_scale": 0.0,  # relative error of the angle from 0 rad
    "encoder_drift": 0.0,  # [rad/s]
    "hysteresis": 0.0,  # [N·m], Dahl friction
    "hysteresis_stiffness": 40.0,  # [N·m/rad]
    "cubic_spring": 0.0,  # [N·m/rad³]
    "torque_step": 0.0,  # [N·m], quantisation of the requested torque
    "packet_period": 0.0,  # [rows] between two losses
    "packet_loss": 0.0,  # [rows] for which the old command stays
    "gain_slope": 0.0,  # [1/(N·m)], torque-dependent gain
    "angle_friction": 0.0,  # [N·m], times (1 + sin(6 q)) / 2
    "delay_drift": 0.0,  # [s/s], growth of the command's delay
    "positive_limit": np.inf,  # [N·m]
    "error_gain": 0.0,  # [1/rad], growth of kp with the position error
    "drag": 0.0,  # [N·m·s²/rad²]
    "slew": np.inf,  # [N·m/s]
    "dropout": 0.0,  # share of the torque that is lost for 0.4 s of every 5 s
}


def neutral() -> dict[str, Array]:
    """Return the parameters of twelve ideal actuators, each an array of 12."""
    return {name: np.full(12, value) for name, value in NEUTRAL.items()}


@dataclass(frozen=True)
class Command:
    """Commands and gains of one log row: position [rad], kp [N·m/rad], kd [N·m·s/rad]."""

    position: Array
    kp: float
    kd: float


@dataclass
class Drive:
    """Twelve actuators with state: commands at 200 Hz, torques at 1 kHz."""

    parameters: dict[str, Array]
    time: float = 0.0
    rows: int = 0
    voltage_ratio: float = 1.0
    temperature: Array = field(default_factory=lambda: np.full(12, 30.0))
    commands: list[Array] = field(default_factory=list)
    requested: Array = field(default_factory=lambda: np.zeros(12))
    past: Array = field(default_factory=lambda: np.zeros((HISTORY, 12)))
    sensed: Array = field(default_factory=lambda: np.zeros((HISTORY, 12)))
    current: Array = field(default_factory=lambda: np.zeros(12))
    bristle: Array = field(default_factory=lambda: np.zeros(12))
    rotor_angle: Array | None = None
    rotor_speed: Array = field(default_factory=lambda: np.zeros(12))

    def __post_init__(self) -> None:
        """Precompute which laws are active, so that ideal actuators cost little time."""
        p = self.parameters
        self.active = {name: bool(np.any(p[name] != value)) for name, value in NEUTRAL.items()}
        stiffness = np.where(np.isfinite(p["stiffness"]), p["stiffness"], GEAR_STIFFNESS)
        self.geared = (p["gap"] > 0.0) | np.isfinite(p["stiffness"])
        self.gear_stiffness = stiffness
        self.rotor_inertia = NOMINAL_ROTOR + p["rotor"]
        self.gear_damping = 2.0 * 0.05 * np.sqrt(stiffness * self.rotor_inertia)

    @property
    def has_gear(self) -> bool:
        """Whether a rotor moves against its link at any joint."""
        return bool(np.any(self.geared))

    def encoder(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Return the angles [rad] and speeds [rad/s] that the encoders read, without noise."""
        p = self.parameters
        if self.has_gear and self.rotor_angle is not None:
            q = np.where(self.geared, self.rotor_angle, q)
            dq = np.where(self.geared, self.rotor_speed, dq)
        scale = 1.0 + p["encoder_scale"]
        return q * scale + p["encoder_offset"] + p["encoder_drift"] * self.time, dq * scale + p["encoder_drift"]

    def receive(self, command: Command, q: Array, dq: Array) -> None:
        """Evaluate the PD loop once from encoder readings [rad], [rad/s]; its torque is held for one row."""
        p = self.parameters
        period = int(p["packet_period"].max())
        lost = period > 0 and self.rows % period < p["packet_loss"].max() and bool(self.commands)
        self.commands.append(self.commands[-1] if lost else command.position)
        self.rows += 1
        target = self._delayed_command()
        error = target - q
        kp = command.kp * p["kp_scale"]
        if self.active["error_gain"]:
            kp = kp * (1.0 + p["error_gain"] * np.abs(error))
        torque = kp * error - command.kd * p["kd_scale"] * dq
        self.requested = self._weaken(torque)

    def _delayed_command(self) -> Array:
        """Return the commanded positions [rad] that have arrived, interpolated between two rows."""
        p = self.parameters
        if not (self.active["command_delay"] or self.active["delay_drift"]):
            return self.commands[-1]
        delay = (p["command_delay"] + p["delay_drift"] * self.time) / (ROW_STEPS * PHYSICS_DT)
        whole = np.floor(delay).astype(int)
        share = delay - whole
        history = np.array(self.commands[-12:])
        last = len(history) - 1
        joints = np.arange(12)
        newer = history[np.maximum(last - whole, 0), joints]
        older = history[np.maximum(last - whole - 1, 0), joints]
        return (1.0 - share) * newer + share * older

    def _weaken(self, torque: Array) -> Array:
        """Return the torque [N·m] after saturation, supply, heat and the limits of the drive."""
        p = self.parameters
        if self.active["kappa"]:
            limited = np.isfinite(p["kappa"])
            kappa = np.where(limited, p["kappa"], 1.0)
            torque = np.where(limited, kappa * np.tanh(torque / kappa), torque)
        if self.active["sag_exponent"]:
            torque = torque * self.voltage_ratio ** p["sag_exponent"]
        if self.active["derating"]:
            torque = torque * (1.0 - p["derating"] * np.maximum(self.temperature - p["derating_above"], 0.0))
        if self.active["torque_step"]:
            step = np.where(p["torque_step"] > 0.0, p["torque_step"], 1.0)
            torque = np.where(p["torque_step"] > 0.0, step * np.round(torque / step), torque)
        torque = torque * (1.0 + p["gain_slope"] * np.abs(torque))
        if self.active["dropout"] and self.time % 5.0 < 0.4:
            torque = torque * (1.0 - p["dropout"])
        torque = np.minimum(torque, p["positive_limit"])
        return np.clip(torque, -TORQUE_LIMIT, TORQUE_LIMIT)

    def motor(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Advance the motors by 1 ms; return the sensor reading and the motor torque [N·m]."""
        p = self.parameters
        self.past[1:] = self.past[:-1]
        self.past[0] = self.requested
        torque = _look_back(self.past, p["torque_delay"]) if self.active["torque_delay"] else self.requested
        if self.active["no_load_speed"]:
            room = TORQUE_LIMIT * np.clip(1.0 - dq * np.sign(torque) / p["no_load_speed"], 0.0, 1.0)
            torque = np.clip(torque, -room, room)
        if self.active["dead_zone"]:
            torque = np.sign(torque) * np.maximum(np.abs(torque) - p["dead_zone"], 0.0)
        if self.active["crosstalk"]:
            by_leg = torque.reshape(4, 3)
            torque = torque + p["crosstalk"] * np.roll(by_leg, 1, axis=1).reshape(12)
        if self.active["slew"]:
            change = p["slew"] * PHYSICS_DT
            torque = self.current + np.clip(torque - self.current, -change, change)
        if self.active["lag"]:
            rate = np.where(p["lag"] > 0.0, np.exp(-PHYSICS_DT / np.maximum(p["lag"], 1e-9)), 0.0)
            torque = torque + (self.current - torque) * rate
        self.current = torque
        self.sensed[1:] = self.sensed[:-1]
        self.sensed[0] = torque
        reading = _look_back(self.sensed, p["sensor_delay"]) if self.active["sensor_delay"] else torque
        motor = torque * p["gain"]
        if self.active["ripple"]:
            motor = motor + p["ripple"] * np.sin(p["ripple_cycles"] * q + p["ripple_phase"])
        self.time += PHYSICS_DT
        return reading * p["sensor_scale"] + p["sensor_offset"], motor

    def gear(self, motor: Array, q: Array, dq: Array, dt: float) -> Array:
        """Advance the rotors by `dt` [s]; return the torque on the links [N·m]."""
        if self.rotor_angle is None:
            self.rotor_angle, self.rotor_speed = q.copy(), dq.copy()
        half = 0.5 * self.parameters["gap"]
        twist = self.rotor_angle - q
        stretch = np.sign(twist) * np.maximum(np.abs(twist) - half, 0.0)
        engaged = np.abs(twist) > half
        torque = self.gear_stiffness * stretch + engaged * self.gear_damping * (self.rotor_speed - dq)
        self.rotor_speed = self.rotor_speed + dt * (motor - torque) / self.rotor_inertia
        self.rotor_angle = self.rotor_angle + dt * self.rotor_speed
        return np.where(self.geared, torque, motor)

    def springs(self, q: Array, dq: Array, dt: float) -> Array:
        """Return torques at the link that depend on its state alone [N·m], over a step of `dt` [s]."""
        p = self.parameters
        torque = -p["spring"] * (q - p["spring_rest"])
        if self.active["cubic_spring"]:
            torque = torque - p["cubic_spring"] * (q - p["spring_rest"]) ** 3
        if self.active["drag"]:
            torque = torque - p["drag"] * dq * np.abs(dq)
        if self.active["hysteresis"]:
            top = np.maximum(p["hysteresis"], 1e-9)
            self.bristle = np.clip(
                self.bristle + dt * dq * p["hysteresis_stiffness"] * (1.0 - self.bristle / top * np.sign(dq)),
                -top,
                top,
            )
            torque = torque - np.where(p["hysteresis"] > 0.0, self.bristle, 0.0)
        return torque

    def friction(self, q: Array, dq: Array, motor: Array) -> tuple[Array, Array]:
        """Return dry friction [N·m] and viscous coefficients [N·m·s/rad] of the joints."""
        p = self.parameters
        dry = p["coulomb"]
        if self.active["stribeck"]:
            dry = dry + p["stribeck"] * np.exp(-((dq / p["stribeck_speed"]) ** 2))
        if self.active["load_friction"]:
            dry = dry + p["load_friction"] * np.abs(motor)
        if self.active["oneway_friction"]:
            dry = dry + p["oneway_friction"] * (dq > 0.0)
        if self.active["angle_friction"]:
            dry = dry + p["angle_friction"] * 0.5 * (1.0 + np.sin(6.0 * q))
        viscous = p["viscous"]
        if self.active["warm_viscous"]:
            viscous = viscous + p["warm_viscous"] * np.exp(-(self.temperature - 30.0) / 20.0)
        return dry, viscous


def _look_back(history: Array, delay: Array) -> Array:
    """Return rows of a 1 kHz history, newest first, `delay` [s] ago with linear interpolation."""
    steps = delay / PHYSICS_DT
    whole = np.floor(steps).astype(int)
    share = steps - whole
    joints = np.arange(12)
    return (1.0 - share) * history[whole, joints] + share * history[whole + 1, joints]
