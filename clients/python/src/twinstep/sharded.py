"""Environments on several servers, with the interface of a lease on one server."""

import logging
import time
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .discovery import ServerInfo
from .errors import Error, ForkedProcessError, InvalidOptionError, NoServerError, ResetNeededError
from .options import ConnectOptions
from .pickling import NotPicklable
from .recovery import recovery_seed
from .remote import RemoteVecEnv
from .session import QUERY_TIMEOUT_S, check_process
from .shard import Shard, same_spec, server_options, stop_recoveries
from .shard_merge import divide, merge
from .step import StepBatch, checked_actions, checked_gait_commands, checked_velocity_commands

_LOG = logging.getLogger(__name__)

_MIN_WAIT_S = 2 * QUERY_TIMEOUT_S
"""A server is waited for at least this long after another one was lost: until its request was repeated once [s]."""


class ShardedVecEnv(NotPicklable):
    """Environments that are divided evenly among several servers; the interface is that of ``RemoteVecEnv``.

    Row i with a seed is the same robot on any number of servers. A step is sent to all servers before the first reply
    is awaited.

    A server that does not reply within ``timeout_s``, or has lost its lease, costs only its own rows. In that step
    they are ``truncated`` with reward 0 and their last observation (``ended_lost``). After it they are held: their
    actions are ignored, and they return reward 0 and the last observation. Meanwhile a thread requests a lease at the
    same server, then at the others, until one has room for all rows of the lost server. Then each row starts a new
    episode with a seed that follows from its first seed, and returns the first observation, in every autoreset mode.
    ``held`` is true in all these steps, also in the last: their transitions are no experience. The rows stay on the
    new server.

    Parameters
    ----------
    options
        Task and timeouts. ``endpoint`` and ``robot`` of the servers replace those of the options.
    servers
        Endpoints, or results of :func:`twinstep.discover`, which also have the name of the robot. Among servers of the
        same name behind a router, each lease is at the one with the most free environments.
    num_envs, autoreset, max_episode_steps
        As for ``RemoteVecEnv``. ``num_envs`` is at least the number of servers.
    """

    def __init__(
        self,
        options: ConnectOptions,
        servers: Sequence[str | ServerInfo],
        *,
        num_envs: int,
        autoreset: str,
        max_episode_steps: int | None,
    ) -> None:
        found = server_options(options, servers)
        if num_envs < len(found):
            raise InvalidOptionError(f"`num_envs` = {num_envs}; must be at least 1 per server: {len(found)}")
        self.num_envs = num_envs
        self._options = options
        self._autoreset = autoreset
        self._limit = max_episode_steps
        self._shards: list[Shard] = []
        # Ends the threads at garbage collection if `close` was not called. The leases have finalizers of their own.
        self._release = weakref.finalize(self, stop_recoveries, self._shards)
        try:
            for own, rows in zip(found, divide(num_envs, len(found)), strict=True):
                remote = RemoteVecEnv(
                    own, num_envs=rows.stop - rows.start, autoreset=autoreset, max_episode_steps=max_episode_steps
                )
                others = [other for other in found if other != own]
                self._shards.append(Shard(rows, [own, *others], remote))
                self.spec = same_spec(self._shards)
        except BaseException:
            self.close()
            raise
        self._actions: NDArray[np.float32] | None = None
        self._commands: NDArray[np.float32] | None = None
        self._gait_commands: NDArray[np.float32] | None = None
        self._sent_at = 0.0
        self._obs = np.zeros((num_envs, self.spec.obs_len), np.float32)
        self.critic_obs = np.zeros((num_envs, self.spec.critic_len), np.float32)
        """Observations of group ``critic`` after the last reset or step: (num_envs, critic_len)."""
        self._running = np.zeros(num_envs, np.bool_)
        self._length = np.zeros(num_envs, np.int64)
        self._unreported = np.zeros(num_envs, np.bool_)
        self._losses = np.zeros(num_envs, np.int64)
        # Two servers may have the same seed for environments that a client does not seed.
        self._seeds = np.random.default_rng().integers(2**64, size=num_envs, dtype=np.uint64)
        self._seed_unused = np.ones(num_envs, np.bool_)

    @property
    def lease(self) -> str:
        """Ids of the leases, as in the logs of the servers."""
        return ", ".join(shard.remote.lease for shard in self._shards if shard.remote is not None)

    def reset(
        self,
        seeds: NDArray[np.uint64] | None,
        mask: NDArray[np.bool_] | None,
        seeded: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Start new episodes, with the arguments of ``RemoteVecEnv.reset``.

        Environments without a server start their episode when they have one, with the seed that is given here.

        Returns
        -------
        obs : (num_envs, obs_len) float32
            Observations of all environments, reset or not; of held ones the last.
        """
        self._check_open()
        if self._actions is not None:
            self._await_replies()
            self._end_step()
        chosen = np.ones(self.num_envs, np.bool_) if mask is None else mask
        if seeds is not None:
            given = chosen if seeded is None else chosen & seeded
            self._seeds[given], self._seed_unused[given] = seeds[given], True
        started = self._recover(self._shards, wait=True)
        for shard in self._shards:
            if shard.remote is not None and shard not in started and chosen[shard.rows].any():
                self._reset_shard(shard, chosen[shard.rows])
        return self._obs.copy()

    def set_velocity_commands(self, commands: NDArray[Any]) -> None:
        """Set the velocity commands of every later step, (num_envs, 3), in place of the task's own."""
        self._commands = checked_velocity_commands(commands, self.num_envs, self.spec)

    def set_gait_commands(self, commands: NDArray[Any]) -> None:
        """Set the gait commands of every later step, (num_envs, 4), in place of the task's own."""
        self._gait_commands = checked_gait_commands(commands, self.num_envs, self.spec)

    def send(self, actions: NDArray[Any]) -> None:
        """Send actions to all servers without waiting. Call :meth:`recv` next."""
        self._check_open()
        if self._actions is not None:
            raise Error("the last `step` has no reply yet\n  call `recv` to wait for it")
        checked = checked_actions(actions, self.num_envs, self.spec)
        missing = self._has_server() & ~self._running
        if missing.any():
            raise ResetNeededError(f"environment {missing.argmax()} has no episode: nothing was stepped, call `reset`")
        if not self._has_server().any():
            # These start an episode in this step, and get no action.
            for shard in self._recover(self._shards, wait=True):
                shard.sent = True
        self._sent_at = time.monotonic()
        self._actions = checked
        self._send_to_all()
        # While the others are stepped. A loss is reported before the next episode starts.
        reported = [shard for shard in self._shards if not self._unreported[shard.rows].any()]
        for shard in self._recover(reported, wait=False):
            shard.sent = True

    def recv(self) -> StepBatch:
        """Wait for the results of all servers. A server that does not reply in time is lost."""
        self._check_open()
        if self._actions is None:
            raise Error("no request is in progress: call `send` before `recv`")
        self._await_replies()
        parts = [(shard.rows, shard.batch) for shard in self._shards if shard.batch is not None]
        batch = merge(
            parts,
            lost=np.flatnonzero(self._unreported),
            obs=self._obs,
            critic_obs=self.critic_obs,
            length=self._length,
            terms=len(self.spec.reward_terms),
            same_step=self._autoreset == "SameStep",
            round_trip_s=time.monotonic() - self._sent_at,
        )
        self._record(batch)
        self._end_step()
        return batch

    def scene(self, env: int) -> dict[str, Any]:
        """Return shapes and poses of one robot, and its ground, for rendering."""
        self._check_open()
        for shard in self._shards:
            if shard.rows.start <= env < shard.rows.stop and shard.remote is not None:
                return shard.remote.scene(env - shard.rows.start)
        raise Error(f"environment {env} has no server now")

    def close(self) -> None:
        """End all leases. Further calls have no effect."""
        self._release()
        for shard in self._shards:
            if shard.remote is not None:
                shard.remote.close()

    def _check_open(self) -> None:
        if not self._release.alive:
            raise Error("the environment is closed")
        check_process()

    def _has_server(self) -> NDArray[np.bool_]:
        """Return which environments are on a server: (num_envs,) bool."""
        found = np.zeros(self.num_envs, np.bool_)
        for shard in self._shards:
            found[shard.rows] = shard.remote is not None
        return found

    def _send_to_all(self) -> None:
        assert self._actions is not None
        for shard in self._shards:
            if shard.remote is not None and not shard.sent:
                # Before it is sent: after an interrupt no step is executed twice, but these may be held for a step.
                shard.sent = True
                try:
                    # Another server may have taken over the environments since they were set.
                    if self._commands is not None:
                        shard.remote.set_velocity_commands(self._commands[shard.rows])
                    if self._gait_commands is not None:
                        shard.remote.set_gait_commands(self._gait_commands[shard.rows])
                    shard.remote.send(self._actions[shard.rows])
                except ForkedProcessError:
                    raise
                except Error as error:
                    self._lose(shard, error)

    def _await_replies(self) -> None:
        # An interrupt may have prevented some of the requests.
        self._send_to_all()
        deadline = time.monotonic() + self._options.timeout_s
        for shard in self._shards:
            if shard.remote is not None and shard.remote.in_progress and shard.batch is None:
                try:
                    left_s = deadline - time.monotonic()
                    shard.batch = shard.remote.recv(max(left_s, min(self._options.timeout_s, _MIN_WAIT_S)))
                except Error as error:
                    self._lose(shard, error)

    def _end_step(self) -> None:
        for shard in self._shards:
            shard.sent, shard.batch = False, None
        self._actions = None

    def _record(self, batch: StepBatch) -> None:
        """Keep what a later loss needs. The caller owns the arrays of the batch."""
        self._obs, self.critic_obs = batch.obs.copy(), batch.critic_obs.copy()
        self._length[~batch.held] += 1
        # In mode NextStep the next step only starts the episode.
        self._length[batch.ended] = -1 if self._autoreset == "NextStep" else 0
        if self._autoreset == "Disabled":
            self._running[batch.ended] = False
        self._unreported[:] = False

    def _reset_shard(self, shard: Shard, chosen: NDArray[np.bool_]) -> bool:
        """Start episodes of one shard. Returns False if its server was lost."""
        assert shard.remote is not None
        rows = shard.rows
        mask = None if chosen.all() else chosen
        try:
            obs = shard.remote.reset(self._seeds[rows], mask, self._seed_unused[rows])
        except ForkedProcessError:
            raise
        except Error as error:
            self._lose(shard, error)
            return False
        self._obs[rows], self.critic_obs[rows] = obs, shard.remote.critic_obs
        started = rows.start + np.flatnonzero(chosen)
        self._seed_unused[started] = False
        self._running[started] = True
        self._length[started] = 0
        return True

    def _lose(self, shard: Shard, error: Error) -> None:
        assert shard.remote is not None
        _LOG.warning("environments %d to %d are lost: %s", shard.rows.start, shard.rows.stop - 1, error)
        lost, shard.remote, shard.batch = shard.remote, None, None
        self._unreported[shard.rows] = True
        self._losses[shard.rows] += 1
        shard.start_recovery(
            lost,
            spec=self.spec,
            autoreset=self._autoreset,
            max_episode_steps=self._limit,
            connect_timeout_s=self._options.connect_timeout_s,
        )

    def _recover(self, shards: list[Shard], *, wait: bool) -> list[Shard]:
        """Start episodes in those of ``shards`` for which a server has granted a new lease, and return these.

        With ``wait``, if no environment has a server, waits until one has.
        """
        deadline = time.monotonic() + self._options.connect_timeout_s
        while True:
            started = [shard for shard in shards if self._take_over(shard)]
            if not wait or self._has_server().any():
                return started
            if time.monotonic() >= deadline:
                raise NoServerError(
                    f"all servers are lost, and none has granted a lease for {self._options.connect_timeout_s} s "
                    "(`connect_timeout_s`)\n  check that one of them is running and has free environments"
                )
            time.sleep(0.02)

    def _take_over(self, shard: Shard) -> bool:
        found = shard.recovery.take() if shard.recovery is not None else None
        if found is None:
            return False
        shard.recovery, shard.remote = None, found
        for row in range(shard.rows.start, shard.rows.stop):
            if not self._seed_unused[row]:
                self._seeds[row] = recovery_seed(int(self._seeds[row]), int(self._losses[row]))
        self._seed_unused[shard.rows] = True
        unreported = self._unreported[shard.rows].copy()
        started = self._reset_shard(shard, np.ones(found.num_envs, np.bool_))
        # If it fails, there is no new episode that could be truncated.
        self._unreported[shard.rows] = False if started else unreported
        return started
