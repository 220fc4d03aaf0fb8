"""Encoding of messages: the golden files that the server's tests share, and properties."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twinstep import codec

GOLDEN = Path(__file__).parents[3] / "protocol" / "golden"


def golden(name: str) -> dict[str, object]:
    return codec.decode((GOLDEN / f"{name}.msgpack").read_bytes())


def test_golden_requests_are_encoded_like_those_of_this_client() -> None:
    for path in sorted(GOLDEN.glob("*_request*.msgpack")):
        message = codec.decode(path.read_bytes())
        assert message.pop("protocol") == codec.PROTOCOL, path.name
        assert codec.decode(codec.encode(message)) == {"protocol": codec.PROTOCOL, **message}, path.name


def test_golden_hello_has_a_spec() -> None:
    hello = golden("hello_reply")
    spec = codec.read_spec(hello, str(hello["spec_hash"]))
    assert spec.hash == hello["spec_hash"]
    assert spec.obs_len == sum(part.size for part in spec.observation) > 0


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1))
def test_decoding_a_tensor_inverts_encoding(values: list[float]) -> None:
    array = np.array(values, "<f4")
    read = codec.tensor(codec.decode(codec.encode({"x": array.tobytes()})), "x", "<f4", len(values))
    np.testing.assert_array_equal(read, array)
    assert read.flags.writeable


@given(st.binary())
def test_any_bytes_decode_to_a_map_or_raise_a_typed_error(payload: bytes) -> None:
    with contextlib.suppress(codec.MalformedError):
        assert isinstance(codec.decode(payload), dict)


def test_error_contains_the_wrong_length() -> None:
    with pytest.raises(codec.MalformedError, match=r"`obs` has 7 bytes; <f4 \(2,\) is expected"):
        codec.tensor({"obs": bytes(7)}, "obs", "<f4", 2)
    with pytest.raises(codec.MalformedError, match="`obs` is NoneType, not bytes"):
        codec.tensor({}, "obs", "<f4", 2)
