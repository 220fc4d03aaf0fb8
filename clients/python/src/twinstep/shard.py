"""Rows of a sharded environment on one server, and their recovery after it was lost."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from .codec import Spec
from .discovery import ServerInfo
from .errors import InvalidOptionError, SpecMismatchError
from .options import ConnectOptions
from .recovery import Recovery, lease_again
from .remote import RemoteVecEnv
from .step import StepBatch

_RECOVERY_TIMEOUT_S = 1.0
"""Timeout of connecting to one server during a recovery [s]. Another one may be waiting to be tried."""


@dataclass
class Shard:
    """Neighbouring rows on one server."""

    rows: slice
    servers: list[ConnectOptions]
    remote: RemoteVecEnv | None
    recovery: Recovery | None = None
    sent: bool = False
    batch: StepBatch | None = None

    @property
    def num_envs(self) -> int:
        """Number of rows."""
        return self.rows.stop - self.rows.start

    def start_recovery(
        self, lost: RemoteVecEnv, *, spec: Spec, autoreset: str, max_episode_steps: int | None, connect_timeout_s: float
    ) -> None:
        """Request a lease in place of ``lost``, in a thread."""
        lease = partial(
            lease_again, spec=spec, num_envs=self.num_envs, autoreset=autoreset, max_episode_steps=max_episode_steps
        )
        timeout_s = min(_RECOVERY_TIMEOUT_S, connect_timeout_s)
        servers = [replace(one, spec_hash=spec.hash, connect_timeout_s=timeout_s) for one in self.servers]
        self.recovery = Recovery(servers, lease, lost)


def server_options(options: ConnectOptions, servers: Sequence[str | ServerInfo]) -> list[ConnectOptions]:
    """Return the options of each server."""
    if options.endpoint is not None:
        raise InvalidOptionError("`endpoint` and `endpoints` are set; one of them is expected")
    if isinstance(servers, str) or not servers:
        raise InvalidOptionError(f"`endpoints` = {servers!r}; a list of at least one server is expected")
    return [
        replace(options, endpoint=one, robot=options.robot)
        if isinstance(one, str)
        else replace(options, endpoint=one.endpoint, robot=one.robot)
        for one in servers
    ]


def same_spec(shards: list[Shard]) -> Spec:
    """Return the spec of all servers. Raises a ``SpecMismatchError`` if the last one has another."""
    first, last = shards[0].remote, shards[-1].remote
    assert first is not None
    assert last is not None
    if first.spec != last.spec:
        raise SpecMismatchError(
            f"the servers at {shards[0].servers[0].endpoint} and {shards[-1].servers[0].endpoint} have different specs"
        )
    return first.spec


def stop_recoveries(shards: list[Shard]) -> None:
    """Stop the search for servers."""
    for shard in shards:
        if shard.recovery is not None:
            shard.recovery.stop()
