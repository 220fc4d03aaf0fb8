"""Endpoints of this machine for tests."""

import socket


def free_endpoint() -> str:
    """Return a Zenoh endpoint at a port that no program uses."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"
