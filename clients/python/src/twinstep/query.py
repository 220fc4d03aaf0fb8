"""One query to a server, and its reply or the reason why there is none."""

from typing import Any, cast

import zenoh

from . import codec
from .errors import NoServerError, from_reply
from .session import SharedSession, check_process

HELLO: dict[str, object] = {"client": "twinstep-python"}


class Pending:
    """A request in progress."""

    def __init__(self, session: SharedSession, key: str | zenoh.KeyExpr, payload: bytes, secret: bytes) -> None:
        self.session = session
        self.key = key
        self.payload = payload
        self.secret = secret
        # None: not sent yet, or interrupted while it was sent.
        self.replies: Any = None

    def send(self) -> None:
        """Send the request, the first time or again with the same number, so that it is executed once."""
        check_process()
        try:
            self.replies = self.session.get(self.key, self.payload, self.secret)
        except zenoh.ZError as error:
            raise NoServerError(f"the Zenoh session is closed: {error}") from error


class NoReply:
    """Why a query got no reply."""

    NONE: "NoReply"
    TIMEOUT: "NoReply"
    BUSY: "NoReply"


NoReply.NONE, NoReply.TIMEOUT, NoReply.BUSY = NoReply(), NoReply(), NoReply()


class Waiting(NoReply):
    """The robot is not ready for the request."""

    def __init__(self, reason: str) -> None:
        self.reason = reason


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
            return Waiting(error["message"]) if error["code"] == "waiting" else NoReply.BUSY
        raise from_reply(error["code"], error["field"], error["message"], error["hint"])
    return NoReply.NONE
