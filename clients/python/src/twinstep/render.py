"""Ray-cast images of one robot on the ground, from the server's reply to ``render``.

One ray per pixel is intersected with each shape, inside the rectangle around its silhouette. With numpy an image takes
milliseconds. World frame: z up; SI units.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
"""32-bit floats, because rendering is limited by memory bandwidth."""

_SKY_TOP, _SKY_LOW = np.array([[92, 138, 190], [214, 226, 236]], dtype=np.float32)
_TILES = np.array([[150, 158, 164], [178, 186, 190]], dtype=np.float32)
_COLOURS: dict[str, tuple[float, float, float]] = {
    "box": (208, 212, 218),
    "capsule": (122, 130, 142),
    "sphere": (38, 40, 46),
}
_TILE_M = 0.25
_FOG_M = 9.0
"""Length scale over which the ground fades into the horizon."""
_SUN = np.array([0.3, -0.6, 0.74], dtype=np.float32) / np.float32(np.linalg.norm([0.3, -0.6, 0.74]))
_AMBIENT, _DIFFUSE, _SHADOW = 0.5, 0.55, 0.55
_CAMERA_OFFSET_M = np.array([0.62, -1.25, 0.55], dtype=np.float32)
"""Offset of the camera from its target: to the front right and above."""
_FOCAL = 2.3
"""Focal length in units of half the image height."""
_CAMERA_SMOOTHING = 0.2
"""Fraction of the distance to the robot by which the camera moves per image, so that a trot does not shake it."""
_NEAR_CLIP_M = 1.0
"""Distance from the camera's target to the robot above which the camera jumps, as after a reset."""


@dataclass(frozen=True)
class _Shape:
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


@dataclass(frozen=True)
class _Camera:
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
        rays = x[None, :, None] * self.axes[:, 0] + y[:, None, None] * self.axes[:, 1] - _FOCAL * self.axes[:, 2]
        return rays / np.sqrt(x[None, :, None] ** 2 + y[:, None, None] ** 2 + _FOCAL**2)

    def rectangle(self, points: Array) -> tuple[int, int, int, int]:
        """Return pixels (left, right, top, bottom) around the hull of ``points`` [m]; empty behind the camera."""
        seen = (points - self.position) @ self.axes
        depth = -seen[:, 2]
        if depth.max() < 0.05:
            return 0, 0, 0, 0
        if depth.min() < 0.05:
            return 0, self.width, 0, self.height
        half = 0.5 * self.height
        x = 0.5 * self.width + half * _FOCAL * seen[:, 0] / depth
        y = half - half * _FOCAL * seen[:, 1] / depth
        left, top = max(int(x.min()) - 1, 0), max(int(y.min()) - 1, 0)
        return left, min(int(x.max()) + 2, self.width), top, min(int(y.max()) + 2, self.height)


class Viewer:
    """Renders one robot, as an array or in a window.

    Parameters
    ----------
    mode : {"rgb_array", "human"}
        "human" also shows every image in a window, which requires pygame.
    width, height : int
        Size of an image [pixels].
    fps : int
        Maximum frame rate of the window [Hz].

    Raises
    ------
    ImportError
        ``mode`` is "human" and pygame is not installed.
    """

    def __init__(self, mode: Literal["rgb_array", "human"], width: int = 640, height: int = 480, fps: int = 50) -> None:
        if mode not in ("rgb_array", "human"):
            raise ValueError(f'`mode` = {mode!r} is not allowed: "rgb_array" or "human"')
        self._width, self._height = width, height
        self._target: Array | None = None
        self._backdrop: _Backdrop | None = None
        self._window = _Window(width, height, fps) if mode == "human" else None

    def draw(self, scene: Mapping[str, object]) -> NDArray[np.uint8]:
        """Render the server's reply to ``render``.

        Parameters
        ----------
        scene : mapping
            The decoded reply: ``bodies``, ``pose``, ``shapes``, ``ground``.

        Returns
        -------
        (height, width, 3) uint8
            Red, green, blue.
        """
        shapes = _shapes_of(scene)
        ground = cast(Mapping[str, Any], scene["ground"])
        point, normal = (np.asarray(ground[key], dtype=np.float32) for key in ("point", "normal"))
        base = np.frombuffer(cast(bytes, scene["pose"]), dtype="<f4", count=3).astype(np.float32)
        field = None if ground.get("height_field") is None else _HeightField.read(ground["height_field"])
        if field is not None:
            # The camera follows the point of the ground under the robot.
            point = np.append(base[:2], field.height(*base[:2, None])).astype(np.float32)
        camera = self._camera(base, point, normal)
        offset = camera.position - point
        height = float(np.dot(offset, normal))
        if self._backdrop is None or not self._backdrop.fits(camera, height, normal):
            self._backdrop = _Backdrop(camera, height, normal)
        if field is None:
            frame = _FrameBuffer(camera, self._backdrop.rays, self._backdrop.distance, self._backdrop.paint(offset))
        else:
            frame = _FrameBuffer(camera, self._backdrop.rays, *_paint_field(camera, self._backdrop.rays, field))
        levels = [point] if field is None else [np.append(point[:2], level) for level in field.levels()]
        for shape in shapes:
            frame.draw_shadow(shape, levels, normal)
        for shape in shapes:
            frame.draw_shape(shape)
        image = frame.image()
        if self._window is not None:
            self._window.show(image)
        return image

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _camera(self, base: Array, point: Array, normal: Array) -> _Camera:
        # The target is the ground under the robot, so that vertical motion of the robot is visible.
        under = base - normal * np.dot(base - point, normal)
        last = self._target
        if last is None or np.linalg.norm(under - last) > _NEAR_CLIP_M:
            last = under
        smoothed = last + np.float32(_CAMERA_SMOOTHING) * (under - last)
        self._target = smoothed
        target = smoothed + np.float32(0.17) * normal
        backward = _CAMERA_OFFSET_M / np.float32(np.linalg.norm(_CAMERA_OFFSET_M))
        right = np.cross(np.array([0, 0, 1], dtype=np.float32), backward)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(backward, right), backward], axis=1).astype(np.float32)
        return _Camera(target + _CAMERA_OFFSET_M, axes, self._width, self._height)


class _Backdrop:
    """Sky and chequered ground for one camera height and direction, without the horizontal position."""

    def __init__(self, camera: _Camera, height: float, normal: Array) -> None:
        self.rays = camera.rays(0, camera.width, 0, camera.height)
        self.axes, self.height, self.normal = camera.axes, height, normal
        rise = np.clip(self.rays[..., 2] * 3, 0, 1)
        # Colour planes first, (3, height, width): numpy is slow if the last axis is short.
        self._far = _SKY_LOW[:, None, None] + (_SKY_TOP - _SKY_LOW)[:, None, None] * rise
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
        self._tiles_from_world = np.stack([first, np.cross(normal, first)]) / np.float32(_TILE_M)
        rays = self.rays[self._first_row :]
        self._tile = [np.ascontiguousarray((rays @ axis) * distance) for axis in self._tiles_from_world]
        # A distant pixel covers many tiles. Averaging over its footprint avoids flicker.
        footprint = distance / (0.5 * camera.height * _FOCAL * _TILE_M)
        slant = np.sqrt(np.clip(-downward[self._first_row :], 0.02, 1))
        self._width = np.maximum(footprint / slant, 1e-3).astype(np.float32)
        # Sky pixels in these rows are drawn as ground in complete fog.
        clear = np.where(seen, np.exp(-np.square(distance / _FOG_M)), 0)
        mean = _SKY_LOW + 0.5 * (_TILES[0] + _TILES[1] - 2 * _SKY_LOW)
        far = self._far[:, self._first_row :]
        far += (mean[:, None, None] - far) * clear
        self._contrast = 0.5 * (_TILES[0] - _TILES[1])[:, None, None] * clear

    def fits(self, camera: _Camera, height: float, normal: Array) -> bool:
        """Return true if the backdrop is valid for this camera."""
        same = np.array_equal(camera.axes, self.axes) and np.array_equal(normal, self.normal)
        return same and abs(height - self.height) < 1e-3

    def paint(self, offset: Array) -> Array:
        """Return the image without a robot, (3, height, width); ``offset`` [m] is from the ground to the camera."""
        colour = self._far.copy()
        across = [
            _blurred_stripes(tile + np.float32(np.mod(axis @ offset, 2)), self._width)
            for tile, axis in zip(self._tile, self._tiles_from_world, strict=True)
        ]
        colour[:, self._first_row :] += self._contrast * (across[0] * across[1])
        return colour


@dataclass(frozen=True)
class _HeightField:
    """Heights at the corners of square cells of two triangles each, as in the message ``height_field``."""

    origin: Array
    """(2,), x and y of the first vertex [m]."""
    cell_size: float
    """Side length of a cell [m]."""
    heights: Array
    """(rows, columns), along x and along y [m]."""

    @classmethod
    def read(cls, sent: Mapping[str, Any]) -> _HeightField:
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


_RAY_MARCH_STEPS = 20
"""Number of samples of a ray between the maximum and minimum height, to find the first intersection."""


def _intersect_field(field: _HeightField, start: Array, rays: Array) -> Array:
    """Return the distances (height, width) [m] along ``rays`` (height, width, 3) to a field, infinite in the sky."""
    lowest, highest = field.levels()
    # The triangles are found at half resolution. Then each ray is intersected with the plane of its triangle.
    x, y, z = np.ascontiguousarray(rays[::2, ::2].transpose(2, 0, 1))
    down = np.maximum(-z, np.float32(1e-3))
    enter = np.maximum((start[2] - highest) / down, np.float32(0))
    leave = np.minimum((start[2] - lowest) / down, np.float32(4 * _FOG_M))
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


def _paint_field(camera: _Camera, rays: Array, field: _HeightField) -> tuple[Array, Array]:
    """Return the distance of the ground (height, width) [m] and its image (3, height, width)."""
    rise = np.clip(rays[..., 2] * 3, 0, 1)
    colour: Array = _SKY_LOW[:, None, None] + (_SKY_TOP - _SKY_LOW)[:, None, None] * rise
    all_distance = np.full(rise.shape, np.inf, dtype=np.float32)
    rows = np.flatnonzero((rays[..., 2] < -1e-3).any(axis=1))
    if len(rows) == 0:
        return all_distance, colour
    # Whole rows, because slices are faster than masks.
    rays = rays[int(rows[0]) :]
    distance = _intersect_field(field, camera.position, rays)
    seen = np.isfinite(distance)
    near = np.where(seen, distance, np.float32(0))
    ray_x, ray_y, ray_z = np.ascontiguousarray(rays.transpose(2, 0, 1))
    x, y = camera.position[0] + near * ray_x, camera.position[1] + near * ray_y
    _, slope_x, slope_y = field.height_and_slope(x, y)
    up = 1 / np.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
    facing = np.clip((_SUN[2] - _SUN[0] * slope_x - _SUN[1] * slope_y) * up, 0, 1)
    # Level ground is as bright as the plane. The effect of slopes is exaggerated to make them visible.
    light = np.clip(1 + 1.2 * (facing - _SUN[2]), 0.4, 1.25)
    towards = (ray_x * slope_x + ray_y * slope_y - ray_z) * up
    # A distant pixel covers many tiles. Averaging over its footprint avoids flicker.
    footprint = near / np.float32(0.5 * camera.height * _FOCAL * _TILE_M)
    width = np.maximum(footprint / np.sqrt(np.clip(towards, 0.02, 1)), np.float32(1e-3))
    tiles = _blurred_stripes(x / np.float32(_TILE_M), width) * _blurred_stripes(y / np.float32(_TILE_M), width)
    clear = np.where(seen, np.exp(-np.square(near / np.float32(_FOG_M))), 0)
    mean, half = 0.5 * (_TILES[0] + _TILES[1]), 0.5 * (_TILES[0] - _TILES[1])
    own = (mean[:, None, None] + half[:, None, None] * tiles) * light
    all_distance[int(rows[0]) :] = distance
    colour[:, int(rows[0]) :] += (own - colour[:, int(rows[0]) :]) * clear
    return all_distance, colour


class _FrameBuffer:
    """Colour and distance of every pixel."""

    def __init__(self, camera: _Camera, rays: Array, distance: Array, colour: Array) -> None:
        self._camera = camera
        self._rays = rays
        self._colour = colour
        self._distance = distance.copy()
        self._shadowed = np.zeros(self._distance.shape, dtype=np.bool_)

    def image(self) -> NDArray[np.uint8]:
        """Return the image, (height, width, 3) uint8."""
        return np.ascontiguousarray(self._colour.astype(np.uint8).transpose(1, 2, 0))

    def draw_shadow(self, shape: _Shape, levels: Sequence[Array], normal: Array) -> None:
        """Darken the ground in the shadow of the shape. The ground lies between planes through ``levels`` [m]."""
        corners = shape.corners()
        corners = np.concatenate(
            [corners - ((corners - point) @ normal / np.dot(_SUN, normal))[:, None] * _SUN for point in levels]
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
        hit = np.isfinite(shape.intersect(ground, _SUN[None]))
        rows, columns = (index[hit] for index in np.nonzero(candidates))
        self._shadowed[top + rows, left + columns] = True
        self._colour[:, top + rows, left + columns] *= _SHADOW

    def draw_shape(self, shape: _Shape) -> None:
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
        facing = np.clip(light @ _SUN, 0, 1)
        # Surfaces that face the sky get more ambient light.
        brightness = _AMBIENT * (0.75 + 0.25 * light[:, 2]) + _DIFFUSE * facing
        shine = facing**24
        colour = np.array(_COLOURS[shape.kind], dtype=np.float32)
        shaded = np.minimum(colour[:, None] * brightness + 40 * shine, 255)
        self._colour[:, top:bottom, left:right][:, seen] = shaded


class _Window:
    """A pygame window with a maximum frame rate of ``fps``."""

    def __init__(self, width: int, height: int, fps: int) -> None:
        try:
            # Imported by name, because it is an optional dependency.
            self._pygame: Any = importlib.import_module("pygame")
        except ImportError as error:
            message = 'render mode "human" needs pygame\n  pip install "twinstep[render]"'
            raise ImportError(message) from error
        self._pygame.display.init()
        self._pygame.display.set_caption("twinstep")
        self._surface: Any = self._pygame.display.set_mode((width, height))
        self._period_s = 1.0 / fps
        self._next_s = time.monotonic()

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show ``image``, (height, width, 3), at the next frame time."""
        time.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = max(self._next_s, time.monotonic() - self._period_s) + self._period_s
        # A window that does not read its events is reported as unresponsive.
        self._pygame.event.pump()
        self._pygame.surfarray.blit_array(self._surface, image.swapaxes(0, 1))
        self._pygame.display.flip()

    def close(self) -> None:
        self._pygame.display.quit()


def _shapes_of(scene: Mapping[str, object]) -> list[_Shape]:
    pose = np.frombuffer(cast(bytes, scene["pose"]), dtype="<f4").reshape(-1, 7).astype(np.float32)
    rotations = [_rotation(body[3:]) for body in pose]
    shapes: list[_Shape] = []
    for sent in cast(Sequence[Mapping[str, Any]], scene["shapes"]):
        offset, size = (np.asarray(sent[key], dtype=np.float32) for key in ("offset", "size"))
        body = int(sent["body"])
        world_from_body, origin = rotations[body], pose[body, :3]
        axes = world_from_body @ _rotation(offset[3:])
        shapes.append(_Shape(sent["kind"], size, origin + world_from_body @ offset[:3], axes))
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


def _blurred_stripes(where: Array, width: Array) -> Array:
    """Return stripes of ±1 that change at every integer, averaged over ``width``; their integral is a triangle wave."""

    def integral(x: Array) -> Array:
        return np.abs(x - 2 * np.floor(0.5 * x) - 1)

    half = 0.5 * width
    return (integral(where + half) - integral(where - half)) / width
