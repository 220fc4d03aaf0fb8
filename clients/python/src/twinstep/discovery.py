"""Servers that are visible at an endpoint, with their tasks and free environments."""

import contextlib
import time
from dataclasses import dataclass
from typing import Any

from . import codec
from .codec import Spec
from .connection import HELLO, Pending, outcome
from .errors import Error, InvalidOptionError
from .session import SharedSession, undeclare


@dataclass(frozen=True)
class ServerInfo:
    """A server that is visible at an endpoint. Every field but the first four is ``None`` if it is not reachable.

    Attributes
    ----------
    endpoint
        Endpoint of the server or of the router through which it is visible.
    server_id
        Id of the server, new at every start.
    robot
        Name of the robot, for the option ``robot``.
    reachable
        True if the server has answered in time with a reply that this client can read. It may be suspended or
        disconnected, or access control may deny requests to this user.
    protocols
        Lowest and highest protocol version that the server supports.
    server_version
        Program and version.
    spec
        Task, layouts and periods; ``spec.task`` is the value for the option ``task``.
    max_envs, free_envs, max_envs_per_client
        Number of environments that the server hosts, that are not leased, and that one client may lease.
    env_steps
        Environment steps executed since the start of the server. Two calls give the load in steps per second.
    """

    endpoint: str
    server_id: str
    robot: str
    reachable: bool
    protocols: tuple[int, int] | None = None
    server_version: str | None = None
    spec: Spec | None = None
    max_envs: int | None = None
    free_envs: int | None = None
    max_envs_per_client: int | None = None
    env_steps: int | None = None


def discover(
    endpoint: str, *, zenoh_config: str | None = None, timeout_s: float = 2.0, connect_timeout_s: float = 5.0
) -> list[ServerInfo]:
    """Return the servers that are visible at an endpoint, sorted by the name of their robot.

    Parameters
    ----------
    endpoint
        Zenoh endpoint of a server, a robot or a router.
    zenoh_config
        Zenoh configuration file (JSON5) for TLS, user and password.
    timeout_s
        Timeout of the replies of all servers together [s].
    connect_timeout_s
        Timeout of connecting to the endpoint [s].

    Raises
    ------
    NoServerError
        No connection to the endpoint is possible. A router without servers is not an error: the list is empty.
    """
    for option, value in (("timeout_s", timeout_s), ("connect_timeout_s", connect_timeout_s)):
        if not value > 0:
            raise InvalidOptionError(f"`{option}` = {value} s; must be greater than 0")
    session = SharedSession.open(endpoint, zenoh_config, connect_timeout_s)
    visible = session.visible_servers()
    hellos = _hellos(session, [server_id for server_id, _ in visible], timeout_s)
    found = (_info(endpoint, server_id, robot, hellos.get(server_id)) for server_id, robot in visible)
    return sorted(found, key=lambda info: (info.robot, info.server_id))


def _hellos(session: SharedSession, server_ids: list[str], timeout_s: float) -> dict[str, dict[str, Any]]:
    """Return the reply of each server that answers in time. All are queried at once."""
    queriers = {server_id: session.declare_querier(f"twinstep/{server_id}/hello") for server_id in server_ids}
    waiting = {server_id: Pending(querier, codec.encode(HELLO), b"") for server_id, querier in queriers.items()}
    found: dict[str, dict[str, Any]] = {}
    deadline = time.monotonic() + timeout_s
    try:
        while waiting and time.monotonic() < deadline:
            for pending in waiting.values():
                pending.send()
            for server_id, pending in list(waiting.items()):
                # An error reply is not a hello: this server stays unreachable.
                with contextlib.suppress(Error):
                    reply = outcome(pending)
                    if not isinstance(reply, dict):
                        continue
                    found[server_id] = reply
                del waiting[server_id]
            time.sleep(0.02 if waiting else 0)
    finally:
        undeclare(*queriers.values())
    return found


def _info(endpoint: str, server_id: str, robot: str, hello: dict[str, Any] | None) -> ServerInfo:
    unreachable = ServerInfo(endpoint, server_id, robot, reachable=False)
    if hello is None:
        return unreachable
    try:
        low, high = hello["protocols"]
        counts = {name: int(hello[name]) for name in ("max_envs", "free_envs", "max_envs_per_client", "env_steps")}
        return ServerInfo(
            endpoint,
            server_id,
            robot,
            reachable=True,
            protocols=(int(low), int(high)),
            server_version=str(hello["server_version"]),
            spec=codec.read_spec(hello, hello["spec_hash"]),
            **counts,
        )
    except (KeyError, TypeError, ValueError, codec.MalformedError):
        return unreachable
