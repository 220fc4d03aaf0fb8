"""Step counters and check every observation, while other processes are killed, suspended and delayed.

``target/release/faults --faults 1000 --client target/python/bin/python clients/python/tests/fault_client.py``

Prints ``lease ID EPOCH`` for each lease, ``acked`` with the counters of each step, ``waiting`` and ``lost`` with the
exception, and ``violation`` with the observed and the expected values.
"""

import os
import struct
import sys
import threading

import numpy as np

import twinstep

NUM_ENVS = 2


class Counter:
    """Expected state of the task ``counter``."""

    def __init__(self) -> None:
        self.steps, self.resets, self.mix = 0, 1, 0

    def step(self, action: np.ndarray) -> None:
        self.steps += 1
        for bits in struct.unpack("<12I", action.astype("<f4").tobytes()):
            mixed = ((self.mix ^ bits) * 0x01000193) & 0xFFFFFFFF
            self.mix = ((mixed << 5) | (mixed >> 27)) & 0xFFFFFFFF

    @property
    def observation(self) -> list[float]:
        return [self.steps & 0xFFFFFF, self.resets, self.mix >> 16, self.mix & 0xFFFF]


def report(*words: object) -> None:
    print(*(str(word).replace("\n", " ") for word in words), flush=True)


def step_until_lost(envs: twinstep.Go2VectorEnv, random: np.random.Generator) -> None:
    counters = [Counter() for _ in range(NUM_ENVS)]
    while True:
        actions = random.random((NUM_ENVS, 12), dtype=np.float32)
        envs.send(actions)
        while True:
            try:
                obs = envs.recv()[0]
                break
            except twinstep.RequestTimeoutError as error:
                report("waiting", error)
        for counter, action in zip(counters, actions, strict=True):
            counter.step(action)
        expected = [counter.observation for counter in counters]
        if obs[:, :4].tolist() != expected:
            report("violation", obs[:, :4].tolist(), "is not", expected)
            return
        report("acked", *(number for each in counters for number in (each.steps, each.resets, each.mix)))


def main(endpoint: str) -> None:
    random = np.random.default_rng(1)
    while True:
        try:
            envs = twinstep.Go2VectorEnv(NUM_ENVS, task="counter", endpoint=endpoint, timeout_s=2.0)
        except twinstep.Error as error:
            report("lost", type(error).__name__, error)
            continue
        try:
            envs.reset()
            report("lease", envs.lease, 1)
            step_until_lost(envs, random)
        except twinstep.Error as error:
            report("lost", type(error).__name__, error)
        envs.close()


def end_with_parent() -> None:
    while sys.stdin.buffer.read(64):
        pass
    os._exit(0)


if __name__ == "__main__":
    threading.Thread(target=end_with_parent, daemon=True).start()
    main(sys.argv[1])
