"""Exceptions of Twinstep, all derived from :class:`Error`."""

import gymnasium


class Error(Exception):
    """Base class of all exceptions of Twinstep."""


class NoServerError(Error):
    """No server answers at the endpoint, or access control hides it from this client."""


class AmbiguousRobotError(Error):
    """No robot has the requested name, or several servers match and differ in robot, task or spec."""


class VersionError(Error):
    """The server does not support the client's protocol version."""


class SpecMismatchError(Error):
    """The server's task, observation, action, periods, gains or default pose differ from the requested ones."""


class RequestTimeoutError(Error, TimeoutError):
    """No reply arrived in time; the request may or may not have been executed.

    ``recv`` waits for the reply again. ``reset`` waits for it and then starts new episodes. No step is executed twice.
    """


class LeaseLostError(Error):
    """The lease has ended: the server was restarted, another client took it over, or its grace period passed."""


class ServerExitedError(LeaseLostError):
    """The server that this process started has terminated; the message contains its last log lines."""


class InvalidActionError(Error, ValueError):
    """An action has the wrong shape or type, or contains NaN or an infinite number."""


class InvalidOptionError(Error, ValueError):
    """An argument is not allowed; the message contains its name, its value and the allowed values."""


class ResetNeededError(Error, gymnasium.error.ResetNeeded):
    """An environment has no episode: call ``reset`` first."""


class ForkedProcessError(Error):
    """Zenoh cannot be used in a process that was forked after a session was opened; start processes with ``spawn``."""


class NotPicklableError(Error, TypeError):
    """An environment cannot be pickled or copied; send a :class:`twinstep.EnvFactory` to the other process."""


class RequestRejectedError(Error):
    """The server rejected a request.

    Attributes
    ----------
    code : str
        Error code, as in ``protocol/SPEC.md``.
    field : str
        Name of the invalid field; empty if there is none.
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
    """Return the exception for an error reply of the server."""
    text = f"{message}\n  {hint}" if hint else message
    kind = _BY_CODE.get(code)
    return kind(text) if kind else RequestRejectedError(code, field, text)
