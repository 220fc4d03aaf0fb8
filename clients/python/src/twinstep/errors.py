"""Everything that can go wrong, as exceptions under :class:`Error`."""

import gymnasium


class Error(Exception):
    """Base of every exception of Twinstep."""


class NoServerError(Error):
    """Nobody answers at the endpoint, or nobody that this client may see."""


class AmbiguousRobotError(Error):
    """No robot has the name that was asked for, or several robots are there and none was named."""


class VersionError(Error):
    """Server and client speak different versions of the protocol."""


class SpecMismatchError(Error):
    """The server's task, observation, action, rates, gains or pose are not those that were asked for."""


class RequestTimeoutError(Error, TimeoutError):
    """The server did not answer in time; nobody knows yet whether the request was executed.

    ``recv`` waits for it again; ``reset`` settles it and starts anew. No step is ever executed twice.
    """


class LeaseLostError(Error):
    """The environments are gone: the server was restarted, somebody took them over, or their time ran out."""


class ServerExitedError(LeaseLostError):
    """The server that this process started has ended; its last log lines are in the message."""


class InvalidActionError(Error, ValueError):
    """An action has the wrong shape or type, or a number in it is NaN or infinite."""


class InvalidOptionError(Error, ValueError):
    """An argument is not allowed; the message says which, what was given, and what is allowed."""


class ResetNeededError(Error, gymnasium.error.ResetNeeded):
    """An environment has no episode: call ``reset`` first."""


class RequestRejectedError(Error):
    """The server refused a request.

    Attributes
    ----------
    code : str
        What kind of error it is, as ``protocol/SPEC.md`` lists them.
    field : str
        The field at fault; empty if it is none.
    """

    def __init__(self, code: str, field: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.field = field


_BY_CODE: dict[str, type[Error]] = {
    "version": VersionError,
    "spec_mismatch": SpecMismatchError,
    "lease_lost": LeaseLostError,
    "stale_epoch": LeaseLostError,
    "shutting_down": LeaseLostError,
    "needs_reset": ResetNeededError,
    "not_finite": InvalidActionError,
}


def from_reply(code: str, field: str, message: str, hint: str) -> Error:
    """Make the exception for an error reply of the server."""
    text = f"{message}\n  {hint}" if hint else message
    kind = _BY_CODE.get(code)
    return kind(text) if kind else RequestRejectedError(code, field, text)
