"""Servers that are visible at an endpoint, and the choice of one."""

import contextlib
import time
from dataclasses import dataclass
from typing import Any

from . import codec
from .codec import Spec
from .errors import AmbiguousRobotError, Error, InvalidOptionError, NoServerError
from .query import HELLO, Pending, outcome
from .session import SharedSession, connect_error

_GONE_S = 1.0
"""Time without a reply after which a visible server counts as gone. A router needs a moment to find the way to it."""

_POLL_PERIOD_S = 0.05
"""Pause between two queries for the visible servers."""


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
    found = _infos(session, endpoint, session.visible_servers(), timeout_s)
    return sorted(found, key=lambda info: (info.robot, info.server_id))


def choose_server(
    session: SharedSession,
    endpoint: str,
    robot: str | None,
    server_id: str | None,
    *,
    since: float,
    timeout_s: float,
) -> tuple[str, str]:
    """Return the id and the robot of the server to connect to.

    Among several servers with the same robot, task and spec hash it is the one with the most free environments.

    Parameters
    ----------
    session
        Session with the endpoint.
    endpoint
        Endpoint, for the errors.
    robot
        Name of the robot. ``None``: any.
    server_id
        Id of the server. ``None``: any.
    since
        Start of connecting, on the clock of ``time.monotonic`` [s].
    timeout_s
        Timeout of connecting [s].
    """
    while True:
        visible = session.visible_servers()
        matching = [one for one in visible if server_id in (None, one[0]) and robot in (None, one[1])]
        if len(matching) == 1:
            return matching[0]
        left_s = since + timeout_s - time.monotonic()
        servers = _infos(session, endpoint, matching, min(_GONE_S, left_s))
        waited_s = time.monotonic() - since
        if waited_s >= min(_GONE_S, timeout_s):
            servers = [server for server in servers if server.reachable]
        chosen = _most_free(servers)
        if chosen is not None:
            return chosen.server_id, chosen.robot
        if waited_s >= timeout_s:
            raise _no_choice(session, endpoint, robot, visible, waited_s)
        # The token of a server that starts or has ended may be visible a moment later or longer.
        time.sleep(_POLL_PERIOD_S)


def _most_free(servers: list[ServerInfo]) -> ServerInfo | None:
    """Return the server with the most free environments.

    Returns ``None`` if they differ in robot, task or spec, or one has not answered.
    """
    kinds = {(server.robot, server.spec.task, server.spec.hash) if server.spec else None for server in servers}
    if len(kinds) != 1 or None in kinds:
        return None
    return max(servers, key=lambda server: server.free_envs or 0)


def _no_choice(
    session: SharedSession,
    endpoint: str,
    robot: str | None,
    visible: list[tuple[str, str]],
    waited_s: float,
) -> Error:
    if not visible and not session.connected:
        return connect_error(endpoint, waited_s)
    if not visible:
        return NoServerError(
            f"connected to {endpoint}, but no server is visible there after {waited_s:.1f} s "
            "(`connect_timeout_s`)\n"
            "  either no server is running, or access control hides it from this user: read the server's log"
        )
    count = sum(robot in (None, name) for _, name in visible)
    if robot is None:
        found = f"{count} robots are visible, and `robot` is not set"
    elif count == 0:
        found = f"0 robots have the name `{robot}`"
    else:
        found = f"{count} robots have the name `{robot}`, and differ in task or layout or do not reply"
    names = ", ".join(f"{name} ({server_id})" for server_id, name in visible)
    return AmbiguousRobotError(f"{found}; visible: {names}\n  set `robot` to the name of one of them")


def _infos(session: SharedSession, endpoint: str, servers: list[tuple[str, str]], timeout_s: float) -> list[ServerInfo]:
    hellos = _hellos(session, [server_id for server_id, _ in servers], timeout_s)
    return [_info(endpoint, server_id, robot, hellos.get(server_id)) for server_id, robot in servers]


def _hellos(session: SharedSession, server_ids: list[str], timeout_s: float) -> dict[str, dict[str, Any]]:
    """Return the reply of each server that answers in time. All are queried at once."""
    hello = codec.encode(HELLO)
    waiting = {each: Pending(session, f"twinstep/{each}/hello", hello, b"") for each in server_ids}
    found: dict[str, dict[str, Any]] = {}
    deadline = time.monotonic() + timeout_s
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
