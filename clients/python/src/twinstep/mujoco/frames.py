"""Frames between a Twinstep server and this process: length, kind, body. All numbers are little-endian.

========  ======================================================================================================
request   body
========  ======================================================================================================
``H``     text: ``twinstep-mujoco VERSION robots=N threads=N iterations=N steps=N base=N``, newline, names of the
          joints, newline, names of the geoms, newline, nominal model (MJCF). Names are separated by tabs. ``base`` is
          the index of the body that a robot with a fixed base has as its base; 0 is the world.
``R``     reset: number of robots; for each its index, ``initial_state``, length of its model, its model (MJCF).
          The length 0 selects the nominal model.
``P``     push: index of a robot, three ``<f4``: velocity added to that of its base, in the world frame [m/s]
``S``     step: number of actuator periods; one byte per robot, 0 if it is not stepped; ``command`` per robot
========  ======================================================================================================

Rows are those of :class:`Layout`. The reply to ``H`` is the text ``twinstep-mujoco VERSION mujoco=VERSION``. The reply
to a reset is ``measured`` for each of its robots, then ``truth`` for each; to a push the same for its robot; to a step
the same for all robots. Any request may be answered by ``E``,
the text of an error, after which the process terminates. The robot that diverged has NaN in every reading.
"""

import struct
from dataclasses import dataclass
from functools import cached_property
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import Error

PROTOCOL = 3
"""Version of the frames. The server has the same one."""

GREETING = "twinstep-mujoco"
MAX_FRAME_BYTES = 1 << 28
_LENGTH = struct.Struct("<I")
_PUSH = struct.Struct("<I3f")

Rows = NDArray[np.void]
"""Structured array with one row per robot."""


@dataclass(frozen=True)
class Layout:
    """Joints and geoms of the robots, in the order of every row. Numbers are ``<f4``."""

    joints: tuple[str, ...]
    geoms: tuple[str, ...]

    @cached_property
    def initial_state(self) -> np.dtype[np.void]:
        """Initial state: position [m], world-from-base (w, x, y, z), velocities; joints."""
        base = [("base_position", "<f4", 3), ("base_orientation", "<f4", 4)]
        base += [("base_linear_velocity", "<f4", 3), ("base_angular_velocity", "<f4", 3)]
        return np.dtype([*base, *self._of_joints("q", "dq")])

    @cached_property
    def command(self) -> np.dtype[np.void]:
        """Command: the torque is ``kp (q - q_measured) + kd (dq - dq_measured) + tau_ff``, clipped to the limit."""
        return np.dtype(self._of_joints("q", "dq", "tau_ff", "kp", "kd"))

    @cached_property
    def measured(self) -> np.dtype[np.void]:
        """Sensor readings. ``tau`` is the mean over the last actuator period, ``gyro`` is in the base frame [rad/s]."""
        return np.dtype([*self._of_joints("q", "dq", "tau"), ("orientation", "<f4", 4), ("gyro", "<f4", 3)])

    @cached_property
    def truth(self) -> np.dtype[np.void]:
        """What no sensor measures: linear velocity in the world frame, angular in the base frame, normal forces [N]."""
        base = [(name, "<f4", 3) for name in ("base_position", "base_linear_velocity", "base_angular_velocity")]
        return np.dtype([*base, ("geom_force", "<f4", (len(self.geoms),))])

    def _of_joints(self, *names: str) -> list[tuple[str, str, tuple[int]]]:
        return [(name, "<f4", (len(self.joints),)) for name in names]


class FrameError(Error):
    """The input is not a frame, or its body is not that of its kind."""


@dataclass(frozen=True)
class Hello:
    """First request: the number of robots, and the settings of all."""

    robots: int
    threads: int
    iterations: int
    steps: int
    base: int
    layout: Layout
    mjcf: str


@dataclass(frozen=True)
class Reset:
    """Reset of one robot. ``mjcf`` is its model; empty for the nominal one."""

    robot: int
    initial_state: Rows
    mjcf: str


@dataclass(frozen=True)
class Push:
    """Velocity that is added to that of the base of one robot, in the world frame [m/s]."""

    robot: int
    velocity: list[float]


@dataclass(frozen=True)
class Step:
    """Step of all robots with ``active`` true, by a number of actuator periods."""

    periods: int
    active: NDArray[np.bool_]
    commands: Rows


def read_frame(stream: BinaryIO) -> tuple[bytes, bytes] | None:
    """Return kind and body of the next frame, or None at the end of the stream."""
    head = stream.read(_LENGTH.size)
    if not head:
        return None
    if len(head) < _LENGTH.size:
        raise FrameError("the stream ends within a length")
    (length,) = _LENGTH.unpack(head)
    if not 1 <= length <= MAX_FRAME_BYTES:
        raise FrameError(f"a frame of {length} bytes is not allowed: 1 to {MAX_FRAME_BYTES}")
    frame = stream.read(length)
    if len(frame) < length:
        raise FrameError(f"the stream ends after {len(frame)} of {length} bytes of a frame")
    return frame[:1], frame[1:]


def write_frame(stream: BinaryIO, kind: bytes, body: bytes) -> None:
    """Write and flush a frame."""
    stream.write(_LENGTH.pack(1 + len(body)) + kind + body)
    stream.flush()


def greeting(mujoco_version: str) -> bytes:
    """Return the reply to the first request."""
    return f"{GREETING} {PROTOCOL} mujoco={mujoco_version}".encode()


def parse_hello(body: bytes) -> Hello:
    """Parse the first request.

    Raises
    ------
    FrameError
        The program that wrote it has another version, or it is not a first request.
    """
    try:
        line, joints, geoms, mjcf = body.decode().split("\n", 3)
        name, version, *settings = line.split(" ")
        if name != GREETING or int(version) != PROTOCOL:
            raise FrameError(f"the first request starts with `{name} {version}`, not `{GREETING} {PROTOCOL}`")
        numbers = {key: int(value) for key, value in (setting.split("=") for setting in settings)}
        return Hello(**numbers, layout=Layout(_names(joints), _names(geoms)), mjcf=mjcf)
    except (ValueError, TypeError) as error:
        raise FrameError(f"the first request cannot be read: {error}") from error


def _names(line: str) -> tuple[str, ...]:
    return tuple(line.split("\t")) if line else ()


def parse_reset(body: bytes, layout: Layout) -> list[Reset]:
    """Parse a reset."""
    at = 0

    def take(count: int) -> bytes:
        nonlocal at
        part = body[at : at + count]
        if len(part) < count:
            raise FrameError(f"a reset of {len(body)} bytes ends too early")
        at += count
        return part

    def number() -> int:
        return int(_LENGTH.unpack(take(_LENGTH.size))[0])

    resets = list[Reset]()
    for _ in range(number()):
        robot, initial_state = number(), np.frombuffer(take(layout.initial_state.itemsize), layout.initial_state)
        try:
            resets.append(Reset(robot, initial_state, take(number()).decode()))
        except UnicodeDecodeError as error:
            raise FrameError(f"the model of robot {robot} is not UTF-8: {error}") from error
    if at != len(body):
        raise FrameError(f"a reset has {len(body) - at} bytes too many")
    return resets


def parse_push(body: bytes) -> Push:
    """Parse a push."""
    if len(body) != _PUSH.size:
        raise FrameError(f"a push has {len(body)} bytes; {_PUSH.size} are expected")
    robot, *velocity = _PUSH.unpack(body)
    return Push(robot, velocity)


def parse_step(body: bytes, robots: int, layout: Layout) -> Step:
    """Parse a step of ``robots`` robots."""
    expected = _LENGTH.size + robots * (1 + layout.command.itemsize)
    if len(body) != expected:
        raise FrameError(f"a step of {robots} robots has {len(body)} bytes; {expected} are expected")
    (periods,) = _LENGTH.unpack_from(body)
    active = np.frombuffer(body, np.uint8, robots, _LENGTH.size) != 0
    return Step(periods, active, np.frombuffer(body, layout.command, robots, _LENGTH.size + robots))


def reset_body(resets: list[Reset]) -> bytes:
    """Return the body of a reset; the inverse of :func:`parse_reset`."""
    parts = [_LENGTH.pack(len(resets))]
    for reset in resets:
        mjcf = reset.mjcf.encode()
        parts += [_LENGTH.pack(reset.robot), reset.initial_state.tobytes(), _LENGTH.pack(len(mjcf)), mjcf]
    return b"".join(parts)


def step_body(step: Step) -> bytes:
    """Return the body of a step; the inverse of :func:`parse_step`."""
    return _LENGTH.pack(step.periods) + step.active.astype(np.uint8).tobytes() + step.commands.tobytes()
