"""Colour and distance of every pixel, to which shapes and their shadows are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .appearance import SUN
from .array import Array
from .camera import Camera
from .shapes import Shape

_AMBIENT, _DIFFUSE, _SHADOW = 0.5, 0.55, 0.55


class FrameBuffer:
    """Colour and distance of every pixel."""

    def __init__(self, camera: Camera, rays: Array, distance: Array, colour: Array) -> None:
        self._camera = camera
        self._rays = rays
        self._colour = colour
        self._distance = distance.copy()
        self._shadowed = np.zeros(self._distance.shape, dtype=np.bool_)

    def image(self) -> NDArray[np.uint8]:
        """Return the image, (height, width, 3) uint8."""
        return np.ascontiguousarray(self._colour.astype(np.uint8).transpose(1, 2, 0))

    def draw_shadow(self, shape: Shape, levels: Sequence[Array], normal: Array) -> None:
        """Darken the ground in the shadow of the shape. The ground lies between planes through ``levels`` [m]."""
        corners = shape.corners()
        corners = np.concatenate(
            [corners - ((corners - point) @ normal / np.dot(SUN, normal))[:, None] * SUN for point in levels]
        )
        left, right, top, bottom = self._camera.rectangle(corners)
        if left >= right or top >= bottom:
            return
        distance = self._distance[top:bottom, left:right]
        candidates = np.isfinite(distance) & ~self._shadowed[top:bottom, left:right]
        if not candidates.any():
            return
        rays = self._rays[top:bottom, left:right][candidates]
        ground = self._camera.position + rays * distance[candidates][:, None]
        hit = np.isfinite(shape.intersect(ground, SUN[None]))
        rows, columns = (index[hit] for index in np.nonzero(candidates))
        self._shadowed[top + rows, left + columns] = True
        self._colour[:, top + rows, left + columns] *= _SHADOW

    def draw_shape(self, shape: Shape) -> None:
        """Draw the shape at pixels without a nearer object."""
        left, right, top, bottom = self._camera.rectangle(shape.corners())
        if left >= right or top >= bottom:
            return
        rays = self._rays[top:bottom, left:right]
        distance = shape.intersect(self._camera.position[None], rays.reshape(-1, 3)).reshape(rays.shape[:2])
        nearest = self._distance[top:bottom, left:right]
        seen = distance < nearest
        nearest[seen] = distance[seen]
        light = shape.normal(self._camera.position + rays[seen] * distance[seen][:, None])
        facing = np.clip(light @ SUN, 0, 1)
        # Surfaces that face the sky get more ambient light.
        brightness = _AMBIENT * (0.75 + 0.25 * light[:, 2]) + _DIFFUSE * facing
        shine = facing**24
        shaded = np.minimum(shape.colour[:, None] * brightness + 40 * shine, 255)
        self._colour[:, top:bottom, left:right][:, seen] = shaded
