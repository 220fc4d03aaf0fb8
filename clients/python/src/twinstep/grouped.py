"""Groups of environments whose steps are in progress at the same time."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import Error, InvalidOptionError
from .options import ConnectOptions
from .pickling import NotPicklable
from .remote import RemoteVecEnv
from .shard_merge import divide, merge
from .step import StepBatch, checked_actions, checked_gait_commands, checked_velocity_commands


class GroupedVecEnv(NotPicklable):
    """Environments on one server, in groups with a lease each. Several groups step while the agent computes actions.

    ``reset`` and ``step`` are for all groups together. An agent whose computation takes time steps them one by one::

        envs = GroupedVecEnv(options, groups=3, num_envs=192, autoreset="NextStep", max_episode_steps=None)
        obs = envs.reset(seeds, None)
        for group in range(envs.num_groups):
            envs.send(group, policy(obs[envs.rows(group)]))
        for step in range(3000):
            group = step % envs.num_groups
            batch = envs.recv(group)
            envs.send(group, policy(batch.obs))  # the other groups step meanwhile

    Row i with a seed is the same robot for any number of groups. Rows that were never given a seed get random
    ones.

    Parameters
    ----------
    options
        Server and task.
    groups
        Number of groups, which differ by at most one environment.
    num_envs
        Number of environments of all groups together, at least ``groups``.
    autoreset, max_episode_steps
        As for ``RemoteVecEnv``.
    """

    def __init__(
        self,
        options: ConnectOptions,
        *,
        groups: int,
        num_envs: int,
        autoreset: str,
        max_episode_steps: int | None,
    ) -> None:
        if not 1 <= groups <= num_envs:
            raise InvalidOptionError(
                f"`groups` = {groups} is not allowed: 1 to {num_envs}, the number of environments (`num_envs`)"
            )
        self.num_envs = num_envs
        self._timeout_s = options.timeout_s
        self._same_step = autoreset == "SameStep"
        self._rows = divide(num_envs, groups)
        self._groups: list[RemoteVecEnv] = []
        self._received: dict[int, StepBatch] = {}
        self._sent_at = 0.0
        # Without seeds, the server has the same random streams for each lease.
        self._random_seeds = np.random.default_rng().integers(2**64, size=num_envs, dtype=np.uint64)
        self._never_seeded = np.ones(num_envs, np.bool_)
        try:
            for rows in self._rows:
                server_id = self._groups[0].server_id if self._groups else None
                group = RemoteVecEnv(
                    options,
                    num_envs=rows.stop - rows.start,
                    autoreset=autoreset,
                    max_episode_steps=max_episode_steps,
                    server_id=server_id,
                )
                self._groups.append(group)
        except BaseException:
            self.close()
            raise
        self.spec = self._groups[0].spec

    @property
    def num_groups(self) -> int:
        """Number of groups."""
        return len(self._groups)

    @property
    def lease(self) -> str:
        """Ids of the leases, as in the log of the server."""
        return ", ".join(group.lease for group in self._groups)

    @property
    def critic_obs(self) -> NDArray[np.float32]:
        """Observations of group ``critic`` after the last reset or step: (num_envs, critic_len)."""
        return np.concatenate([group.critic_obs for group in self._groups])

    def rows(self, group: int) -> slice:
        """Return the environments of a group."""
        return self._rows[group]

    def reset(
        self,
        seeds: NDArray[np.uint64] | None,
        mask: NDArray[np.bool_] | None,
        seeded: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Start new episodes in all groups, with the arguments of ``RemoteVecEnv.reset``.

        After an error some groups have new episodes and others have not: reset all.

        Returns
        -------
        obs : (num_envs, obs_len) float32
            Observations of all environments, reset or not.
        """
        self._received.clear()
        chosen = np.ones(self.num_envs, np.bool_) if mask is None else mask
        given = chosen & (seeds is not None) if seeded is None else chosen & seeded
        new = chosen & ~given & self._never_seeded
        if new.any():
            seeds, seeded = np.where(given, 0 if seeds is None else seeds, self._random_seeds), given | new
        obs = [
            group.reset(_part(seeds, rows), _part(mask, rows), _part(seeded, rows))
            for group, rows in zip(self._groups, self._rows, strict=True)
        ]
        self._never_seeded[given | new] = False
        return np.concatenate(obs)

    def set_velocity_commands(self, commands: NDArray[Any]) -> None:
        """Set the velocity commands of every later step, (num_envs, 3), in place of the task's own."""
        checked = checked_velocity_commands(commands, self.num_envs, self.spec)
        for group, rows in zip(self._groups, self._rows, strict=True):
            group.set_velocity_commands(checked[rows])

    def set_gait_commands(self, commands: NDArray[Any]) -> None:
        """Set the gait commands of every later step, (num_envs, 4), in place of the task's own."""
        checked = checked_gait_commands(commands, self.num_envs, self.spec)
        for group, rows in zip(self._groups, self._rows, strict=True):
            group.set_gait_commands(checked[rows])

    def send(self, group: int, actions: NDArray[Any]) -> None:
        """Send the actions of a group, (rows of the group, action_len), without waiting. Call :meth:`recv` next."""
        if group in self._received:
            raise Error(f"the last `step` of group {group} has a result\n  call `recv` to get it")
        self._groups[group].send(actions)

    def recv(self, group: int) -> StepBatch:
        """Wait for the result of a group. ``RemoteVecEnv.recv`` says what may follow an error."""
        received = self._received.pop(group, None)
        return self._groups[group].recv() if received is None else received

    def step(self, actions: NDArray[Any]) -> StepBatch:
        """Step all groups.

        After an error some groups have stepped and others have not. :meth:`recv` returns the results of those that
        have; :meth:`reset` starts new episodes in all.
        """
        self.send_all(actions)
        return self.recv_all()

    def send_all(self, actions: NDArray[Any]) -> None:
        """Send the actions of all groups, (num_envs, action_len), without waiting. Call :meth:`recv_all` next."""
        checked = checked_actions(actions, self.num_envs, self.spec)
        for index, group in enumerate(self._groups):
            if index in self._received or group.in_progress:
                raise Error(
                    f"group {index} has a result that was not received: nothing was stepped\n"
                    "  call `recv` of the group, or `reset`"
                )
        self._sent_at = time.monotonic()
        for group, rows in zip(self._groups, self._rows, strict=True):
            group.send(checked[rows])

    def recv_all(self) -> StepBatch:
        """Wait for the results of all groups; may be called again after a ``RequestTimeoutError``."""
        since = time.monotonic()
        error: Error | None = None
        for index, group in enumerate(self._groups):
            if index in self._received:
                continue
            try:
                self._received[index] = group.recv(max(0.0, since + self._timeout_s - time.monotonic()))
            except Error as raised:
                # The results of the other groups are received first, so that `recv` returns them at once.
                error = error or raised
        if error is not None:
            raise error
        parts = [(self._rows[index], batch) for index, batch in sorted(self._received.items())]
        self._received.clear()
        return self._merged(parts, time.monotonic() - self._sent_at)

    def scene(self, env: int) -> dict[str, Any]:
        """Return shapes and poses of one robot, and its ground, for rendering."""
        for group, rows in zip(self._groups, self._rows, strict=True):
            if rows.start <= env < rows.stop:
                return group.scene(env - rows.start)
        raise InvalidOptionError(f"`env` = {env}; must be 0 to {self.num_envs - 1}")

    def close(self) -> None:
        """End all leases. Further calls have no effect."""
        for group in self._groups:
            group.close()

    def _merged(self, parts: list[tuple[slice, StepBatch]], round_trip_s: float) -> StepBatch:
        # Every row is in a part: the arrays of held and lost rows are not read.
        return merge(
            parts,
            lost=np.zeros(0, np.int64),
            obs=np.empty((self.num_envs, self.spec.obs_len), np.float32),
            critic_obs=np.empty((self.num_envs, self.spec.critic_len), np.float32),
            length=np.zeros(self.num_envs, np.int64),
            terms=len(self.spec.reward_terms),
            same_step=self._same_step,
            round_trip_s=round_trip_s,
        )


def _part(values: NDArray[Any] | None, rows: slice) -> NDArray[Any] | None:
    return None if values is None else values[rows]


class AllGroups:
    """All groups of a :class:`GroupedVecEnv` as one, with the interface of ``RemoteVecEnv`` and its arguments."""

    def __init__(
        self, options: ConnectOptions, groups: int, *, num_envs: int, autoreset: str, max_episode_steps: int | None
    ) -> None:
        self._envs = GroupedVecEnv(
            options, groups=groups, num_envs=num_envs, autoreset=autoreset, max_episode_steps=max_episode_steps
        )
        self.spec = self._envs.spec
        self.reset = self._envs.reset
        self.set_velocity_commands = self._envs.set_velocity_commands
        self.set_gait_commands = self._envs.set_gait_commands
        self.send = self._envs.send_all
        self.recv = self._envs.recv_all
        self.scene = self._envs.scene
        self.close = self._envs.close

    @property
    def lease(self) -> str:
        """Ids of the leases, as in the log of the server."""
        return self._envs.lease

    @property
    def critic_obs(self) -> NDArray[np.float32]:
        """Observations of group ``critic`` after the last reset or step: (num_envs, critic_len)."""
        return self._envs.critic_obs
