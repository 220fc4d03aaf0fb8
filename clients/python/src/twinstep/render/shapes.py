"""Shapes of a robot: boxes, capsules and spheres, and their intersections with rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from .array import Array


@dataclass(frozen=True)
class Shape:
    """A shape in the world frame: a box, a capsule or a sphere (a capsule of length 0)."""

    kind: str
    size: Array
    """(3,), as in the message [m]."""
    centre: Array
    """(3,), position of the centre [m]."""
    axes: Array
    """(3, 3), world-from-shape rotation."""

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere [m]."""
        return float(np.linalg.norm(self.size)) if self.kind == "box" else float(self.size[0] + self.size[1])

    def corners(self) -> Array:
        """Return points whose convex hull contains the shape, (8, 3) [m]."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
        half = self.size if self.kind == "box" else self.size[0] + np.array([0, 0, self.size[1]], dtype=np.float32)
        return self.centre + (signs * half) @ self.axes.T

    def intersect(self, origins: Array, rays: Array) -> Array:
        """Return the distance along each ray to the shape.

        Parameters
        ----------
        origins : (1, 3) or (n, 3) float32
            Start points of the rays [m].
        rays : (n, 3) or (1, 3) float32
            Unit directions.

        Returns
        -------
        (n,) float32
            Distance [m]; infinite without an intersection.
        """
        start, ray = (origins - self.centre) @ self.axes, rays @ self.axes
        if self.kind == "box":
            return _intersect_box(start, ray, self.size)
        return _intersect_capsule(start, ray, float(self.size[0]), float(self.size[1]))

    def normal(self, points: Array) -> Array:
        """Return the unit normals (n, 3), in the world frame, at ``points`` (n, 3) [m] of the surface."""
        own = (points - self.centre) @ self.axes
        if self.kind == "box":
            face = np.abs(own / self.size).argmax(axis=1)
            rows = np.arange(len(own))
            normal = np.zeros_like(own)
            normal[rows, face] = np.sign(own[rows, face])
        else:
            own[:, 2] -= np.clip(own[:, 2], -self.size[1], self.size[1])
            normal = own / self.size[0]
        return normal @ self.axes.T


def shapes_of(scene: Mapping[str, object]) -> list[Shape]:
    """Return the shapes of a reply to ``render``, in the world frame."""
    pose = np.frombuffer(cast(bytes, scene["pose"]), dtype="<f4").reshape(-1, 7).astype(np.float32)
    rotations = [_rotation(body[3:]) for body in pose]
    shapes: list[Shape] = []
    for sent in cast(Sequence[Mapping[str, Any]], scene["shapes"]):
        offset, size = (np.asarray(sent[key], dtype=np.float32) for key in ("offset", "size"))
        body = int(sent["body"])
        world_from_body, origin = rotations[body], pose[body, :3]
        axes = world_from_body @ _rotation(offset[3:])
        shapes.append(Shape(sent["kind"], size, origin + world_from_body @ offset[:3], axes))
    return shapes


def _rotation(quaternion: Array) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion [w, x, y, z]."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=np.float32,
    )


def _intersect_box(start: Array, ray: Array, half: Array) -> Array:
    """Return the distances (n,) along rays to a box around the origin; ``start`` or ``ray`` may be (1, 3)."""
    enter, leave = np.float32(-np.inf), np.float32(np.inf)
    for axis in range(3):
        direction = ray[:, axis]
        direction = np.where(np.abs(direction) < 1e-7, np.float32(1e-7), direction)
        middle, reach = -start[:, axis] / direction, half[axis] / np.abs(direction)
        enter, leave = np.maximum(enter, middle - reach), np.minimum(leave, middle + reach)
    return np.where((enter < leave) & (enter > 0), enter, np.float32(np.inf)).astype(np.float32)


def _intersect_capsule(start: Array, ray: Array, radius: float, half_length: float) -> Array:
    """Return the distances (n,) along rays to a capsule along z around the origin, as in :func:`_intersect_box`."""
    (x, y, z), (u, v, w) = start.T, ray.T
    infinite = np.float32(np.inf)
    across = x * u + y * v
    outside = x * x + y * y - np.float32(radius**2)
    flat = u * u + v * v + np.float32(1e-9)
    under = across * across - flat * outside
    along = (-across - np.sqrt(np.maximum(under, 0))) / flat
    on_side = (under > 0) & (along > 0) & (np.abs(z + along * w) <= half_length)
    distance = np.where(on_side, along, infinite)
    for end in {half_length, -half_length}:
        height = z - np.float32(end)
        across_ball = across + height * w
        under = across_ball * across_ball - outside - height * height
        along = -across_ball - np.sqrt(np.maximum(under, 0))
        # The inner half of the sphere is inside the cylinder, which the ray hits first.
        distance = np.where((under > 0) & (along > 0) & (along < distance), along, distance)
    return distance
