"""Hidden effects: those of the product's catalogue, laws outside it, and pairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drive import JOINTS, NEUTRAL, Array

Rng = np.random.Generator


@dataclass(frozen=True)
class Hidden:
    """One hidden effect: its name, scope and size, and the changes that simulate it."""

    effect: str
    scope: str
    severity: float
    parameters: dict[str, Any]
    drive: dict[str, float] = field(default_factory=dict)
    plant: dict[str, Any] = field(default_factory=dict)

    def apply(self, drive: dict[str, Array]) -> None:
        """Change the parameters of the drives at the joints of the scope."""
        mask = joints_of(self.scope)
        for name, value in self.drive.items():
            if NEUTRAL[name] == 0.0 and name not in REPLACES:
                drive[name] = np.where(mask, drive[name] + value, drive[name])
            elif NEUTRAL[name] == 1.0:
                drive[name] = np.where(mask, drive[name] * value, drive[name])
            else:
                drive[name] = np.where(mask, value, drive[name])


# Parameters that a change sets, although their neutral value is 0.
REPLACES = ("ripple_phase", "spring_rest", "derating", "lag", "gap")


def joints_of(scope: str) -> Array:
    """Return which of the twelve joints a scope contains, as a mask."""
    if scope in ("base", "ground"):
        return np.zeros(12, dtype=bool)
    return np.array([scope in ("all", name, *name.split("_")) for name in JOINTS])


def draw_scope(rng: Rng) -> str:
    """Draw all joints, one joint type or one joint with equal probability."""
    kind = rng.integers(3)
    if kind == 0:
        return "all"
    return str(rng.choice(("hip", "thigh", "calf"))) if kind == 1 else str(rng.choice(JOINTS))


def _sign(rng: Rng) -> float:
    return float(rng.choice((-1.0, 1.0)))


def _between(severity: float, weak: float, strong: float) -> float:
    """Return the value at a severity of 0.2 (`weak`) to 1 (`strong`), geometrically interpolated."""
    return weak * (strong / weak) ** ((severity - 0.2) / 0.8)


# Effects on joints with one parameter: its catalogue name, its name in the drive, and its largest value.
SIMPLE = {
    "command_delay": ("delay_s", "command_delay", 0.02),
    "torque_delay": ("delay_s", "torque_delay", 0.01),
    "torque_sensor_delay": ("delay_s", "sensor_delay", 0.02),
    "torque_dead_zone": ("half_width_nm", "dead_zone", 1.5),
    "drive_lag": ("time_constant_s", "lag", 0.015),
    "backlash": ("gap_rad", "gap", 0.02),
    "coulomb_friction": ("torque_nm", "coulomb", 1.5),
    "viscous_friction": ("coefficient_nms", "viscous", 0.6),
    "load_friction": ("coefficient", "load_friction", 0.25),
    "armature": ("inertia_kgm2", "rotor", 0.05),
}


def _simple(name: str) -> Callable[[Rng, float], Hidden]:
    parameter, key, largest = SIMPLE[name]

    def draw(rng: Rng, severity: float) -> Hidden:
        value = severity * largest
        return Hidden(name, draw_scope(rng), severity, {parameter: value}, {key: value})

    return draw


def _encoder_offset(rng: Rng, severity: float) -> Hidden:
    value = _sign(rng) * severity * 0.05
    return Hidden(
        "encoder_offset",
        draw_scope(rng),
        severity,
        {"offset_rad": value},
        {"encoder_offset": value},
    )


def _pd_gain(rng: Rng, severity: float) -> Hidden:
    kind = rng.integers(3)
    kp = 1.0 + _sign(rng) * severity * 0.3 * (kind != 1)
    kd = 1.0 + _sign(rng) * severity * 0.5 * (kind != 0)
    drive = {"kp_scale": kp, "kd_scale": kd}
    return Hidden("pd_gain", draw_scope(rng), severity, dict(drive), drive)


def _saturation(rng: Rng, severity: float) -> Hidden:
    value = _between(severity, 40.0, 15.0)
    return Hidden(
        "torque_saturation",
        draw_scope(rng),
        severity,
        {"kappa_nm": value},
        {"kappa": value},
    )


def _sag(_rng: Rng, severity: float) -> Hidden:
    value = 2.0 * severity
    return Hidden("supply_sag", "all", severity, {"exponent": value}, {"sag_exponent": value})


def _derating(rng: Rng, severity: float) -> Hidden:
    slope, above = severity * 0.005, rng.uniform(25.0, 45.0)
    drive = {"derating": slope, "derating_above": above}
    return Hidden(
        "thermal_derating",
        draw_scope(rng),
        severity,
        {"per_kelvin": slope, "above_c": above},
        drive,
    )


def _speed_limit(rng: Rng, severity: float) -> Hidden:
    value = _between(severity, 60.0, 12.0)
    return Hidden(
        "torque_speed_limit",
        draw_scope(rng),
        severity,
        {"no_load_rad_s": value},
        {"no_load_speed": value},
    )


def _torque_gain(rng: Rng, severity: float) -> Hidden:
    value = 1.0 + _sign(rng) * severity * 0.2
    return Hidden("torque_gain", draw_scope(rng), severity, {"gain": value}, {"gain": value})


def _ripple(rng: Rng, severity: float) -> Hidden:
    size, cycles = (
        severity * 0.4,
        float(np.round(np.exp(rng.uniform(np.log(15.0), np.log(150.0))))),
    )
    phase = rng.uniform(-3.0, 3.0)
    truth = {"amplitude_nm": size, "cycles_per_turn": cycles, "phase_rad": phase}
    drive = {"ripple": size, "ripple_cycles": cycles, "ripple_phase": phase}
    return Hidden("torque_ripple", draw_scope(rng), severity, truth, drive)


def _elasticity(rng: Rng, severity: float) -> Hidden:
    value = _between(severity, 2000.0, 200.0)
    return Hidden(
        "joint_elasticity",
        draw_scope(rng),
        severity,
        {"stiffness_nm_rad": value},
        {"stiffness": value},
    )


def _stribeck(rng: Rng, severity: float) -> Hidden:
    speed = _between(rng.uniform(0.2, 1.0), 0.1, 3.0)
    truth = {"breakaway_nm": severity, "speed_rad_s": speed}
    drive = {"stribeck": severity, "stribeck_speed": speed}
    return Hidden("stribeck_friction", draw_scope(rng), severity, truth, drive)


def _spring(rng: Rng, severity: float) -> Hidden:
    truth = {"stiffness_nm_rad": 3.0 * severity, "rest_rad": rng.uniform(-1.5, 1.5)}
    drive = {"spring": truth["stiffness_nm_rad"], "spring_rest": truth["rest_rad"]}
    return Hidden("joint_spring", draw_scope(rng), severity, truth, drive)


def _payload(rng: Rng, severity: float) -> Hidden:
    mass = -severity if rng.random() < 0.25 else 4.0 * severity
    place = rng.uniform(-1.0, 1.0, 3) * (0.2, 0.08, 0.1)
    truth = {"mass_kg": mass, "position_m": place.tolist()}
    return Hidden("payload", "base", severity, truth, plant={"payload": (mass, place)})


def _com_shift(rng: Rng, severity: float) -> Hidden:
    shift = rng.uniform(-1.0, 1.0, 3) * (1.0, 0.7, 0.7)
    shift *= 0.05 * severity / np.abs(shift).max()
    return Hidden(
        "com_shift",
        "base",
        severity,
        {"shift_m": shift.tolist()},
        plant={"com_shift": shift},
    )


def _inertia(rng: Rng, severity: float) -> Hidden:
    # The prior of theta has no physical range: the trunk's second moments grow by up to a factor of three.
    scale = np.exp(0.55 * severity * rng.uniform(0.6, 1.0, 3))
    return Hidden(
        "inertia",
        "base",
        severity,
        {"trunk_axis_scale": scale.tolist()},
        plant={"trunk_scale": scale},
    )


def _ground_friction(rng: Rng, severity: float) -> Hidden:
    value = 0.8 - 0.5 * severity if rng.random() < 0.6 else 0.8 + 0.4 * severity
    truth = {"coefficient": value}
    return Hidden("ground_friction", "ground", severity, truth, plant={"ground_friction": value})


def _ground_stiffness(_rng: Rng, severity: float) -> Hidden:
    value = 0.002 + 0.038 * severity
    return Hidden(
        "ground_stiffness",
        "ground",
        severity,
        {"time_constant_s": value},
        plant={"ground_time": value},
    )


def _gyro_bias(rng: Rng, severity: float) -> Hidden:
    bias = rng.uniform(-1.0, 1.0, 3)
    bias *= 0.02 * severity / np.abs(bias).max()
    return Hidden(
        "gyro_bias",
        "base",
        severity,
        {"bias_rad_s": bias.tolist()},
        plant={"gyro_bias": bias},
    )


CATALOGUE: dict[str, Callable[[Rng, float], Hidden]] = {
    **{name: _simple(name) for name in SIMPLE},
    "encoder_offset": _encoder_offset,
    "pd_gain": _pd_gain,
    "torque_saturation": _saturation,
    "supply_sag": _sag,
    "thermal_derating": _derating,
    "torque_speed_limit": _speed_limit,
    "torque_gain": _torque_gain,
    "torque_ripple": _ripple,
    "joint_elasticity": _elasticity,
    "stribeck_friction": _stribeck,
    "joint_spring": _spring,
    "payload": _payload,
    "com_shift": _com_shift,
    "inertia": _inertia,
    "ground_friction": _ground_friction,
    "ground_stiffness": _ground_stiffness,
    "gyro_bias": _gyro_bias,
}
