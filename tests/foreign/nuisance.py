"""Errors that every robot has, with or without a hidden effect."""

from __future__ import annotations

from typing import Any

import numpy as np

from drive import Array, neutral

Rng = np.random.Generator


def draw_nuisance(rng: Rng) -> dict[str, Any]:
    """Draw errors of masses, geometry, contacts, supply and heat of one robot (SI, °C)."""
    return {
        "trunk_mass": 1.0 + 0.01 * rng.standard_normal(),
        "link_mass": 1.0 + 0.03 * rng.standard_normal(12),
        "com": 0.002 * rng.standard_normal((13, 3)),
        "shape": 0.015 * rng.standard_normal((13, 3, 3)),
        "mount": 0.001 * rng.standard_normal((4, 3)),
        "tilt": 0.005 * rng.standard_normal(2),
        "imu_tilt": 0.002 * rng.standard_normal(2),
        "floor_friction": 1.0 + 0.05 * rng.standard_normal(),
        "foot_radius": 0.0005 * rng.standard_normal(4),
        "contact_time": rng.uniform(0.0025, 0.006),
        "contact_damping": rng.uniform(0.8, 1.2),
        "gear_rotor": 0.0005,
        "voltage": rng.uniform(28.0, 33.0),
        "discharge": rng.uniform(1.0, 4.0),
        "resistance": rng.uniform(0.1, 0.3),
        "temperature": rng.uniform(28.0, 50.0) + rng.uniform(-4.0, 4.0, 12),
        "warming": rng.uniform(0.03, 0.06) * rng.uniform(0.8, 1.2, 12),
        "cooling_time": rng.uniform(80.0, 200.0),
    }


def draw_drive_nuisance(rng: Rng) -> dict[str, Array]:
    """Draw the small errors that the drives of every robot have [SI]."""
    drive = neutral()
    drive["kp_scale"] = 1.0 + 0.01 * rng.standard_normal(12)
    drive["kd_scale"] = 1.0 + 0.02 * rng.standard_normal(12)
    drive["sensor_scale"] = 1.0 + 0.01 * rng.standard_normal(12)
    drive["sensor_offset"] = 0.02 * rng.standard_normal(12)
    drive["viscous"] = np.abs(0.02 * rng.standard_normal(12))
    drive["coulomb"] = np.abs(0.04 * rng.standard_normal(12))
    drive["rotor"] = np.abs(0.001 * rng.standard_normal(12))
    return drive


def draw_noise(rng: Rng) -> dict[str, float]:
    """Draw the true standard deviations of the sensors [SI, V, °C]."""
    ranges = {
        "q": (0.7e-4, 1.5e-4),
        "dq": (0.006, 0.015),
        "tau_measured": (0.05, 0.1),
        "gyro": (0.004, 0.015),
        "acc": (0.05, 0.15),
        "quat": (0.0004, 0.001),
        "pos": (0.0005, 0.002),
        "vel": (0.005, 0.02),
    }
    return {name: float(rng.uniform(*bounds)) for name, bounds in ranges.items()}
