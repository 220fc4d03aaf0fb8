"""Pairs of hidden effects, and the robot that hidden effects give."""

from __future__ import annotations

from typing import Any

from drive import Array
from families import CATALOGUE, Hidden, Rng

# Pairs whose signatures overlap; half of the pair suite is drawn from them.
CONFOUNDERS = (
    ("command_delay", "armature"),
    ("command_delay", "drive_lag"),
    ("torque_delay", "drive_lag"),
    ("torque_delay", "torque_sensor_delay"),
    ("torque_gain", "torque_saturation"),
    ("torque_gain", "payload"),
    ("torque_gain", "coulomb_friction"),
    ("coulomb_friction", "viscous_friction"),
    ("coulomb_friction", "stribeck_friction"),
    ("coulomb_friction", "load_friction"),
    ("coulomb_friction", "backlash"),
    ("coulomb_friction", "torque_dead_zone"),
    ("viscous_friction", "pd_gain"),
    ("supply_sag", "thermal_derating"),
    ("payload", "com_shift"),
    ("encoder_offset", "joint_spring"),
    ("backlash", "joint_elasticity"),
    ("torque_saturation", "torque_speed_limit"),
)


def draw_pair(rng: Rng, confounded: bool) -> list[Hidden]:
    """Draw two effects of the catalogue, confounders of each other or any two."""
    names = CONFOUNDERS[rng.integers(len(CONFOUNDERS))] if confounded else rng.choice(list(CATALOGUE), 2, replace=False)
    return [CATALOGUE[str(name)](rng, rng.uniform(0.3, 1.0)) for name in names]


def combine(hidden: list[Hidden], nuisance_drive: dict[str, Array]) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return the drive parameters and the plant changes of a robot with hidden effects."""
    drive = {name: value.copy() for name, value in nuisance_drive.items()}
    plant: dict[str, Any] = {}
    for entry in hidden:
        entry.apply(drive)
        plant |= entry.plant
    return drive, plant
