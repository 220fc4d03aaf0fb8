"""Large messages through shared memory."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twinstep import EmbeddedServer, Go2VectorEnv

N = 1024


def segments(process: int | str) -> set[str]:
    """Return the segments of shared memory that a process has mapped."""
    lines = Path(f"/proc/{process}/maps").read_text().splitlines()
    return {line.split()[-1] for line in lines if "/dev/shm/" in line}


def rollout(envs: Go2VectorEnv) -> list[Any]:
    generator = np.random.default_rng(1)
    results: list[Any] = [envs.reset(seed=1)[0]]
    for _ in range(10):
        results.append(envs.step(generator.uniform(-1, 1, (N, 12)).astype(np.float32))[:4])
    return results


@pytest.fixture(scope="module")
def expected() -> list[Any]:
    envs = Go2VectorEnv(N)
    results = rollout(envs)
    envs.close()
    return results


@pytest.mark.parametrize("flags", [["--shared-memory"], []])
def test_steps_are_the_same_with_and_without_shared_memory(expected: list[Any], flags: list[str]) -> None:
    server = EmbeddedServer(("--task", "walk", *flags))
    over_tcp = Go2VectorEnv(N, endpoint=server.endpoint)
    np.testing.assert_equal(rollout(over_tcp), expected)
    assert not segments("self") & segments(server.pid), "a client without the option uses TCP"
    # Another session of the same process, with the same endpoint.
    shared = Go2VectorEnv(N, endpoint=server.endpoint, shared_memory=True)
    np.testing.assert_equal(rollout(shared), expected)
    assert bool(segments("self") & segments(server.pid)) == bool(flags)
    over_tcp.close()
    shared.close()
    server.release()


def test_the_bundled_server_uses_shared_memory_if_its_client_does(expected: list[Any]) -> None:
    envs = Go2VectorEnv(N, shared_memory=True)
    np.testing.assert_equal(rollout(envs), expected)
    server = envs._remote._connection._server
    assert server is not None
    assert segments("self") & segments(server.pid)
    envs.close()
