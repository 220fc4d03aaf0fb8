"""Leases environments again after their server was lost, while the other servers are stepped."""

import threading
from collections.abc import Callable, Sequence

import numpy as np
import zenoh

from .codec import Spec
from .errors import Error, SpecMismatchError
from .options import ConnectOptions
from .remote import RemoteVecEnv

_FIRST_PAUSE_S, _MAX_PAUSE_S = 0.05, 1.0


def recovery_seed(seed: int, losses: int) -> int:
    """Return the seed of a robot that was lost for the ``losses``-th time.

    It differs from the first seed, because the same episodes would be repeated. It depends on nothing else, so that
    it does not matter which server takes the robot over.
    """
    return int(np.random.SeedSequence([seed, losses]).generate_state(1, np.uint64)[0])


def lease_again(
    options: ConnectOptions, *, spec: Spec, num_envs: int, autoreset: str, max_episode_steps: int | None
) -> RemoteVecEnv:
    """Lease environments at one server. Raises a ``SpecMismatchError`` if its spec is not ``spec``."""
    remote = RemoteVecEnv(options, num_envs=num_envs, autoreset=autoreset, max_episode_steps=max_episode_steps)
    if remote.spec != spec:
        remote.close()
        raise SpecMismatchError(f"the spec of the server at {options.endpoint} has changed")
    return remote


class Recovery:
    """A search in a thread, which requests a lease at one server after the other until one grants it.

    Parameters
    ----------
    servers
        Options of the servers, in the order in which they are tried.
    lease
        Leases the environments at one server.
    lost
        Environments that are no longer used.
    """

    def __init__(
        self,
        servers: Sequence[ConnectOptions],
        lease: Callable[[ConnectOptions], RemoteVecEnv],
        lost: RemoteVecEnv,
    ) -> None:
        self._servers = servers
        self._lost: RemoteVecEnv | None = lost
        self._lease = lease
        self._found: RemoteVecEnv | None = None
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        threading.Thread(target=self._run, name="twinstep-recovery", daemon=True).start()

    def take(self) -> RemoteVecEnv | None:
        """Return the new environments, which have no episodes yet; ``None`` while no server has granted a lease."""
        with self._lock:
            found, self._found = self._found, None
            return found

    def stop(self) -> None:
        """Stop the search. Does not wait for a request in progress."""
        self._stopped.set()
        found = self.take()
        if found is not None:
            found.close()

    def _run(self) -> None:
        assert self._lost is not None
        self._lost.abandon()
        self._lost = None
        pause = _FIRST_PAUSE_S
        while not self._stopped.is_set():
            for options in self._servers:
                if not self._stopped.is_set() and self._try(options):
                    return
            self._stopped.wait(pause)
            pause = min(2 * pause, _MAX_PAUSE_S)

    def _try(self, options: ConnectOptions) -> bool:
        try:
            found = self._lease(options)
        except (Error, zenoh.ZError):
            return False
        with self._lock:
            if not self._stopped.is_set():
                self._found = found
                return True
        found.close()
        return True
