"""Frames between a Twinstep server and this process: length, kind, body. All numbers are little-endian.

========  ======================================================================================================
request   body
========  ======================================================================================================
``H``     text: ``twinstep-mujoco VERSION robots=N threads=N iterations=N steps=N``, newline, nominal model (MJCF)
``R``     reset: number of robots; for each its index, ``INITIAL_STATE``, length of its model, its model (MJCF).
          The length 0 selects the nominal model.
``P``     push: index of a robot, three ``<f4``: velocity added to that of its base, in the world frame [m/s]
``S``     step: number of actuator periods; one byte per robot, 0 if it is not stepped; ``COMMAND`` per robot
========  ======================================================================================================

The reply to ``H`` is the text ``twinstep-mujoco VERSION mujoco=VERSION``. The reply to a reset is ``MEASURED`` for each
of its robots, then ``GROUND_TRUTH`` for each; to a push the same for its robot; to a step the same for all
robots. Any request may be answered by ``E``,
the text of an error, after which the process terminates. The robot that diverged has NaN in every reading.
"""

import struct
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import Error

PROTOCOL = 2
"""Version of the frames. The server has the same one."""

GREETING = "twinstep-mujoco"
MAX_FRAME_BYTES = 1 << 28
_LENGTH = struct.Struct("<I")
_PUSH = struct.Struct("<I3f")

Rows = NDArray[np.void]
"""Structured array with one row per robot."""

INITIAL_STATE = np.dtype(
    [
        ("base_position", "<f4", 3),
        ("base_orientation", "<f4", 4),
        ("base_linear_velocity", "<f4", 3),
        ("base_angular_velocity", "<f4", 3),
        ("q", "<f4", 12),
        ("dq", "<f4", 12),
    ]
)
"""Initial state of a robot: position [m], world-from-base (w, x, y, z), velocities, joints in ``JOINT_ORDER``."""

COMMAND = np.dtype([("q", "<f4", 12), ("dq", "<f4", 12), ("tau_ff", "<f4", 12), ("kp", "<f4", 12), ("kd", "<f4", 12)])
"""Command of a robot: the torque is ``kp (q - q_measured) + kd (dq - dq_measured) + tau_ff``, clipped to the limit."""

MEASURED = np.dtype(
    [("q", "<f4", 12), ("dq", "<f4", 12), ("tau", "<f4", 12), ("orientation", "<f4", 4), ("gyro", "<f4", 3)]
)
"""Sensor readings. ``tau`` is the mean over the last actuator period [N·m], ``gyro`` is in the base frame [rad/s]."""

GROUND_TRUTH = np.dtype(
    [
        ("base_position", "<f4", 3),
        ("base_linear_velocity", "<f4", 3),
        ("base_angular_velocity", "<f4", 3),
        ("foot_force", "<f4", 4),
        ("body_contact", "<f4"),
    ]
)
"""What no sensor measures: velocity in the world frame, angular velocity in the base frame, normal forces [N]."""


class FrameError(Error):
    """The input is not a frame, or its body is not that of its kind."""


@dataclass(frozen=True)
class Hello:
    """First request: the number of robots, and the settings of all."""

    robots: int
    threads: int
    iterations: int
    steps: int
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
        line, _, mjcf = body.decode().partition("\n")
        name, version, *settings = line.split(" ")
        if name != GREETING or int(version) != PROTOCOL:
            raise FrameError(f"the first request starts with `{name} {version}`, not `{GREETING} {PROTOCOL}`")
        numbers = {key: int(value) for key, value in (setting.split("=") for setting in settings)}
        return Hello(**numbers, mjcf=mjcf)
    except (ValueError, TypeError) as error:
        raise FrameError(f"the first request cannot be read: {error}") from error


def parse_reset(body: bytes) -> list[Reset]:
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
        robot, initial_state = number(), np.frombuffer(take(INITIAL_STATE.itemsize), INITIAL_STATE)
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


def parse_step(body: bytes, robots: int) -> Step:
    """Parse a step of ``robots`` robots."""
    expected = _LENGTH.size + robots * (1 + COMMAND.itemsize)
    if len(body) != expected:
        raise FrameError(f"a step of {robots} robots has {len(body)} bytes; {expected} are expected")
    (periods,) = _LENGTH.unpack_from(body)
    active = np.frombuffer(body, np.uint8, robots, _LENGTH.size) != 0
    return Step(periods, active, np.frombuffer(body, COMMAND, robots, _LENGTH.size + robots))


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
