"""Frames between a server and ``python -m twinstep.mujoco``."""

import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twinstep.mujoco.frames import (
    COMMAND,
    GROUND_TRUTH,
    INITIAL_STATE,
    MAX_FRAME_BYTES,
    MEASURED,
    FrameError,
    Hello,
    Push,
    Reset,
    Step,
    parse_hello,
    parse_push,
    parse_reset,
    parse_step,
    read_frame,
    reset_body,
    step_body,
    write_frame,
)

INDEX = st.integers(0, 2**32 - 1)


@given(st.binary(min_size=1, max_size=1), st.binary(max_size=300))
def test_frame_is_read_as_it_was_written(kind: bytes, body: bytes) -> None:
    stream = io.BytesIO()
    write_frame(stream, kind, body)
    stream.seek(0)
    assert read_frame(stream) == (kind, body)
    assert read_frame(stream) is None


@given(st.binary(max_size=40), st.integers(0, 39))
def test_truncated_frame_is_an_error(body: bytes, cut: int) -> None:
    stream = io.BytesIO()
    write_frame(stream, b"S", body)
    whole = stream.getvalue()
    part = whole[: 1 + cut % (len(whole) - 1)]
    with pytest.raises(FrameError, match="the stream ends"):
        read_frame(io.BytesIO(part))


@pytest.mark.parametrize("length", [0, MAX_FRAME_BYTES + 1])
def test_length_outside_its_range_is_rejected(length: int) -> None:
    with pytest.raises(FrameError, match="not allowed: 1 to 268435456"):
        read_frame(io.BytesIO(struct.pack("<I", length)))


@given(INDEX, INDEX, INDEX, INDEX, st.text())
def test_hello_is_parsed(robots: int, threads: int, iterations: int, steps: int, mjcf: str) -> None:
    line = f"twinstep-mujoco 2 robots={robots} threads={threads} iterations={iterations} steps={steps}\n"
    assert parse_hello((line + mjcf).encode()) == Hello(robots, threads, iterations, steps, mjcf)


@pytest.mark.parametrize(
    "line", [b"twinstep-mujoco 1 robots=1", b"other 1", b"", b"twinstep-mujoco 2 robots=1", b"\xff\xff"]
)
def test_hello_of_another_program_is_rejected(line: bytes) -> None:
    with pytest.raises(FrameError, match="the first request"):
        parse_hello(line + b"\n<mujoco/>")


def numbers(dtype: np.dtype[np.void], rows: int, seed: int) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    values = np.random.default_rng(seed).normal(size=rows * dtype.itemsize // 4)
    return np.frombuffer(values.astype("<f4").tobytes(), dtype)


@given(st.lists(st.tuples(INDEX, st.text(max_size=20)), max_size=5), INDEX)
def test_reset_is_parsed(robots: list[tuple[int, str]], seed: int) -> None:
    resets = [Reset(robot, numbers(INITIAL_STATE, 1, seed), mjcf) for robot, mjcf in robots]
    parsed = parse_reset(reset_body(resets))
    assert [(reset.robot, reset.mjcf, reset.initial_state.tobytes()) for reset in parsed] == [
        (reset.robot, reset.mjcf, reset.initial_state.tobytes()) for reset in resets
    ]


@given(st.integers(1, 9), INDEX, INDEX)
def test_step_is_parsed(robots: int, periods: int, seed: int) -> None:
    active = np.random.default_rng(seed).random(robots) < 0.5
    step = Step(periods, active, numbers(COMMAND, robots, seed))
    parsed = parse_step(step_body(step), robots)
    assert parsed.periods == periods
    assert (parsed.active == active).all()
    assert parsed.commands.tobytes() == step.commands.tobytes()


def test_push_is_parsed() -> None:
    assert parse_push(b"\x03\0\0\0\0\0\0\x3f\0\0\x80\xbf\0\0\0\0") == Push(3, [0.5, -1.0, 0.0])


@given(st.binary(max_size=600), st.integers(1, 3))
def test_any_other_body_is_a_frame_error(body: bytes, robots: int) -> None:
    for parse in (parse_reset, lambda body: parse_step(body, robots), parse_push, parse_hello):
        try:
            parse(body)
        except FrameError:
            continue
        assert parse is parse_reset or len(body) == (16 if parse is parse_push else 4 + robots * 241)


def test_sizes_are_those_of_the_server() -> None:
    sizes = [dtype.itemsize // 4 for dtype in (INITIAL_STATE, COMMAND, MEASURED, GROUND_TRUTH)]
    assert sizes == [37, 60, 43, 14]
