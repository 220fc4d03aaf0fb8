"""Colours of sky and ground, direction of the sun, fog."""

from __future__ import annotations

import numpy as np

from .array import Array

SKY_TOP, SKY_LOW = np.array([[92, 138, 190], [214, 226, 236]], dtype=np.float32)
TILES = np.array([[150, 158, 164], [178, 186, 190]], dtype=np.float32)
TILE_M = 0.25
FOG_M = 9.0
"""Length scale over which the ground fades into the horizon."""
SUN = np.array([0.3, -0.6, 0.74], dtype=np.float32) / np.float32(np.linalg.norm([0.3, -0.6, 0.74]))


def blurred_stripes(where: Array, width: Array) -> Array:
    """Return stripes of ±1 that change at every integer, averaged over ``width``; their integral is a triangle wave."""

    def integral(x: Array) -> Array:
        return np.abs(x - 2 * np.floor(0.5 * x) - 1)

    half = 0.5 * width
    return (integral(where + half) - integral(where - half)) / width
