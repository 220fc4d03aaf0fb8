"""Connection to one server: discovery, requests with retries, reasons of timeouts."""

import math
import os
import secrets
import time
import uuid
from typing import Any, cast

import zenoh

from . import codec
from .errors import (
    AmbiguousRobotError,
    InvalidOptionError,
    LeaseLostError,
    NoServerError,
    RequestTimeoutError,
    ServerExitedError,
    VersionError,
    from_reply,
)
from .server import EmbeddedServer
from .session import SharedSession, check_process, connect_error, undeclare

_FIRST_BACKOFF_S, _MAX_BACKOFF_S = 0.002, 0.2
_RESTART_CONFIRMATION_S = 2.0
HELLO: dict[str, object] = {"client": "twinstep-python"}


class Pending:
    """A request in progress."""

    def __init__(self, querier: zenoh.Querier, payload: bytes, secret: bytes) -> None:
        self.querier = querier
        self.payload = payload
        self.secret = secret
        # None: not sent yet, or interrupted while it was sent.
        self.replies: Any = None

    def send(self) -> None:
        """Send the request, the first time or again with the same number, so that it is executed once."""
        check_process()
        try:
            self.replies = self.querier.get(payload=self.payload, attachment=self.secret)
        except zenoh.ZError as error:
            raise NoServerError(f"the Zenoh session is closed: {error}") from error


class Connection:
    """A connection to one server.

    Parameters
    ----------
    endpoint
        Zenoh endpoint of the server or of a router, such as ``tcp/127.0.0.1:7447``.
    robot
        Name of the robot. Required if several are visible.
    zenoh_config
        Zenoh configuration file (JSON5) for TLS, user and password.
    server
        The server at ``endpoint`` if this process started it.
    connect_timeout_s
        Timeout of opening the session, finding the server and its first reply together [s].
    """

    def __init__(
        self,
        endpoint: str,
        *,
        robot: str | None,
        zenoh_config: str | None,
        server: EmbeddedServer | None,
        connect_timeout_s: float,
    ) -> None:
        self.endpoint = endpoint
        self._server = server
        self._pid = os.getpid()
        since = time.monotonic()
        self._declared: list[zenoh.Querier | zenoh.LivelinessToken] = []
        self._session = self._open(zenoh_config, connect_timeout_s)
        try:
            self.server_id, self.name = self._find_server(robot, since, connect_timeout_s)
            self.client = uuid.uuid4().hex
            """Id of this client, of which the server knows by the liveliness token that it runs."""
            # Proves that a request comes from this client. It is in no key, reply or log.
            self._secret = secrets.token_bytes(16)
            self._max_request_bytes = math.inf
            self.hello = self._handshake(connect_timeout_s - (time.monotonic() - since))
            self._max_request_bytes = self.hello["max_request_bytes"]
            self._declared.append(self._session.declare_token(f"twinstep/live/client/{self.server_id}/{self.client}"))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Undeclare the token and the queriers, and leave the session to its other users."""
        # A forked child has the object, but not the threads of the session.
        if self._pid == os.getpid():
            undeclare(*self._declared)
            self._declared.clear()
            del self._session

    def querier(self, key: str) -> zenoh.Querier:
        """Declare a querier for ``twinstep/<server_id>/<key>``, until :meth:`close`."""
        querier = self._session.declare_querier(f"twinstep/{self.server_id}/{key}")
        self._declared.append(querier)
        return querier

    def request(
        self, querier: zenoh.Querier, message: dict[str, object], timeout_s: float, option: str
    ) -> dict[str, Any]:
        """Send a request and wait for the reply. The error of a timeout names the ``option`` that sets it."""
        pending = self.pending(querier, message)
        pending.send()
        return self.wait_reply(pending, timeout_s, option)

    def pending(self, querier: zenoh.Querier, message: dict[str, object]) -> Pending:
        """Return a request that is not sent yet."""
        payload = codec.encode(message)
        if len(payload) > self._max_request_bytes:
            raise InvalidOptionError(
                f"a request to `{querier.key_expr}` has {len(payload)} bytes; the server accepts at most "
                f"{self._max_request_bytes}\n  it hosts fewer environments"
            )
        return Pending(querier, payload, self._secret)

    def wait_reply(self, pending: Pending, timeout_s: float, option: str) -> dict[str, Any]:
        """Wait for the reply to a request, and repeat the request. May be called again after a timeout."""
        since, pause, replaced_since = time.monotonic(), _FIRST_BACKOFF_S, None
        while True:
            answer = outcome(pending)
            if isinstance(answer, dict):
                return answer
            if self._server is not None and not self._server.alive:
                raise ServerExitedError(self._server.exit_report())
            now = time.monotonic()
            # Only zero replies can be due to a restart. A query that times out has reached the server.
            replaced = answer is NoReply.NONE and self._server_restarted()
            replaced_since = (replaced_since or now) if replaced else None
            if replaced_since is not None and now - replaced_since >= _RESTART_CONFIRMATION_S:
                raise LeaseLostError(
                    f"the server at {self.endpoint} was restarted: the environments of this lease are lost\n"
                    "  create a new environment"
                )
            if now - since >= timeout_s:
                raise RequestTimeoutError(
                    f"no reply from {self.endpoint} to `{pending.querier.key_expr}` after {now - since:.1f} s "
                    f"(`{option}`): {self._timeout_reason(option)}"
                )
            time.sleep(pause)
            pause = min(2 * pause, _MAX_BACKOFF_S)
            pending.send()

    def _open(self, zenoh_config: str | None, timeout_s: float) -> SharedSession:
        try:
            return SharedSession.open(self.endpoint, zenoh_config, timeout_s)
        except NoServerError as error:
            if self._server is not None and not self._server.alive:
                raise ServerExitedError(self._server.exit_report()) from error
            raise

    def _handshake(self, timeout_s: float) -> dict[str, Any]:
        self._hello_querier = self.querier("hello")
        hello = self.request(self._hello_querier, HELLO, timeout_s, "connect_timeout_s")
        low, high = hello["protocols"]
        if not low <= codec.PROTOCOL <= high:
            raise VersionError(
                f"the server at {self.endpoint} ({hello['server_version']}) supports protocol {low} to {high}, this "
                f"client {codec.PROTOCOL}\n  install the same Twinstep at both ends"
            )
        return hello

    def _find_server(self, robot: str | None, since: float, timeout_s: float) -> tuple[str, str]:
        while True:
            visible = self._session.visible_servers()
            matching = [server for server in visible if robot in (None, server[1])]
            if len(matching) == 1:
                return matching[0]
            waited_s = time.monotonic() - since
            if waited_s < timeout_s:
                # The old token of a restarted server may be visible for a moment.
                time.sleep(0.05)
                continue
            if not visible and not self._session.connected:
                raise connect_error(self.endpoint, waited_s)
            if not visible:
                raise NoServerError(
                    f"connected to {self.endpoint}, but no server is visible there after {waited_s:.1f} s "
                    "(`connect_timeout_s`)\n"
                    "  either no server is running, or access control hides it from this user: read the server's log"
                )
            count = len(matching)
            found = f"{count} robots have the name `{robot}`" if robot else f"{count} robots are visible"
            names = ", ".join(f"{name} ({server_id})" for server_id, name in visible)
            raise AmbiguousRobotError(f"{found}; visible: {names}\n  set `robot` to the name of one of them")

    def _server_restarted(self) -> bool:
        visible = self._session.visible_servers()
        return all(server_id != self.server_id for server_id, _ in visible) and any(
            name == self.name for _, name in visible
        )

    def _timeout_reason(self, option: str) -> str:
        if not self._session.connected:
            return "the connection is lost and cannot be restored; check that the server or the router is running"
        if all(server_id != self.server_id for server_id, _ in self._session.visible_servers()):
            return "the connection works, but the server is no longer visible: it has terminated or lost its router"
        pending = self.pending(self._hello_querier, HELLO)
        pending.send()
        hello = outcome(pending)
        if isinstance(hello, dict):
            return (
                f"the server answers `hello`, but not this request: it is still in progress (increase `{option}`), or "
                "access control or a message size limit rejects it"
            )
        if hello is NoReply.TIMEOUT:
            return "the server is visible but unresponsive: it does not reply to requests"
        return "the server is visible, but queries get no reply: access control may deny queries to this user"


class NoReply:
    """Why a query got no reply."""

    NONE: "NoReply"
    TIMEOUT: "NoReply"
    BUSY: "NoReply"


NoReply.NONE, NoReply.TIMEOUT, NoReply.BUSY = NoReply(), NoReply(), NoReply()


def outcome(pending: Pending) -> dict[str, Any] | NoReply:
    """Return the reply to one query, or why there is none. Raises error replies of the server."""
    if pending.replies is None:
        return NoReply.TIMEOUT
    for reply in pending.replies:
        if reply.ok is not None:
            return codec.decode(reply.ok.payload.to_bytes())
        payload = cast(bytes, reply.err.payload.to_bytes())
        # Errors of Zenoh, such as its timeout, are plain text; a map starts with 0x80 to 0x8f, 0xde or 0xdf.
        if not payload or not (0x80 <= payload[0] <= 0x8F or payload[0] in (0xDE, 0xDF)):
            return NoReply.TIMEOUT
        error = codec.decode(payload)
        if error.get("retryable"):
            return NoReply.BUSY
        raise from_reply(error["code"], error["field"], error["message"], error["hint"])
    return NoReply.NONE
