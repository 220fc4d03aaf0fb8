"""Images of one robot as arrays, or in a window, with a camera that follows it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from .array import Array
from .backdrop import Backdrop
from .camera import Camera
from .frame_buffer import FrameBuffer
from .height_field import HeightField, paint_field
from .shapes import shapes_of
from .window import Window

_CAMERA_OFFSET_M = np.array([0.62, -1.25, 0.55], dtype=np.float32)
"""Offset of the camera from its target: to the front right and above."""
_CAMERA_SMOOTHING = 0.2
"""Fraction of the distance to the robot by which the camera moves per image, so that a trot does not shake it."""
_NEAR_CLIP_M = 1.0
"""Distance from the camera's target to the robot above which the camera jumps, as after a reset."""
_REACH_M = 0.75
"""Largest distance of a body from the ground under the base at the usual distance of the camera. A Go2 reaches less."""


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
        self._zoom = np.float32(0)
        self._backdrop: Backdrop | None = None
        self._window = Window(width, height, fps) if mode == "human" else None

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
        shapes = shapes_of(scene)
        ground = cast(Mapping[str, Any], scene["ground"])
        point, normal = (np.asarray(ground[key], dtype=np.float32) for key in ("point", "normal"))
        bodies = np.frombuffer(cast(bytes, scene["pose"]), dtype="<f4").astype(np.float32).reshape(-1, 7)[:, :3]
        base = bodies[0]
        if self._zoom == 0:
            # A taller robot is seen from further away, during the whole episode alike.
            reach = np.linalg.norm(bodies - np.append(base[:2], np.float32(0)), axis=1).max()
            self._zoom = np.float32(max(1.0, float(reach) / _REACH_M))
        field = None if ground.get("height_field") is None else HeightField.read(ground["height_field"])
        if field is not None:
            # The camera follows the point of the ground under the robot.
            point = np.append(base[:2], field.height(*base[:2, None])).astype(np.float32)
        camera = self._camera(base, point, normal)
        offset = camera.position - point
        height = float(np.dot(offset, normal))
        if self._backdrop is None or not self._backdrop.fits(camera, height, normal):
            self._backdrop = Backdrop(camera, height, normal)
        if field is None:
            frame = FrameBuffer(camera, self._backdrop.rays, self._backdrop.distance, self._backdrop.paint(offset))
        else:
            frame = FrameBuffer(camera, self._backdrop.rays, *paint_field(camera, self._backdrop.rays, field))
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

    def _camera(self, base: Array, point: Array, normal: Array) -> Camera:
        # The target is the ground under the robot, so that vertical motion of the robot is visible.
        under = base - normal * np.dot(base - point, normal)
        last = self._target
        if last is None or np.linalg.norm(under - last) > _NEAR_CLIP_M:
            last = under
        smoothed = last + np.float32(_CAMERA_SMOOTHING) * (under - last)
        self._target = smoothed
        target = smoothed + self._zoom * np.float32(0.17) * normal
        backward = _CAMERA_OFFSET_M / np.float32(np.linalg.norm(_CAMERA_OFFSET_M))
        right = np.cross(np.array([0, 0, 1], dtype=np.float32), backward)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(backward, right), backward], axis=1).astype(np.float32)
        return Camera(target + self._zoom * _CAMERA_OFFSET_M, axes, self._width, self._height)
