"""Connection to one server: requests with retries, reasons of timeouts."""

import math
import os
import secrets
import sys
import time
import uuid
from typing import Any

import zenoh

from . import codec
from .discovery import choose_server
from .errors import (
    InvalidOptionError,
    LeaseLostError,
    NoServerError,
    RequestTimeoutError,
    ServerExitedError,
    VersionError,
    from_reply,
)
from .query import HELLO, NoReply, Pending, Waiting, outcome
from .server import EmbeddedServer
from .session import SharedSession, undeclare

_FIRST_BACKOFF_S, _MAX_BACKOFF_S = 0.002, 0.2
_RESTART_CONFIRMATION_S = 2.0


class Connection:
    """A connection to one server.

    Parameters
    ----------
    endpoint
        Zenoh endpoint of the server or of a router, such as ``tcp/127.0.0.1:7447``.
    robot
        Name of the robot. Required if servers of several names or specs are visible.
    zenoh_config
        Zenoh configuration file (JSON5) for TLS, user and password.
    server
        The server at ``endpoint`` if this process started it.
    connect_timeout_s
        Timeout of opening the session, finding the server and its first reply together [s].
    server_id
        Id of the server. ``None``: any.
    shared_memory
        Sends large messages through shared memory.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        robot: str | None,
        zenoh_config: str | None,
        server: EmbeddedServer | None,
        connect_timeout_s: float,
        server_id: str | None = None,
        shared_memory: bool = False,
    ) -> None:
        self.endpoint = endpoint
        self._server = server
        self._pid = os.getpid()
        since = time.monotonic()
        self._token: zenoh.LivelinessToken | None = None
        self._declared: tuple[str, zenoh.KeyExpr] | None = None
        self._session = self._open(zenoh_config, shared_memory, connect_timeout_s)
        try:
            chosen = choose_server(self._session, endpoint, robot, server_id, since=since, timeout_s=connect_timeout_s)
            self.server_id, self.name = chosen
            self.client = uuid.uuid4().hex
            """Id of this client, of which the server knows by the liveliness token that it runs."""
            # Proves that a request comes from this client. It is in no key, reply or log.
            self._secret = secrets.token_bytes(16)
            self._max_request_bytes = math.inf
            self.hello = self._handshake(connect_timeout_s - (time.monotonic() - since))
            self._max_request_bytes = self.hello["max_request_bytes"]
            self._token = self._session.declare_token(f"twinstep/live/client/{self.server_id}/{self.client}")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Undeclare token and key, and leave the session to its other users."""
        # A forked child has the object, but not the threads of the session.
        if self._pid == os.getpid():
            if self._token is not None:
                undeclare(self._token)
                self._token = None
            if self._declared is not None:
                self._session.undeclare_key(self._declared[1])
                self._declared = None
            del self._session

    def declare(self, key: str) -> None:
        """Declare the key of frequent requests.

        Not a querier: routers and servers keep the key of a querier for ever if the client is lost
        (https://github.com/eclipse-zenoh/zenoh/issues/1518).
        """
        self._declared = (key, self._session.declare_key(f"twinstep/{self.server_id}/{key}"))

    def request(self, key: str, message: dict[str, object], timeout_s: float, option: str) -> dict[str, Any]:
        """Send a request and wait for the reply. The error of a timeout names the ``option`` that sets it."""
        pending = self.pending(key, message)
        pending.send()
        return self.wait_reply(pending, timeout_s, option)

    def pending(self, key: str, message: dict[str, object]) -> Pending:
        """Return a request to ``twinstep/<server_id>/<key>`` that is not sent yet."""
        payload, full_key = codec.encode(message), f"twinstep/{self.server_id}/{key}"
        if len(payload) > self._max_request_bytes:
            raise InvalidOptionError(
                f"a request to `{full_key}` has {len(payload)} bytes; the server accepts at most "
                f"{self._max_request_bytes}\n  it hosts fewer environments"
            )
        declared = self._declared[1] if self._declared is not None and self._declared[0] == key else full_key
        return Pending(self._session, declared, payload, self._secret)

    def wait_reply(
        self, pending: Pending, timeout_s: float, option: str, *, until_ready: bool = True
    ) -> dict[str, Any]:
        """Wait for the reply to a request, and repeat the request. May be called again after a timeout.

        While a robot is not ready, it waits without a limit, or raises if ``until_ready`` is false.
        """
        since, pause, replaced_since = time.monotonic(), _FIRST_BACKOFF_S, None
        reason = ""
        while True:
            answer = outcome(pending)
            if isinstance(answer, dict):
                return answer
            if self._server is not None and not self._server.alive:
                raise ServerExitedError(self._server.exit_report())
            now = time.monotonic()
            if isinstance(answer, Waiting):
                if not until_ready:
                    raise from_reply("waiting", "", answer.reason, "")
                # The robot waits for its operator, who may take any time.
                since = now
                if answer.reason != reason:
                    reason = answer.reason
                    print(f"{self.name}: {reason}", file=sys.stderr, flush=True)
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
                    f"no reply from {self.endpoint} to `{pending.key}` after {now - since:.1f} s "
                    f"(`{option}`): {self._timeout_reason(option)}"
                )
            time.sleep(pause)
            pause = min(2 * pause, _MAX_BACKOFF_S)
            pending.send()

    def _open(self, zenoh_config: str | None, shared_memory: bool, timeout_s: float) -> SharedSession:
        try:
            return SharedSession.open(self.endpoint, zenoh_config, timeout_s, shared_memory=shared_memory)
        except NoServerError as error:
            if self._server is not None and not self._server.alive:
                raise ServerExitedError(self._server.exit_report()) from error
            raise

    def _handshake(self, timeout_s: float) -> dict[str, Any]:
        hello = self.request("hello", HELLO, timeout_s, "connect_timeout_s")
        low, high = hello["protocols"]
        if not low <= codec.PROTOCOL <= high:
            raise VersionError(
                f"the server at {self.endpoint} ({hello['server_version']}) supports protocol {low} to {high}, this "
                f"client {codec.PROTOCOL}\n  install the same Twinstep at both ends"
            )
        return hello

    def _server_restarted(self) -> bool:
        visible = self._session.visible_servers()
        return all(server_id != self.server_id for server_id, _ in visible) and any(
            name == self.name for _, name in visible
        )

    def _timeout_reason(self, option: str) -> str:
        if not self._session.connected:
            return (
                "the connection is lost and cannot be restored; check that the server or the router is running and not "
                "suspended"
            )
        if all(server_id != self.server_id for server_id, _ in self._session.visible_servers()):
            # A suspended server that is connected directly does not answer the query for visible servers either.
            return (
                "the server is no longer visible: it has terminated or lost its router, or, without a router, it is "
                "unresponsive"
            )
        pending = self.pending("hello", HELLO)
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
