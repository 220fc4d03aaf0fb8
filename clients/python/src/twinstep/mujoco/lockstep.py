"""Requests in, replies out: the robots of one process, stepped together."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import BinaryIO

import numpy as np

from ..errors import Error
from .frames import (
    FrameError,
    Hello,
    Push,
    Reset,
    Step,
    greeting,
    parse_hello,
    parse_push,
    parse_reset,
    parse_step,
    read_frame,
    write_frame,
)
from .robot import Command, Compiler, Robot


class ModelError(Error):
    """MuJoCo rejects a model."""


class Robots:
    """All robots of this process.

    Parameters
    ----------
    hello
        The number of robots and the settings of all.
    """

    def __init__(self, hello: Hello) -> None:
        self._compiler = Compiler(hello.iterations)
        self._nominal = self._compile(hello.mjcf)
        layout = hello.layout
        try:
            robots = range(hello.robots)
            self._robots = [Robot(self._compiler, self._nominal, layout, hello.base) for _ in robots]
        except ValueError as error:
            raise ModelError(str(error)) from error
        self._steps = hello.steps
        self._measured, self._truth = np.zeros(hello.robots, layout.measured), np.zeros(hello.robots, layout.truth)
        threads = min(hello.threads or os.cpu_count() or 1, hello.robots)
        # `mj_step` releases the lock of the interpreter.
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._threads = threads

    def reset(self, resets: list[Reset]) -> bytes:
        """Reset robots and return their readings."""
        robots = [reset.robot for reset in resets]
        for reset in resets:
            self._check_index(reset.robot)
            model = self._compile(reset.mjcf) if reset.mjcf else self._nominal
            self._robots[reset.robot].reset(model, reset.initial_state)
            self._read(reset.robot)
        return self._readings(np.array(robots, np.intp))

    def push(self, push: Push) -> bytes:
        """Push one robot and return its readings."""
        self._check_index(push.robot)
        self._robots[push.robot].push(push.velocity)
        self._read(push.robot)
        return self._readings(np.array([push.robot], np.intp))

    def step(self, step: Step) -> bytes:
        """Advance the active robots and return the readings of all."""
        commands = Command.of_all(step.commands)
        active = [int(robot) for robot in np.flatnonzero(step.active)]

        def advance(robots: list[int]) -> None:
            for robot in robots:
                self._robots[robot].advance(commands[robot], step.periods, self._steps)
                self._read(robot)

        if self._pool is None:
            advance(active)
        else:
            # `list` raises the error of a thread.
            list(self._pool.map(advance, [active[first :: self._threads] for first in range(self._threads)]))
        return self._readings(np.arange(len(self._robots)))

    def _check_index(self, robot: int) -> None:
        if robot >= len(self._robots):
            raise FrameError(f"robot {robot} does not exist; there are {len(self._robots)}")

    def _compile(self, mjcf: str) -> object:
        try:
            return self._compiler.compile(mjcf)
        except ValueError as error:
            raise ModelError(f"MuJoCo rejects the model of a robot: {error}") from error

    def _read(self, robot: int) -> None:
        self._robots[robot].read(self._measured[robot : robot + 1], self._truth[robot : robot + 1])

    def _readings(self, robots: np.ndarray[tuple[int], np.dtype[np.intp]]) -> bytes:
        return self._measured[robots].tobytes() + self._truth[robots].tobytes()


def serve(requests: BinaryIO, replies: BinaryIO) -> None:
    """Answer requests until the stream closes. The reply to a request with an error is its text."""
    try:
        first = read_frame(requests)
        if first is None:
            return
        if first[0] != b"H":
            raise FrameError(f"the first request is {first[0]!r}, not b'H'")
        robots, hello = _greet(first[1], replies)
        while (frame := read_frame(requests)) is not None:
            match frame[0]:
                case b"R":
                    reply = robots.reset(parse_reset(frame[1], hello.layout))
                case b"P":
                    reply = robots.push(parse_push(frame[1]))
                case b"S":
                    reply = robots.step(parse_step(frame[1], hello.robots, hello.layout))
                case kind:
                    raise FrameError(f"{kind!r} is not a request")
            write_frame(replies, b"D", reply)
    except Error as error:
        write_frame(replies, b"E", str(error).encode())


def _greet(body: bytes, replies: BinaryIO) -> tuple[Robots, Hello]:
    hello = parse_hello(body)
    try:
        robots, version = Robots(hello), Compiler(1).mujoco.__version__
    except ImportError as error:
        raise Error(f"the Python package `mujoco` is missing: {error}") from error
    write_frame(replies, b"H", greeting(version))
    return robots, hello
