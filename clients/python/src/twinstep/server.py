"""The bundled server, a child process that all environments of this process share."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import threading
from collections import deque
from pathlib import Path
from typing import IO

from .errors import Error

_STARTUP_S = 20.0
_SHUTDOWN_TIMEOUT_S = 5.0
_LOG_TAIL_LINES = 15
_MAX_FOLDER_BYTES = 70


class ServerNotFoundError(Error):
    """The program ``twinstep`` is not installed."""


class ServerStartError(Error):
    """The bundled server terminated before it was ready."""


def find_program() -> str:
    """Return the path of the program ``twinstep``: ``TWINSTEP_SERVER``, the scripts of this Python, or ``PATH``."""
    override = os.environ.get("TWINSTEP_SERVER")
    if override:
        if not os.access(override, os.X_OK):
            raise ServerNotFoundError(f"`TWINSTEP_SERVER` = {override} is not an executable program")
        return override
    for scheme in (None, f"{os.name}_user"):
        scripts = sysconfig.get_path("scripts", scheme) if scheme else sysconfig.get_path("scripts")
        program = Path(scripts) / "twinstep"
        if os.access(program, os.X_OK):
            return str(program)
    program = shutil.which("twinstep")
    if program is None:
        raise ServerNotFoundError(
            "the program `twinstep` is not installed here\n"
            "  install the package with pip, add `twinstep` to the PATH, or set TWINSTEP_SERVER"
        )
    return program


def _private_folder() -> str:
    """Create a folder that only this user can open.

    The address of a socket in it has room for 107 bytes, and Zenoh reads some characters of an address as separators.
    """
    usual = tempfile.gettempdir()
    is_possible = len(os.fsencode(usual)) <= _MAX_FOLDER_BYTES and not set("?#;") & set(usual)
    return tempfile.mkdtemp(prefix="twinstep-", dir=usual if is_possible else "/tmp")


class EmbeddedServer:
    """A server for this user, as a child process.

    It listens at a Unix socket in a folder that only this user can open: no port, and no password to keep. It
    terminates when its stdin closes, which happens even if this process crashes. Environments with the same
    ``arguments`` share one server; :meth:`shared` and :meth:`release` count its users.

    Parameters
    ----------
    arguments
        Flags of ``twinstep serve``.
    """

    _shared: "dict[tuple[int, tuple[str, ...]], tuple[EmbeddedServer, int]]" = {}  # noqa: RUF012
    _lock = threading.Lock()

    def __init__(self, arguments: tuple[str, ...]) -> None:
        self._arguments = arguments
        self._owner = os.getpid()
        self._last_lines: deque[str] = deque(maxlen=_LOG_TAIL_LINES)
        program = find_program()
        self._folder = _private_folder()
        listen = f"unixsock-stream/{self._folder}/server"
        command = [program, "serve", "--until-stdin-closes", "--listen", listen, *arguments]
        # A separate process group, so that Ctrl-C in a terminal reaches only the agent, which closes the environment.
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            process_group=0,
            # The engine `mujoco` runs in this Python, which has the extra.
            env={"TWINSTEP_PYTHON": sys.executable, **os.environ},
        )
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._reader = threading.Thread(target=self._keep_lines, args=(self._process.stderr,), daemon=True)
        self._reader.start()
        self.endpoint = self._await_endpoint(self._process.stdout)

    @classmethod
    def shared(cls, arguments: tuple[str, ...]) -> "EmbeddedServer":
        """Return the server with these arguments. Starts one if there is none, or if it has terminated."""
        # A forked child has a copy of its parent's memory, but not its server.
        key = (os.getpid(), arguments)
        with cls._lock:
            known = cls._shared.get(key)
            if known is None or not known[0].alive:
                known = (cls(arguments), 0)
            server, users = known
            cls._shared[key] = (server, users + 1)
            return server

    def release(self) -> None:
        """Release the server; the last user stops it."""
        key = (self._owner, self._arguments)
        if os.getpid() != self._owner:
            return
        with self._lock:
            server, users = self._shared.get(key, (None, 0))
            if server is self and users > 1:
                self._shared[key] = (self, users - 1)
                return
            if server is self:
                del self._shared[key]
        self._stop()

    @property
    def alive(self) -> bool:
        """True while the process runs."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def exit_report(self) -> str:
        """Return how the server terminated, and its last log lines."""
        code = self._process.poll()
        self._reader.join(timeout=1.0)
        lines = "\n  ".join(self._last_lines) or "(none)"
        cause = f"by signal {-code}" if code is not None and code < 0 else f"with exit code {code}"
        return f"the server started by this process (pid {self.pid}) terminated {cause}; its last log lines:\n  {lines}"

    def _await_endpoint(self, stdout: IO[str]) -> str:
        watchdog = threading.Timer(_STARTUP_S, self._process.kill)
        watchdog.start()
        line = stdout.readline()
        watchdog.cancel()
        if not line.startswith("listening "):
            self._stop()
            raise ServerStartError(self.exit_report())
        return line.split()[1]

    def _keep_lines(self, stderr: IO[str]) -> None:
        for line in stderr:
            self._last_lines.append(line.rstrip())
        stderr.close()

    def _stop(self) -> None:
        """Stop the process. Further calls have no effect."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(_SHUTDOWN_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._reader.join(timeout=1.0)
        shutil.rmtree(self._folder, ignore_errors=True)
