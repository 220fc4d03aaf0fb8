"""Lease of environments on a server. Assigns the sequence numbers of requests."""

import time
import weakref
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from . import codec
from .connection import Connection
from .errors import (
    Error,
    InvalidOptionError,
    RequestRejectedError,
    RequestTimeoutError,
    SpecMismatchError,
)
from .options import UNLIMITED, ConnectOptions, server_flags
from .pickling import NotPicklable
from .query import Pending
from .rollout import GaussianPolicy, Trajectory, encode_policy, read_trajectory
from .server import EmbeddedServer
from .step import (
    StepBatch,
    checked_actions,
    checked_gait_commands,
    checked_velocity_commands,
    read_critic,
    read_step,
)

_CONSUMES_SEQ = ("internal", "rollout_failed")


class RemoteVecEnv(NotPicklable):
    """Environments on a server, leased by this client.

    Parameters
    ----------
    options
        Server and task.
    num_envs
        Number of environments.
    autoreset
        ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``; executed by the server.
    max_episode_steps
        Policy steps after which an episode is truncated. ``None``: the number of the task.
    server_id
        Id of the server among those at the endpoint. ``None``: any.
    """

    def __init__(
        self,
        options: ConnectOptions,
        *,
        num_envs: int,
        autoreset: str,
        max_episode_steps: int | None,
        server_id: str | None = None,
    ) -> None:
        if num_envs < 1:
            raise InvalidOptionError(f"`num_envs` = {num_envs}; must be at least 1")
        if max_episode_steps is not None and not 1 <= max_episode_steps <= UNLIMITED:
            raise InvalidOptionError(f"`max_episode_steps` = {max_episode_steps} is not allowed: 1 to {UNLIMITED}")
        self.num_envs = num_envs
        self._options = options
        server = EmbeddedServer.shared(server_flags(options)) if options.endpoint is None else None
        try:
            endpoint = options.endpoint if server is None else server.endpoint
            assert endpoint is not None
            connection = Connection(
                endpoint,
                # The bundled server has one robot, whatever its name.
                robot=None if options.endpoint is None else options.robot,
                zenoh_config=options.zenoh_config,
                shared_memory=options.shared_memory,
                server=server,
                connect_timeout_s=options.connect_timeout_s,
                server_id=server_id,
            )
        except BaseException:
            if server is not None:
                server.release()
            raise
        # Runs at garbage collection or at the end of the interpreter if `close` was not called.
        self._release = weakref.finalize(self, _release, connection, server)
        self._connection = connection
        try:
            self._lease(autoreset, max_episode_steps)
        except BaseException:
            self._release()
            raise

    def _lease(self, autoreset: str, max_episode_steps: int | None) -> None:
        connection, options = self._connection, self._options
        found: str = connection.hello["spec"]["task"]
        if found != options.task:
            raise SpecMismatchError(
                f"the server at {connection.endpoint} has the task `{found}`, not `{options.task}`\n"
                f"  start it with `--task {options.task}`, or create the environment with task `{found}`"
            )
        request: dict[str, object] = {
            "client": connection.client,
            "num_envs": self.num_envs,
            "autoreset": autoreset,
            "max_episode_steps": max_episode_steps,
            "critic": options.critic,
            "spec_hash": options.spec_hash,
        }
        lease = connection.request("lease", request, options.reset_timeout_s, "reset_timeout_s")
        self.spec = codec.read_spec(lease, connection.hello["spec_hash"])
        self.lease: str = lease["lease"]
        connection.declare(f"env/{self.lease}/step")
        self._epoch: int = lease["epoch"]
        self._last_seq: int = lease["last_seq"]
        self._pending: tuple[str, int, Pending, float] | None = None
        # Why the state of the environments is unknown: a reply was lost. A reset of all of them heals it.
        self._unknown: str | None = None
        # Fields of every step request: commands in place of the task's own.
        self._commands: dict[str, object] = {}
        # Encoded policy that the server holds, and its id.
        self._held_policy: tuple[dict[str, object], int] | None = None
        # Request of the rollout in progress.
        self._rollout: dict[str, object] = {}
        self.critic_obs = np.zeros((self.num_envs, self.spec.critic_len), dtype=np.float32)
        """Observations of group ``critic`` after the last reset or step: (num_envs, critic_len)."""

    def reset(
        self,
        seeds: NDArray[np.uint64] | None,
        mask: NDArray[np.bool_] | None,
        seeded: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Start new episodes.

        Parameters
        ----------
        seeds : (num_envs,) uint64, optional
            Seed of each environment. ``None``: each continues its random stream.
        mask : (num_envs,) bool, optional
            True for environments to reset. ``None``: all.
        seeded : (num_envs,) bool, optional
            True for environments that start from their seed; the others continue their random stream. ``None``: all.

        Returns
        -------
        obs : (num_envs, obs_len) float32
            Observations of all environments, reset or not.
        """
        self._check_open()
        self._resolve_abandoned_request()
        if mask is not None:
            self._check_known()
        chosen = np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask
        unseeded = chosen & False if seeded is None else chosen & ~seeded
        if not unseeded.any():
            return self._reset(seeds, mask)
        if np.array_equal(unseeded, chosen):
            return self._reset(None, mask)
        # One request has seeds for all of its environments or for none.
        self._reset(seeds, chosen & ~unseeded, then_unknown="only the environments with a seed were reset")
        return self._reset(None, unseeded)

    def _reset(
        self, seeds: NDArray[np.uint64] | None, mask: NDArray[np.bool_] | None, then_unknown: str | None = None
    ) -> NDArray[np.float32]:
        """Send one request. ``then_unknown`` is the reason why the state is unknown until the next one."""
        request: dict[str, object] = {}
        if seeds is not None:
            request["seeds"] = seeds.astype("<u8").tobytes()
        if mask is not None:
            request["mask"] = mask.astype(np.uint8).tobytes()
        self._send("reset", request)
        reply = self._await_pending("reset_timeout_s")
        self._unknown = "the reply to a reset could not be read"
        self.critic_obs = read_critic(reply, "critic_obs", self.num_envs, self.spec)
        obs = codec.tensor(reply, "obs", "<f4", self.num_envs, self.spec.obs_len)
        self._unknown = then_unknown
        return obs

    def set_velocity_commands(self, commands: NDArray[Any]) -> None:
        """Set the velocity commands of every later step, (num_envs, 3), in place of the task's own."""
        self._commands["command"] = checked_velocity_commands(commands, self.num_envs, self.spec).tobytes()

    def set_gait_commands(self, commands: NDArray[Any]) -> None:
        """Set the gait commands of every later step, (num_envs, 4), in place of the task's own."""
        self._commands["gait_command"] = checked_gait_commands(commands, self.num_envs, self.spec).tobytes()

    def send(self, actions: NDArray[Any]) -> None:
        """Send actions without waiting, so that the caller can compute during the step. Call :meth:`recv` next."""
        if self._pending is not None:
            raise Error(
                f"the last `{self._pending[0]}` has no reply yet\n"
                "  call `recv` to wait for it, or `reset` to wait and start new episodes"
            )
        self._check_known()
        request: dict[str, object] = {"actions": checked_actions(actions, self.num_envs, self.spec).tobytes()}
        self._send("step", request | self._commands)

    def recv(self, timeout_s: float | None = None) -> StepBatch:
        """Wait for the result of the actions. May be called again after a :class:`RequestTimeoutError`.

        Parameters
        ----------
        timeout_s
            Timeout [s]. ``None``: that of the options.
        """
        self._check_open()
        if self._pending is None:
            raise Error("no request is in progress: call `send` before `recv`")
        if self._pending[0] != "step":
            raise Error(f"the last `{self._pending[0]}` has no reply yet\n  call `reset` to wait for it")
        since = self._pending[3]
        reply = self._await_pending("timeout_s", timeout_s)
        try:
            batch = read_step(reply, self.num_envs, self.spec, since)
        except codec.MalformedError as error:
            self._unknown = f"the reply to a step could not be read: {error}"
            raise
        self.critic_obs = batch.critic_obs
        return batch

    def rollout(self, policy: GaussianPolicy, steps: int, *, noise_seed: int) -> Trajectory:
        """Run a policy on the server for some steps of all environments, from their current observations.

        The weights are sent only if they differ from those of the last rollout. After a :class:`RequestTimeoutError`
        call it again with the same arguments: the rollout is executed once.

        Parameters
        ----------
        policy
            The policy, which samples its actions on the server.
        steps
            Number of steps, 1 to ``max_rollout_steps`` of the server.
        noise_seed
            The noise of environment i is a function of ``noise_seed + i`` alone. Use another one for each rollout.
        """
        self._check_open()
        if not 0 <= noise_seed < 2**64:
            raise InvalidOptionError(f"`noise_seed` = {noise_seed} is not allowed: 0 to 2**64 - 1")
        limit = int(self._connection.hello.get("max_rollout_steps", 0))
        if not 1 <= steps <= limit:
            raise InvalidOptionError(
                f"`steps` = {steps} is not allowed: 1 to {limit}, `max_rollout_steps` of the server"
                if limit
                else "the server has no rollouts: use `step`"
            )
        encoded = encode_policy(policy, self.spec)
        try:
            return self._execute_rollout(encoded, steps, noise_seed)
        except RequestRejectedError as error:
            if error.code != "unknown_policy":
                raise
            self._held_policy = None
            return self._execute_rollout(encoded, steps, noise_seed)

    def _execute_rollout(self, policy: dict[str, object], steps: int, noise_seed: int) -> Trajectory:
        held = self._held_policy is not None and self._held_policy[0] == policy
        chosen = {"policy_id": self._held_policy[1]} if self._held_policy is not None and held else {"policy": policy}
        request: dict[str, object] = {"steps": steps, "noise_seed": noise_seed, **chosen}
        if self._pending is None:
            self._check_known()
            self._rollout = request
            self._send("rollout", request)
        elif self._pending[0] != "rollout" or self._rollout != request:
            raise Error(
                f"the last `{self._pending[0]}` has no reply yet\n  call `reset` to wait and start new episodes"
            )
        try:
            reply = self._await_pending("timeout_s")
        except RequestRejectedError as error:
            if error.code in _CONSUMES_SEQ:
                self._unknown = f"a rollout failed after some of its steps: {error}"
            raise
        try:
            trajectory = read_trajectory(reply, steps, self.num_envs, self.spec)
        except codec.MalformedError as error:
            self._unknown = f"the reply to a rollout could not be read: {error}"
            raise
        if not held:
            self._held_policy = (policy, self._last_seq)
        self.critic_obs = trajectory.critic_obs[-1].copy()
        return trajectory

    def scene(self, env: int) -> dict[str, Any]:
        """Return shapes and poses of one robot, and its ground, for rendering."""
        self._check_open()
        request: dict[str, object] = {"epoch": self._epoch, "env": env}
        return self._connection.request(f"env/{self.lease}/render", request, self._options.timeout_s, "timeout_s")

    def close(self) -> None:
        """End the lease. Further calls have no effect."""
        if not self._release.alive:
            return
        try:
            self._resolve_abandoned_request()
            request: dict[str, object] = {"epoch": self._epoch, "seq": self._last_seq + 1}
            self._connection.request(f"env/{self.lease}/close", request, self._options.timeout_s, "timeout_s")
        except Error:
            # The error does not matter to a closed client. The server releases the lease after the grace period.
            pass
        finally:
            # It holds the session, which other environments may share.
            self._pending = None
            self._release()

    @property
    def server_id(self) -> str:
        """Id of the server, new at every start."""
        return self._connection.server_id

    @property
    def in_progress(self) -> bool:
        """True if a request was sent whose reply was not received."""
        return self._pending is not None

    def abandon(self) -> None:
        """End the use of the environments without a request. The server releases them after the grace period."""
        self._release()

    def _send(self, method: str, request: dict[str, object]) -> None:
        self._check_open()
        seq = self._last_seq + 1
        pending = self._connection.pending(f"env/{self.lease}/{method}", {**request, "epoch": self._epoch, "seq": seq})
        # Pending before it is sent: after an interrupt in between, the same request is sent again, not another with
        # its number.
        self._pending = (method, seq, pending, time.monotonic())
        try:
            pending.send()
        except Error:
            self._pending = None
            raise

    def _check_open(self) -> None:
        if not self._release.alive:
            raise Error("the environment is closed")

    def _check_known(self) -> None:
        if self._unknown is not None:
            raise Error(
                f"the state of the environments is unknown: {self._unknown}\n  call `reset` without a mask to continue"
            )

    def _await_pending(
        self,
        option: Literal["timeout_s", "reset_timeout_s"],
        timeout_s: float | None = None,
        *,
        until_ready: bool = True,
    ) -> dict[str, Any]:
        """Wait for the reply to the pending request for ``timeout_s``, or as long as ``option`` says.

        After a timeout the request stays pending, because it may have been executed. A reply or an error with effects
        consumes its number.
        """
        assert self._pending is not None
        method, seq, pending, _ = self._pending
        try:
            limit_s = getattr(self._options, option) if timeout_s is None else timeout_s
            reply = self._connection.wait_reply(pending, limit_s, option, until_ready=until_ready)
        except (RequestTimeoutError, KeyboardInterrupt):
            raise
        except Error as error:
            malformed = isinstance(error, codec.MalformedError)
            if malformed:
                self._unknown = f"the reply to `{method}` could not be read: {error}"
            if malformed or (isinstance(error, RequestRejectedError) and error.code in _CONSUMES_SEQ):
                self._last_seq = seq
            self._pending = None
            raise
        # In this order: an interrupt in between leaves a request that the server answers again.
        self._last_seq = seq
        self._pending = None
        if reply.get("seq") != seq:
            self._unknown = f"the reply to `{method}` has sequence number {reply.get('seq')}, not {seq}"
            raise codec.MalformedError(self._unknown)
        return reply

    def _resolve_abandoned_request(self) -> None:
        if self._pending is not None:
            try:
                # A robot that is not ready has not executed it.
                self._await_pending("reset_timeout_s", until_ready=False)
            except RequestTimeoutError:
                raise
            except Error:
                # Its error is not needed, but whether its number was consumed is.
                pass


def _release(connection: Connection, server: EmbeddedServer | None) -> None:
    connection.close()
    if server is not None:
        server.release()
