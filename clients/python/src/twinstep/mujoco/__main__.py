"""The process behind ``engine = "mujoco"``."""

import contextlib
import os
import sys

from .lockstep import serve


def main() -> None:
    """Serve on stdin and stdout. Whatever else is printed goes to stderr."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    # The server has terminated: there is nobody to tell.
    with contextlib.suppress(BrokenPipeError):
        serve(sys.stdin.buffer, replies)


if __name__ == "__main__":
    main()
