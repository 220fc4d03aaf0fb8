"""Zenoh sessions, one per endpoint and configuration, which all environments of this process share."""

import _thread
import contextlib
import json
import os
import socket
import threading
import time
import weakref
from pathlib import Path
from typing import Any, ClassVar, cast

import zenoh

from .errors import Error, ForkedProcessError, InvalidOptionError, NoServerError

QUERY_TIMEOUT_S = 1.0
"""Timeout of one query, after which it is repeated.

A step may take longer, because a repeat waits for the request in progress. The timeout is short, because Zenoh keeps
state for each query this long.
"""

_MAX_CONNECT_TIMEOUT_S = 1e9

_CLOSE_TIMEOUT_S = 1.0
"""Zenoh tries for 10 s to close a link to a server that does not read. The rest of this happens in a thread."""
_LIVE_SERVERS = "twinstep/live/server/*/*"

_Key = tuple[str, str | None, bool]


class SharedSession:
    """A session that is closed when the last of its users has dropped it.

    Python counts the users: each keeps a reference. A lock would not do, because the garbage collector may drop a user
    while the same thread holds it.

    Parameters
    ----------
    session
        The open session.
    """

    _lock = threading.Lock()
    _open: ClassVar["weakref.WeakValueDictionary[_Key, SharedSession]"] = weakref.WeakValueDictionary()
    _opening: ClassVar["weakref.WeakValueDictionary[_Key, Any]"] = weakref.WeakValueDictionary()
    """A lock for each session that a thread opens."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        # Runs when the last user has dropped its reference, or at the end of the interpreter.
        weakref.finalize(self, _close, session, os.getpid())

    @classmethod
    def open(
        cls, endpoint: str, zenoh_config: str | None, timeout_s: float, *, shared_memory: bool = False
    ) -> "SharedSession":
        """Return the session with this endpoint, configuration file and use of shared memory.

        Opens one if there is none.
        """
        check_process()
        since = time.monotonic()
        key = (endpoint, _content(zenoh_config), shared_memory)
        with cls._lock:
            opening = cls._opening.setdefault(key, threading.Lock())
        if not opening.acquire(timeout=min(timeout_s, threading.TIMEOUT_MAX)):
            # Another thread has tried to connect for this long.
            raise connect_error(endpoint, timeout_s)
        try:
            shared = cls._open.get(key)
            if shared is None or shared._session.is_closed():
                config = _zenoh_config(endpoint, zenoh_config, timeout_s - (time.monotonic() - since), shared_memory)
                shared = cls(_open_session(config, endpoint, since))
                cls._open[key] = shared
            return shared
        finally:
            opening.release()

    @property
    def connected(self) -> bool:
        """True while there is a link. Zenoh restores a lost link by itself."""
        info = self._session.info
        return bool(info.routers_zid() or info.peers_zid())

    def visible_servers(self) -> list[tuple[str, str]]:
        """Return the server id and the robot name of every visible server."""
        replies = self._session.liveliness().get(_LIVE_SERVERS, timeout=QUERY_TIMEOUT_S)
        keys = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        return sorted((key.split("/")[3], key.split("/")[4]) for key in keys)

    def declare_token(self, key: str) -> zenoh.LivelinessToken:
        """Declare a liveliness token."""
        return self._session.liveliness().declare_token(key)

    def declare_key(self, key: str) -> zenoh.KeyExpr:
        """Declare the key of frequent requests, whose route routers and servers then remember."""
        return cast(zenoh.KeyExpr, self._session.declare_keyexpr(key))

    def undeclare_key(self, key: zenoh.KeyExpr) -> None:
        """Undeclare a key. The session may be closed."""
        with contextlib.suppress(zenoh.ZError):
            self._session.undeclare(key)

    def get(self, key: str | zenoh.KeyExpr, payload: bytes, secret: bytes) -> Any:
        """Send one query with the settings of ``protocol/SPEC.md``, and return the channel of its replies."""
        return self._session.get(
            key,
            payload=payload,
            attachment=secret,
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
            timeout=QUERY_TIMEOUT_S,
        )


def undeclare(token: zenoh.LivelinessToken) -> None:
    """Undeclare a token. The session may be closed."""
    with contextlib.suppress(zenoh.ZError):
        token.undeclare()


class _ZenohProcess:
    """The process in which the threads of Zenoh run. A forked process has none, and Zenoh would wait for them."""

    pid: int | None = None


def check_process() -> None:
    """Raise a ``ForkedProcessError`` in a process that was forked from one with a session."""
    if _ZenohProcess.pid not in (None, os.getpid()):
        raise ForkedProcessError(
            "this process was forked from one with a Twinstep environment, and Zenoh does not work in it\n"
            "  start processes with `spawn`: multiprocessing.get_context('spawn'), or with Gymnasium\n"
            "  make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'})\n"
            "  a spawned process has not imported twinstep: its environments are made with the prefix of the package,\n"
            "  gymnasium.make('twinstep:twinstep/Go2-Walk-v0')"
        )


def connect_error(endpoint: str, waited_s: float) -> Error:
    """Return the error of a client that could not connect; it depends on whether the port is open."""
    if (problem := _address_problem(endpoint)) is not None:
        reason = problem
    elif _port_open(endpoint):
        reason = (
            "a program accepts connections there: either it is not a Twinstep server, or it rejects this client's "
            "user, password or certificate; read the server's log"
        )
    else:
        reason = "no program accepts connections there\n  start a server with `twinstep serve`, or omit `endpoint`"
    return NoServerError(f"no server answers at {endpoint} after {waited_s:.1f} s (`connect_timeout_s`): {reason}")


def _close(session: zenoh.Session, pid: int) -> None:
    # A forked child has the object, but not the threads of the session.
    if pid != os.getpid():
        return
    closed = _thread.allocate_lock()
    closed.acquire()
    try:
        # Without locks of `threading`, which the thread that the garbage collector interrupts may hold.
        _thread.start_new_thread(_close_session, (session, closed))
    except RuntimeError:
        # The interpreter starts no threads at its end.
        _close_session(session, closed)
    closed.acquire(timeout=_CLOSE_TIMEOUT_S)


def _close_session(session: zenoh.Session, closed: _thread.LockType) -> None:
    # Zenoh raises an error after 10 s. There is nothing more to release.
    with contextlib.suppress(zenoh.ZError):
        session.close()
    closed.release()


def _open_session(config: zenoh.Config, endpoint: str, since: float) -> zenoh.Session:
    _ZenohProcess.pid = os.getpid()
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise connect_error(endpoint, time.monotonic() - since) from error


def _address_problem(endpoint: str) -> str | None:
    """Return what is wrong with the address of an endpoint, if anything."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    if protocol.startswith("unixsock"):
        return None
    if not host or not port.isdigit():
        return "the endpoint has no port: tcp/HOST:PORT, such as tcp/127.0.0.1:7447"
    try:
        socket.getaddrinfo(host.strip("[]"), int(port))
    except (OSError, OverflowError):
        return "the name of the host is unknown: check its spelling, or use its address"
    return None


def _port_open(endpoint: str) -> bool:
    protocol, _, address = endpoint.partition("/")
    address = address.partition("?")[0].partition("#")[0]
    host, _, port = address.rpartition(":")
    try:
        if protocol == "unixsock-stream":
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(address)
            return True
        socket.create_connection((host.strip("[]"), int(port)), timeout=1.0).close()
    except (OSError, ValueError):
        return False
    return True


def _content(path: str | None) -> str | None:
    """Return the text of a configuration file: after a change of the file there is another session."""
    if path is None:
        return None
    if not Path(path).is_file():
        raise InvalidOptionError(f"`zenoh_config` = {path}: the file does not exist")
    try:
        return Path(path).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidOptionError(f"`zenoh_config` = {path} cannot be read: {error}") from error


def _zenoh_config(endpoint: str, path: str | None, timeout_s: float, shared_memory: bool) -> zenoh.Config:
    try:
        config = zenoh.Config() if path is None else zenoh.Config.from_file(path)
        for key, value in (
            ("mode", '"client"'),
            ("connect/endpoints", json.dumps([endpoint])),
            # Zenoh repeats failed attempts until this timeout.
            ("connect/timeout_ms", str(max(1, round(1000 * min(timeout_s, _MAX_CONNECT_TIMEOUT_S))))),
            ("connect/retry", "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2}"),
            ("scouting/multicast/enabled", "false"),
            ("transport/link/tx/lease", "2000"),
            # A step of 4096 robots is sent in twelve fragments; Zenoh's default queue of two delays them.
            ("transport/link/tx/queue/size/data", "16"),
            ("transport/link/rx/buffer_size", "2097152"),
            ("transport/shared_memory/enabled", json.dumps(shared_memory)),
        ):
            config.insert_json5(key, value)
    except zenoh.ZError as error:
        option = f"`zenoh_config` = {path}" if path else f"`endpoint` = {endpoint}"
        raise InvalidOptionError(f"Zenoh rejects {option}: {error}") from error
    return config
