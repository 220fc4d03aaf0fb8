"""A pinhole camera: rays of its pixels, and pixels of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .array import Array

FOCAL = 2.3
"""Focal length in units of half the image height."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    position: Array
    axes: Array
    """(3, 3), columns right, up, backward in the world frame."""
    width: int
    height: int

    def rays(self, left: int, right: int, top: int, bottom: int) -> Array:
        """Return the directions of a rectangle of pixels in the world frame: (bottom - top, right - left, 3)."""
        half = 0.5 * self.height
        x = ((np.arange(left, right, dtype=np.float32) + 0.5) - 0.5 * self.width) / half
        y = (half - (np.arange(top, bottom, dtype=np.float32) + 0.5)) / half
        rays = x[None, :, None] * self.axes[:, 0] + y[:, None, None] * self.axes[:, 1] - FOCAL * self.axes[:, 2]
        return rays / np.sqrt(x[None, :, None] ** 2 + y[:, None, None] ** 2 + FOCAL**2)

    def rectangle(self, points: Array) -> tuple[int, int, int, int]:
        """Return pixels (left, right, top, bottom) around the hull of ``points`` [m]; empty behind the camera."""
        seen = (points - self.position) @ self.axes
        depth = -seen[:, 2]
        if depth.max() < 0.05:
            return 0, 0, 0, 0
        if depth.min() < 0.05:
            return 0, self.width, 0, self.height
        half = 0.5 * self.height
        x = 0.5 * self.width + half * FOCAL * seen[:, 0] / depth
        y = half - half * FOCAL * seen[:, 1] / depth
        left, top = max(int(x.min()) - 1, 0), max(int(y.min()) - 1, 0)
        return left, min(int(x.max()) + 2, self.width), top, min(int(y.max()) + 2, self.height)
