"""Sky and a chequered plane, the image without a robot."""

from __future__ import annotations

import numpy as np

from .appearance import FOG_M, SKY_LOW, SKY_TOP, TILE_M, TILES, blurred_stripes
from .array import Array
from .camera import FOCAL, Camera


class Backdrop:
    """Sky and chequered ground for one camera height and direction, without the horizontal position."""

    def __init__(self, camera: Camera, height: float, normal: Array) -> None:
        self.rays = camera.rays(0, camera.width, 0, camera.height)
        self.axes, self.height, self.normal = camera.axes, height, normal
        rise = np.clip(self.rays[..., 2] * 3, 0, 1)
        # Colour planes first, (3, height, width): numpy is slow if the last axis is short.
        self._far = SKY_LOW[:, None, None] + (SKY_TOP - SKY_LOW)[:, None, None] * rise
        downward = self.rays @ normal
        self.distance = np.full(downward.shape, np.inf, dtype=np.float32)
        np.divide(-height, downward, out=self.distance, where=downward < -1e-3)
        seen = np.isfinite(self.distance)
        # Whole rows, because slices are faster than masks.
        rows = np.flatnonzero(seen.any(axis=1))
        self._first_row = int(rows[0]) if len(rows) else camera.height
        seen = seen[self._first_row :]
        distance = np.where(seen, self.distance[self._first_row :], 0)
        first = np.cross(np.array([0, 1, 0], dtype=np.float32), normal)
        first /= np.linalg.norm(first)
        self._tiles_from_world = np.stack([first, np.cross(normal, first)]) / np.float32(TILE_M)
        rays = self.rays[self._first_row :]
        self._tile = [np.ascontiguousarray((rays @ axis) * distance) for axis in self._tiles_from_world]
        # A distant pixel covers many tiles. Averaging over its footprint avoids flicker.
        footprint = distance / (0.5 * camera.height * FOCAL * TILE_M)
        slant = np.sqrt(np.clip(-downward[self._first_row :], 0.02, 1))
        self._width = np.maximum(footprint / slant, 1e-3).astype(np.float32)
        # Sky pixels in these rows are drawn as ground in complete fog.
        clear = np.where(seen, np.exp(-np.square(distance / FOG_M)), 0)
        mean = SKY_LOW + 0.5 * (TILES[0] + TILES[1] - 2 * SKY_LOW)
        far = self._far[:, self._first_row :]
        far += (mean[:, None, None] - far) * clear
        self._contrast = 0.5 * (TILES[0] - TILES[1])[:, None, None] * clear

    def fits(self, camera: Camera, height: float, normal: Array) -> bool:
        """Return true if the backdrop is valid for this camera."""
        same = np.array_equal(camera.axes, self.axes) and np.array_equal(normal, self.normal)
        return same and abs(height - self.height) < 1e-3

    def paint(self, offset: Array) -> Array:
        """Return the image without a robot, (3, height, width); ``offset`` [m] is from the ground to the camera."""
        colour = self._far.copy()
        across = [
            blurred_stripes(tile + np.float32(np.mod(axis @ offset, 2)), self._width)
            for tile, axis in zip(self._tile, self._tiles_from_world, strict=True)
        ]
        colour[:, self._first_row :] += self._contrast * (across[0] * across[1])
        return colour
