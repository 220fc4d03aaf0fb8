"""Hidden effects outside the product's catalogue."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from families import Hidden, Rng, draw_scope

Draw = Callable[[Rng, float], Hidden]
LOG_SECONDS = 60.0  # [s], over which drifts grow to their largest value


def _signed(rng: Rng, size: float) -> float:
    return float(rng.choice((-1.0, 1.0))) * size


def _at_joints(name: str, sizes: Callable[[Rng, float], dict[str, float]], scope: str | None = None) -> Draw:
    """Return a draw of a law of the drive; `sizes` gives its parameters at a severity."""

    def draw(rng: Rng, severity: float) -> Hidden:
        values = sizes(rng, severity)
        return Hidden(name, scope or draw_scope(rng), severity, dict(values), values)

    return draw


def _slope(rng: Rng, severity: float) -> Hidden:
    direction = rng.uniform(0.0, 2.0 * np.pi)
    slope = 0.08 * severity * np.array([np.cos(direction), np.sin(direction)])
    return Hidden(
        "sloped_floor",
        "ground",
        severity,
        {"slope_rad": slope.tolist()},
        plant={"slope": slope},
    )


def _tether(rng: Rng, severity: float) -> Hidden:
    direction = rng.standard_normal(3)
    force = 25.0 * severity * direction / np.linalg.norm(direction)
    return Hidden("tether", "base", severity, {"force_n": force.tolist()}, plant={"tether": force})


def _moving_payload(rng: Rng, severity: float) -> Hidden:
    place = rng.uniform(-1.0, 1.0, 3) * (0.05, 0.03, 0.0) + np.array([0.0, 0.0, 0.08])
    reach = np.array([_signed(rng, 0.13), 0.0, 0.0])
    early, late = place + reach, place - reach
    mass = 2.5 * severity
    truth: dict[str, Any] = {
        "mass_kg": mass,
        "early_m": early.tolist(),
        "late_m": late.tolist(),
    }
    return Hidden(
        "moving_payload",
        "base",
        severity,
        truth,
        plant={"moving_payload": (mass, early, late)},
    )


def _hysteresis(rng: Rng, s: float) -> dict[str, float]:
    return {"hysteresis": 1.5 * s, "hysteresis_stiffness": rng.uniform(10.0, 40.0)}


def _packets(rng: Rng, s: float) -> dict[str, float]:
    return {
        "packet_period": float(rng.integers(20, 60)),
        "packet_loss": 1.0 + round(6.0 * s),
    }


OUTSIDE: dict[str, Draw] = {
    "warm_viscous": _at_joints("warm_viscous", lambda _, s: {"warm_viscous": 0.8 * s}),
    "oneway_friction": _at_joints("oneway_friction", lambda _, s: {"oneway_friction": 1.5 * s}),
    "crosstalk": _at_joints("crosstalk", lambda rng, s: {"crosstalk": _signed(rng, 0.25 * s)}, "all"),
    "encoder_scale": _at_joints("encoder_scale", lambda rng, s: {"encoder_scale": _signed(rng, 0.06 * s)}),
    "encoder_drift": _at_joints(
        "encoder_drift",
        lambda rng, s: {"encoder_drift": _signed(rng, 0.06 * s / LOG_SECONDS)},
    ),
    "hysteresis": _at_joints("hysteresis", _hysteresis),
    "cubic_spring": _at_joints(
        "cubic_spring",
        lambda rng, s: {"cubic_spring": 5.0 * s, "spring_rest": rng.uniform(-1.0, 1.0)},
    ),
    "torque_quantisation": _at_joints("torque_quantisation", lambda _, s: {"torque_step": 2.0 * s}),
    "packet_loss": _at_joints("packet_loss", _packets, "all"),
    "gain_slope": _at_joints("gain_slope", lambda rng, s: {"gain_slope": _signed(rng, 0.015 * s)}),
    "angle_friction": _at_joints("angle_friction", lambda _, s: {"angle_friction": 1.8 * s}),
    "clock_drift": _at_joints("clock_drift", lambda _, s: {"delay_drift": 0.02 * s / LOG_SECONDS}, "all"),
    "positive_limit": _at_joints("positive_limit", lambda _, s: {"positive_limit": 14.0 - 9.0 * s}),
    "error_gain": _at_joints("error_gain", lambda _, s: {"error_gain": 4.0 * s}),
    "drag": _at_joints("drag", lambda _, s: {"drag": 0.12 * s}),
    "slew_limit": _at_joints("slew_limit", lambda _, s: {"slew": 3000.0 * 0.07**s}),
    "dropout": _at_joints("dropout", lambda _, s: {"dropout": 0.6 * s}),
    "sloped_floor": _slope,
    "tether": _tether,
    "moving_payload": _moving_payload,
}
