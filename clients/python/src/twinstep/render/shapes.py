"""Shapes of a robot: boxes, capsules, cylinders, spheres and convex meshes, and their intersections with rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from .array import Array

_COLOURS = {
    kind: np.array(colour, dtype=np.float32)
    for kind, colour in (
        ("box", (208, 212, 218)),
        ("capsule", (122, 130, 142)),
        ("cylinder", (122, 130, 142)),
        ("convex", (208, 212, 218)),
        ("sphere", (38, 40, 46)),
    )
}
"""Colours of shapes that were sent without one."""


@dataclass(frozen=True)
class Shape:
    """A shape in the world frame. A sphere is a capsule of length 0."""

    kind: str
    size: Array
    """(3,), as in the message [m]; of a mesh, half sizes of the box around it."""
    colour: Array
    """(3,), red, green, blue from 0 to 255."""
    centre: Array
    """(3,), position of the centre [m]."""
    axes: Array
    """(3, 3), world-from-shape rotation."""
    planes: tuple[Array, Array] | None = None
    """Of a convex mesh: outward unit normals (n, 3) of its faces and their distances (n,) from the centre [m]."""

    def corners(self) -> Array:
        """Return points whose convex hull contains the shape, (8, 3) [m]."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
        half = self.size
        if self.kind in ("capsule", "sphere"):
            half = self.size[0] + np.array([0, 0, self.size[1]], dtype=np.float32)
        elif self.kind == "cylinder":
            half = self.size[[0, 0, 1]]
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
        if self.planes is not None:
            return _intersect_planes(start, ray, *self.planes)
        if self.kind == "cylinder":
            return _intersect_cylinder(start, ray, float(self.size[0]), float(self.size[1]))
        return _intersect_capsule(start, ray, float(self.size[0]), float(self.size[1]))

    def normal(self, points: Array) -> Array:
        """Return the unit normals (n, 3), in the world frame, at ``points`` (n, 3) [m] of the surface."""
        own = (points - self.centre) @ self.axes
        if self.kind == "box":
            face = np.abs(own / self.size).argmax(axis=1)
            rows = np.arange(len(own))
            normal = np.zeros_like(own)
            normal[rows, face] = np.sign(own[rows, face])
        elif self.planes is not None:
            normals, distances = self.planes
            normal = normals[(_products(normals, own) - distances[:, None]).argmax(axis=0)]
        elif self.kind == "cylinder":
            along = np.abs(own[:, 2]) - self.size[1]
            at_end = along > np.linalg.norm(own[:, :2], axis=1) - self.size[0]
            normal = own * np.array([1, 1, 0], dtype=np.float32) / self.size[0]
            normal[at_end] = np.sign(own[at_end, 2:]) * np.array([0, 0, 1], dtype=np.float32)
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
        kind, planes = str(sent["kind"]), None
        if kind == "convex":
            size, planes = _box_and_planes(sent["mesh"])
        colour = sent.get("colour")
        shade = _COLOURS[kind] if colour is None else np.asarray(colour, dtype=np.float32) * 255
        shapes.append(Shape(kind, size, shade, origin + world_from_body @ offset[:3], axes, planes))
    return shapes


def _box_and_planes(mesh: Mapping[str, Any]) -> tuple[Array, tuple[Array, Array]]:
    """Return half sizes of the box around a mesh and its centre, and the planes of its faces."""
    points = np.asarray(mesh["points"], dtype=np.float32)
    a, b, c = points[np.asarray(mesh["faces"], dtype=np.intp)].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = np.column_stack([normals, (normals * a).sum(axis=1)])
    # Triangles of one face have one plane.
    _, first = np.unique(planes.round(4), axis=0, return_index=True)
    return np.abs(points).max(axis=0), (normals[first], planes[first, 3])


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


def _intersect_planes(start: Array, ray: Array, normals: Array, distances: Array) -> Array:
    """Return the distances (n,) along rays to a convex mesh, as in :func:`_intersect_box`."""
    if len(start) == 1:
        # Rays from one point: it is outside of the same planes for all of them, and one over the distance is linear.
        height = distances - normals @ start[0]
        inverse = normals / np.where(np.abs(height) < 1e-9, np.float32(1e-9), height)[:, None]
        is_outside = height < 0
        last = _products(inverse[is_outside], ray).min(axis=0, initial=np.inf)
        first = _products(inverse[~is_outside], ray).max(axis=0, initial=-np.inf)
        hit = (last > 0) & np.isfinite(last) & (last > first)
        return np.where(hit, 1 / np.where(hit, last, 1), np.inf).astype(np.float32)
    # Parallel rays: all of them enter by the same planes, and the distance is linear.
    approach = normals @ ray[0]
    scale = 1 / np.where(np.abs(approach) < 1e-9, np.float32(1e-9), approach)
    cut = (distances * scale)[:, None] - _products(normals * scale[:, None], start)
    enter = cut[approach < 0].max(axis=0, initial=-np.inf)
    leave = cut[approach >= 0].min(axis=0, initial=np.inf)
    return np.where((enter < leave) & (enter > 0), enter, np.inf).astype(np.float32)


def _products(normals: Array, vectors: Array) -> Array:
    """Return the products (p, n) of normals (p, 3) and vectors (n, 3).

    Not with ``@``, whose threads wait for each other while a simulation uses all cores.
    """
    products: Array = np.einsum("pi,in->pn", normals, np.ascontiguousarray(vectors.T))
    return products


def _intersect_cylinder(start: Array, ray: Array, radius: float, half_length: float) -> Array:
    """Return the distances (n,) along rays to a cylinder along z around the origin, as in :func:`_intersect_box`."""
    (x, y, z), (u, v, w) = start.T, ray.T
    across, flat = x * u + y * v, u * u + v * v + np.float32(1e-9)
    under = across * across - flat * (x * x + y * y - np.float32(radius**2))
    root = np.sqrt(np.maximum(under, 0))
    w = np.where(np.abs(w) < 1e-7, np.float32(1e-7), w)
    middle, reach = -z / w, np.float32(half_length) / np.abs(w)
    enter = np.maximum((-across - root) / flat, middle - reach)
    leave = np.minimum((root - across) / flat, middle + reach)
    hit = (under > 0) & (enter < leave) & (enter > 0)
    return np.where(hit, enter, np.float32(np.inf)).astype(np.float32)


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
