"""Encode and decode messages of the wire protocol (``protocol/SPEC.md``), and read the spec of a server."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import msgpack
import numpy as np
from numpy.typing import NDArray

from .errors import Error

PROTOCOL = 1
"""Protocol version of this client."""


class MalformedError(Error):
    """A reply does not conform to the protocol."""


def encode(message: Mapping[str, object]) -> bytes:
    """Encode a request; adds the protocol version."""
    return cast(bytes, msgpack.packb({"protocol": PROTOCOL, **message}))


def decode(payload: bytes) -> dict[str, Any]:
    """Decode a message.

    Raises
    ------
    MalformedError
        The bytes are not a MessagePack map.
    """
    try:
        message = cast(object, msgpack.unpackb(payload))
    except Exception as error:  # msgpack raises many types
        raise MalformedError(f"the reply is not MessagePack: {error}") from error
    if not isinstance(message, dict):
        raise MalformedError(f"the reply is {type(message).__name__}, not a map")
    return cast(dict[str, Any], message)


def tensor(message: Mapping[str, Any], field: str, dtype: str, *shape: int) -> NDArray[Any]:
    """Return a tensor of ``message`` as a new, writable array.

    Parameters
    ----------
    message
        A decoded message.
    field
        Name of the tensor.
    dtype
        Little-endian NumPy type, such as ``"<f4"``.
    shape
        Expected shape; the first entry may be -1.
    """
    payload = message.get(field)
    if not isinstance(payload, bytes):
        raise MalformedError(f"`{field}` is {type(payload).__name__}, not bytes")
    try:
        return np.frombuffer(payload, dtype).reshape(shape).copy()
    except ValueError as error:
        raise MalformedError(f"`{field}` has {len(payload)} bytes; {dtype} {shape} is expected") from error


@dataclass(frozen=True)
class SpecField:
    """One quantity of an observation or action: ``size`` entries with a common name, unit and bounds."""

    name: str
    size: int
    unit: str
    low: float
    high: float
    description: str


@dataclass(frozen=True)
class Spec:
    """Spec of a server's task: layouts, periods, gains. An agent can run on every server with the same ``hash``."""

    task: str
    robot: str
    observation: tuple[SpecField, ...]
    critic_observation: tuple[SpecField, ...]
    action: tuple[SpecField, ...]
    joint_order: tuple[str, ...]
    policy_dt: float
    actuator_dt: float
    kp: float
    kd: float
    joint_gains: tuple[tuple[float, float], ...]
    action_scale: float
    default_pose: tuple[float, ...]
    reward_terms: tuple[str, ...]
    max_episode_steps: int
    hash: str

    @property
    def obs_len(self) -> int:
        """Length of an observation."""
        return sum(part.size for part in self.observation)

    @property
    def critic_len(self) -> int:
        """Length of a privileged observation of group ``critic``; 0 if there is none."""
        return sum(part.size for part in self.critic_observation)

    @property
    def action_len(self) -> int:
        """Length of an action."""
        return sum(part.size for part in self.action)

    def action_entry(self, index: int) -> str:
        """Return the name of entry ``index`` of an action, such as ``joint_position_offset[FL_thigh]``."""
        for part in self.action:
            if index < part.size:
                per_joint = part.size == len(self.joint_order)
                return f"{part.name}[{self.joint_order[index] if per_joint else index}]"
            index -= part.size
        raise IndexError(index)


def read_spec(message: Mapping[str, Any], spec_hash: str) -> Spec:
    """Read the ``spec`` of a hello or lease reply."""
    try:
        fields: dict[str, Any] = {
            "critic_observation": (),
            "joint_gains": (),
            **cast(Mapping[str, Any], message["spec"]),
        }
        for name in ("observation", "critic_observation", "action"):
            fields[name] = tuple(
                SpecField(**{key: part[key] for key in ("name", "size", "unit", "low", "high", "description")})
                for part in fields[name]
            )
        for name in ("joint_order", "default_pose", "reward_terms"):
            fields[name] = tuple(fields[name])
        fields["joint_gains"] = tuple((float(kp), float(kd)) for kp, kd in fields["joint_gains"])
        known = set(Spec.__dataclass_fields__) - {"hash"}
        return Spec(**{name: fields[name] for name in known}, hash=spec_hash)
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedError(f"the server's spec is invalid: {error}") from error
