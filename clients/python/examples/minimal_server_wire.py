"""Messages of ``minimal_server.py``: encoding, and checks of what a client sent."""

from collections.abc import Mapping
from typing import Any, cast

import msgpack as untyped_msgpack
import numpy as np
from numpy.typing import NDArray

msgpack: Any = untyped_msgpack
Message = dict[str, Any]
PROTOCOL = 1


class RequestError(Exception):
    """A request that is answered with an error reply, and that changes nothing."""

    def __init__(self, code: str, name: str, message: str) -> None:
        super().__init__(message)
        self.reply = encode(code=code, field=name, message=message, hint="", retryable=False)


def encode(**message: object) -> bytes:
    """Encode a reply."""
    return msgpack.packb({"protocol": PROTOCOL, **message})


def decode(payload: bytes, *, any_version: bool = False) -> Message:
    """Decode a request and check its version."""
    try:
        message = cast(object, msgpack.unpackb(payload))
    except Exception as error:
        raise RequestError("malformed", "", f"the request is not MessagePack: {error}") from error
    if not isinstance(message, dict):
        raise RequestError("malformed", "", "the request is not a map")
    checked = cast(Message, message)
    if not any_version and read(checked, "protocol", int) != PROTOCOL:
        raise RequestError("version", "protocol", f"`protocol` must be {PROTOCOL}")
    return checked


def read(message: Mapping[str, Any], name: str, kind: type) -> Any:
    """Return a field. Integers are unsigned."""
    value: Any = message.get(name)
    if type(value) is not kind or (kind is int and value < 0):
        raise RequestError("malformed", name, f"`{name}` is {type(value).__name__}; {kind.__name__} is expected")
    return value


def optional(message: Mapping[str, Any], name: str, kind: type, default: Any = None) -> Any:
    """Return a field; ``default`` where it is absent or nil."""
    return default if message.get(name) is None else read(message, name, kind)


def tensor(payload: bytes, name: str, dtype: str, *shape: int) -> NDArray[Any]:
    """Return a tensor; an error if its size is not that of ``shape``."""
    expected = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if len(payload) != expected:
        raise RequestError("bad_shape", name, f"`{name}` has {len(payload)} bytes; {expected} are expected")
    return np.frombuffer(payload, dtype).reshape(shape)


def limited(payload: bytes, limit: int) -> bytes:
    """Return the payload; an error if it is too large."""
    if len(payload) > limit:
        raise RequestError("too_large", "", f"the request has {len(payload)} bytes; at most {limit} are accepted here")
    return payload
