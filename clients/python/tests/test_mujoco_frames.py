"""Frames between a server and ``python -m twinstep.mujoco``."""

import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twinstep.mujoco.frames import (
    MAX_FRAME_BYTES,
    FrameError,
    Hello,
    Layout,
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
NAMES = st.lists(st.text("ab c_0", min_size=1), max_size=4).map(tuple)
QUADRUPED = Layout(tuple(f"joint{i}" for i in range(12)), tuple(f"geom{i}" for i in range(9)))


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


@given(INDEX, INDEX, INDEX, NAMES, NAMES, st.text())
def test_hello_is_parsed(
    robots: int, iterations: int, base: int, joints: tuple[str, ...], geoms: tuple[str, ...], mjcf: str
) -> None:
    line = f"twinstep-mujoco 3 robots={robots} threads=2 iterations={iterations} steps=5 base={base}"
    names = "\t".join(joints) + "\n" + "\t".join(geoms)
    hello = Hello(robots, 2, iterations, 5, base, Layout(joints, geoms), mjcf)
    assert parse_hello(f"{line}\n{names}\n{mjcf}".encode()) == hello


@pytest.mark.parametrize(
    "line", [b"twinstep-mujoco 2 robots=1", b"other 1", b"", b"twinstep-mujoco 3 robots=1", b"\xff\xff"]
)
def test_hello_of_another_program_is_rejected(line: bytes) -> None:
    with pytest.raises(FrameError, match="the first request"):
        parse_hello(line + b"\na\nb\n<mujoco/>")


def numbers(dtype: np.dtype[np.void], rows: int, seed: int) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    values = np.random.default_rng(seed).normal(size=rows * dtype.itemsize // 4)
    return np.frombuffer(values.astype("<f4").tobytes(), dtype)


@given(st.lists(st.tuples(INDEX, st.text(max_size=20)), max_size=5), INDEX)
def test_reset_is_parsed(robots: list[tuple[int, str]], seed: int) -> None:
    resets = [Reset(robot, numbers(QUADRUPED.initial_state, 1, seed), mjcf) for robot, mjcf in robots]
    parsed = parse_reset(reset_body(resets), QUADRUPED)
    assert [(reset.robot, reset.mjcf, reset.initial_state.tobytes()) for reset in parsed] == [
        (reset.robot, reset.mjcf, reset.initial_state.tobytes()) for reset in resets
    ]


@given(st.integers(1, 9), INDEX, INDEX)
def test_step_is_parsed(robots: int, periods: int, seed: int) -> None:
    active = np.random.default_rng(seed).random(robots) < 0.5
    step = Step(periods, active, numbers(QUADRUPED.command, robots, seed))
    parsed = parse_step(step_body(step), robots, QUADRUPED)
    assert parsed.periods == periods
    assert (parsed.active == active).all()
    assert parsed.commands.tobytes() == step.commands.tobytes()


def test_push_is_parsed() -> None:
    assert parse_push(b"\x03\0\0\0\0\0\0\x3f\0\0\x80\xbf\0\0\0\0") == Push(3, [0.5, -1.0, 0.0])


@given(st.binary(max_size=600), st.integers(1, 3))
def test_any_other_body_is_a_frame_error(body: bytes, robots: int) -> None:
    def reset(body: bytes) -> object:
        return parse_reset(body, QUADRUPED)

    for parse in (reset, lambda body: parse_step(body, robots, QUADRUPED), parse_push, parse_hello):
        try:
            parse(body)
        except FrameError:
            continue
        assert parse is reset or len(body) == (16 if parse is parse_push else 4 + robots * 241)


def test_sizes_are_those_of_the_server() -> None:
    rows = (QUADRUPED.initial_state, QUADRUPED.command, QUADRUPED.measured, QUADRUPED.truth)
    assert [row.itemsize // 4 for row in rows] == [37, 60, 43, 18]
