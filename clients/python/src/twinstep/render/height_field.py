"""Uneven ground: a field of heights, its intersection with rays, and its image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .appearance import FOG_M, SKY_LOW, SKY_TOP, SUN, TILE_M, TILES, blurred_stripes
from .array import Array
from .camera import FOCAL, Camera

_RAY_MARCH_STEPS = 20
"""Number of samples of a ray between the maximum and minimum height, to find the first intersection."""


@dataclass(frozen=True)
class HeightField:
    """Heights at the corners of square cells of two triangles each, as in the message ``height_field``."""

    origin: Array
    """(2,), x and y of the first vertex [m]."""
    cell_size: float
    """Side length of a cell [m]."""
    heights: Array
    """(rows, columns), along x and along y [m]."""

    @classmethod
    def read(cls, sent: Mapping[str, Any]) -> HeightField:
        """Return the field of a message."""
        heights = np.frombuffer(sent["heights"], dtype="<f4").reshape(sent["rows"], sent["columns"])
        return cls(np.asarray(sent["origin"], dtype=np.float32), float(sent["cell_size"]), heights.astype(np.float32))

    def levels(self) -> tuple[float, float]:
        """Return the minimum and maximum height [m]."""
        return float(self.heights.min()), float(self.heights.max())

    def height(self, x: Array, y: Array) -> Array:
        """Return the heights [m] at ``x``, ``y`` [m]; outside, that of the nearest border point."""
        return self.height_and_slope(x, y)[0]

    def height_and_slope(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the heights [m] and their derivatives with respect to x and y, at ``x``, ``y`` [m]."""
        rows, columns = self.heights.shape
        along: Array = np.clip((x - self.origin[0]) / np.float32(self.cell_size), 0, np.float32(rows - 1))
        across: Array = np.clip((y - self.origin[1]) / np.float32(self.cell_size), 0, np.float32(columns - 1))
        row = np.minimum(along.astype(np.int32), rows - 2)
        column = np.minimum(across.astype(np.int32), columns - 2)
        u, v = (along - row).astype(np.float32), (across - column).astype(np.float32)
        flat = self.heights.ravel()
        first = row * columns + column
        far_x, far_y = flat[first + columns], flat[first + 1]
        # The triangles of a cell share two vertices. The third is the first vertex of the cell or the opposite one.
        near = u + v <= 1
        third = flat[first + np.where(near, 0, columns + 1)]
        rise_x, rise_y = far_x - third, far_y - third
        rise_x, rise_y = np.where(near, rise_x, rise_y), np.where(near, rise_y, rise_x)
        sign = np.where(near, np.float32(1), np.float32(-1))
        height = third + np.abs(u + sign * 0.5 - 0.5) * rise_x + np.abs(v + sign * 0.5 - 0.5) * rise_y
        scale = sign / np.float32(self.cell_size)
        return height, rise_x * scale, rise_y * scale


def intersect_field(field: HeightField, start: Array, rays: Array) -> Array:
    """Return the distances (height, width) [m] along ``rays`` (height, width, 3) to a field, infinite in the sky."""
    lowest, highest = field.levels()
    # The triangles are found at half resolution. Then each ray is intersected with the plane of its triangle.
    x, y, z = np.ascontiguousarray(rays[::2, ::2].transpose(2, 0, 1))
    down = np.maximum(-z, np.float32(1e-3))
    enter = np.maximum((start[2] - highest) / down, np.float32(0))
    leave = np.minimum((start[2] - lowest) / down, np.float32(4 * FOG_M))
    step = (leave - enter) / np.float32(_RAY_MARCH_STEPS)
    found: Array = leave
    above = np.ones(found.shape, dtype=np.bool_)
    for index in range(1, _RAY_MARCH_STEPS + 1):
        sample = enter + np.float32(index) * step
        under = start[2] + sample * z < field.height(start[0] + sample * x, start[1] + sample * y)
        found = np.where(above & under, sample - np.float32(0.5) * step, found)
        above &= ~under
    distance: Array = found.repeat(2, axis=0).repeat(2, axis=1)[: rays.shape[0], : rays.shape[1]]
    x, y, z = np.ascontiguousarray(rays.transpose(2, 0, 1))
    for _ in range(2):
        height, slope_x, slope_y = field.height_and_slope(start[0] + distance * x, start[1] + distance * y)
        # A Newton step along the ray is exact on a triangle. It is omitted for grazing rays.
        gap: Array = start[2] + distance * z - height
        fall: Array = slope_x * x + slope_y * y - z
        newton = np.where(fall > 0.02, gap / np.maximum(fall, np.float32(0.02)), 0)
        distance = distance + np.clip(newton, np.float32(-0.3), np.float32(0.3))
    return np.where(z < -1e-3, distance, np.float32(np.inf)).astype(np.float32)


def paint_field(camera: Camera, rays: Array, field: HeightField) -> tuple[Array, Array]:
    """Return the distance of the ground (height, width) [m] and its image (3, height, width)."""
    rise = np.clip(rays[..., 2] * 3, 0, 1)
    colour: Array = SKY_LOW[:, None, None] + (SKY_TOP - SKY_LOW)[:, None, None] * rise
    all_distance = np.full(rise.shape, np.inf, dtype=np.float32)
    rows = np.flatnonzero((rays[..., 2] < -1e-3).any(axis=1))
    if len(rows) == 0:
        return all_distance, colour
    # Whole rows, because slices are faster than masks.
    rays = rays[int(rows[0]) :]
    distance = intersect_field(field, camera.position, rays)
    seen = np.isfinite(distance)
    near = np.where(seen, distance, np.float32(0))
    ray_x, ray_y, ray_z = np.ascontiguousarray(rays.transpose(2, 0, 1))
    x, y = camera.position[0] + near * ray_x, camera.position[1] + near * ray_y
    _, slope_x, slope_y = field.height_and_slope(x, y)
    up = 1 / np.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
    facing = np.clip((SUN[2] - SUN[0] * slope_x - SUN[1] * slope_y) * up, 0, 1)
    # Level ground is as bright as the plane. The effect of slopes is exaggerated to make them visible.
    light = np.clip(1 + 1.2 * (facing - SUN[2]), 0.4, 1.25)
    towards = (ray_x * slope_x + ray_y * slope_y - ray_z) * up
    # A distant pixel covers many tiles. Averaging over its footprint avoids flicker.
    footprint = near / np.float32(0.5 * camera.height * FOCAL * TILE_M)
    width = np.maximum(footprint / np.sqrt(np.clip(towards, 0.02, 1)), np.float32(1e-3))
    tiles = blurred_stripes(x / np.float32(TILE_M), width) * blurred_stripes(y / np.float32(TILE_M), width)
    clear = np.where(seen, np.exp(-np.square(near / np.float32(FOG_M))), 0)
    mean, half = 0.5 * (TILES[0] + TILES[1]), 0.5 * (TILES[0] - TILES[1])
    own = (mean[:, None, None] + half[:, None, None] * tiles) * light
    all_distance[int(rows[0]) :] = distance
    colour[:, int(rows[0]) :] += (own - colour[:, int(rows[0]) :]) * clear
    return all_distance, colour
