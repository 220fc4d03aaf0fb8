"""Pickling of environments, which is refused."""

from typing import NoReturn

from .errors import NotPicklableError


class NotPicklable:
    """Base class of objects that hold a lease: a copy of one would use the same sequence numbers."""

    def __reduce__(self) -> NoReturn:
        raise NotPicklableError(
            f"`{type(self).__name__}` cannot be pickled or copied: it holds a lease on a server\n"
            "  create the environment in the process that uses it, and pass `twinstep.EnvFactory(...)` to that process"
        )
