"""Endpoints, routers and faults of this machine for tests."""

import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import zenoh

from twinstep import ServerInfo, discover


def free_endpoint() -> str:
    """Return a Zenoh endpoint at a port that no program uses."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


@contextmanager
def router() -> Iterator[str]:
    """Run a Zenoh router in this process; return its endpoint."""
    config, endpoint = zenoh.Config(), free_endpoint()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["{endpoint}"]'),
        ("scouting/multicast/enabled", "false"),
        ("transport/link/tx/lease", "2000"),
    ):
        config.insert_json5(key, value)
    with zenoh.open(config):
        yield endpoint


def wait_for_servers(endpoint: str, count: int) -> list[ServerInfo]:
    """Return the servers behind a router when it knows ``count`` of them, some time after they have started."""
    deadline = time.monotonic() + 20
    while True:
        found = discover(endpoint)
        if len(found) == count and all(info.reachable for info in found):
            return found
        assert time.monotonic() < deadline, f"{len(found)} servers are visible, {count} are expected"
        time.sleep(0.02)


def suspend(pid: int) -> None:
    """Suspend a process and return when all its threads have stopped, which takes a while on a busy machine."""
    os.kill(pid, signal.SIGSTOP)
    threads = [Path(f"/proc/{pid}/task/{thread}/stat") for thread in os.listdir(f"/proc/{pid}/task")]
    while any(stat.read_text().rsplit(") ")[1][0] != "T" for stat in threads):
        time.sleep(0.001)
