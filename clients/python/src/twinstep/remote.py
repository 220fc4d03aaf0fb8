"""Lease of environments on a server. Assigns the sequence numbers of requests."""

import time
import weakref
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from . import codec
from .connection import Connection
from .errors import (
    Error,
    InvalidActionError,
    InvalidOptionError,
    RequestRejectedError,
    RequestTimeoutError,
    SpecMismatchError,
)
from .pickling import NotPicklable
from .query import Pending
from .server import EmbeddedServer

UNLIMITED = 2**32 - 1
"""``max_episode_steps`` that never truncates."""

_CAPACITY = "1000000"
_CONSUMES_SEQ = ("internal",)


@dataclass(frozen=True)
class ConnectOptions:
    """Options of a connection, common to all environments.

    Attributes
    ----------
    endpoint
        Zenoh endpoint of a server, a robot or a router. ``None`` starts the bundled server.
    robot
        Name of the robot. Required if several are visible at ``endpoint``. Among several servers of the same robot,
        task and spec hash, that with the most free environments is chosen.
    task
        Name of the task. A server at ``endpoint`` must have this task.
    config, model
        Config file and model file of the bundled server (``twinstep serve --help``). Not allowed with ``endpoint``.
    zenoh_config
        Zenoh configuration file (JSON5) for TLS, user and password.
    shared_memory
        Sends large messages through shared memory. The server must run on this machine with the flag
        ``--shared-memory``, which the bundled server gets; otherwise the messages are sent over the network.
    spec_hash
        Spec hash for which the agent was trained. A server with a different hash is rejected.
    critic
        Requests the privileged observations of group ``critic``; they are in the info of every reset and step.
    timeout_s, reset_timeout_s
        Timeout of a step and of a reset [s].
    connect_timeout_s
        Timeout of connecting to a server and finding the robot [s].
    """

    endpoint: str | None = None
    robot: str | None = None
    task: str = "walk"
    config: str | None = None
    model: str | None = None
    zenoh_config: str | None = None
    shared_memory: bool = False
    spec_hash: str | None = None
    critic: bool = False
    timeout_s: float = 5.0
    reset_timeout_s: float = 10.0
    connect_timeout_s: float = 5.0

    def __post_init__(self) -> None:
        """Check the options that do not depend on a server."""
        if self.endpoint is not None and (self.config is not None or self.model is not None):
            raise InvalidOptionError("`config` and `model` are options of the bundled server: omit them or `endpoint`")
        for name in ("timeout_s", "reset_timeout_s", "connect_timeout_s"):
            value = getattr(self, name)
            if not value > 0:
                raise InvalidOptionError(f"`{name}` = {value} s; must be greater than 0")


@dataclass
class StepBatch:
    """Result of one step. The arrays are new and not written to later.

    Attributes
    ----------
    obs : (num_envs, obs_len) float32
    reward : (num_envs,) float32
    terminated, truncated : (num_envs,) bool
    ended : (k,) int
        Environments whose episode ended.
    ended_length : (k,) int
        Policy steps of those episodes.
    ended_terms : (k, reward_terms) float32
        Sums of their weighted reward terms.
    ended_diverged : (k,) bool
        True for those whose simulation became NaN or infinite. They are truncated; ``obs`` is that before the step.
    ended_lost : (k,) bool
        True for those whose server was lost, see :class:`twinstep.ShardedVecEnv`. Their ``ended_terms`` are NaN.
    held : (num_envs,) bool
        True for environments whose action was not executed, because they have no server or have just got one.
    final_obs : (k, obs_len) float32, or empty
        Their last observations; empty unless autoreset is SameStep.
    critic_obs : (num_envs, critic_len) float32
        Observations of group ``critic``; ``critic_len`` is 0 unless the option ``critic`` is set.
    final_critic_obs : (k, critic_len) float32, or empty
        As ``final_obs``, of group ``critic``.
    round_trip_s
        Time from sending the actions to the reply [s].
    """

    obs: NDArray[np.float32]
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    ended: NDArray[np.int64]
    ended_length: NDArray[np.int64]
    ended_terms: NDArray[np.float32]
    ended_diverged: NDArray[np.bool_]
    ended_lost: NDArray[np.bool_]
    held: NDArray[np.bool_]
    final_obs: NDArray[np.float32]
    critic_obs: NDArray[np.float32]
    final_critic_obs: NDArray[np.float32]
    round_trip_s: float = field(compare=False)


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
        server = EmbeddedServer.shared(_flags(options)) if options.endpoint is None else None
        try:
            endpoint = options.endpoint if server is None else server.endpoint
            assert endpoint is not None
            connection = Connection(
                endpoint,
                robot=options.robot,
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
        lease = connection.request(connection.querier("lease"), request, options.reset_timeout_s, "reset_timeout_s")
        self.spec = codec.read_spec(lease, connection.hello["spec_hash"])
        self.lease: str = lease["lease"]
        self._epoch: int = lease["epoch"]
        self._last_seq: int = lease["last_seq"]
        self._methods = {
            method: connection.querier(f"env/{lease['lease']}/{method}")
            for method in ("reset", "step", "render", "close")
        }
        self._pending: tuple[str, int, Pending, float] | None = None
        # Why the state of the environments is unknown: a reply was lost. A reset of all of them heals it.
        self._unknown: str | None = None
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
        self.critic_obs = self._critic(reply, "critic_obs", self.num_envs)
        obs = codec.tensor(reply, "obs", "<f4", self.num_envs, self.spec.obs_len)
        self._unknown = then_unknown
        return obs

    def send(self, actions: NDArray[Any]) -> None:
        """Send actions without waiting, so that the caller can compute during the step. Call :meth:`recv` next."""
        if self._pending is not None:
            raise Error(
                f"the last `{self._pending[0]}` has no reply yet\n"
                "  call `recv` to wait for it, or `reset` to wait and start new episodes"
            )
        self._check_known()
        self._send("step", {"actions": checked_actions(actions, self.num_envs, self.spec).tobytes()})

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
            return self._step_batch(reply, since)
        except codec.MalformedError as error:
            self._unknown = f"the reply to a step could not be read: {error}"
            raise

    def _step_batch(self, reply: dict[str, Any], since: float) -> StepBatch:
        n, k, obs_len = self.num_envs, len(reply.get("ended_env", b"")) // 4, self.spec.obs_len
        terms = len(self.spec.reward_terms)
        num_final = k if reply.get("final_obs") else 0
        self.critic_obs = self._critic(reply, "critic_obs", n)
        return StepBatch(
            obs=codec.tensor(reply, "obs", "<f4", n, obs_len),
            reward=codec.tensor(reply, "reward", "<f4", n),
            terminated=codec.tensor(reply, "terminated", "?", n),
            truncated=codec.tensor(reply, "truncated", "?", n),
            ended=codec.tensor(reply, "ended_env", "<u4", k).astype(np.int64),
            ended_length=codec.tensor(reply, "ended_length", "<u4", k).astype(np.int64),
            ended_terms=codec.tensor(reply, "ended_terms", "<f4", k, terms),
            ended_diverged=codec.tensor(reply, "ended_diverged", "?", k)
            if reply.get("ended_diverged")
            else np.zeros(k, np.bool_),
            ended_lost=np.zeros(k, np.bool_),
            held=np.zeros(n, np.bool_),
            final_obs=codec.tensor(reply, "final_obs", "<f4", num_final, obs_len),
            critic_obs=self.critic_obs,
            final_critic_obs=self._critic(reply, "final_critic_obs", num_final),
            round_trip_s=time.monotonic() - since,
        )

    def _critic(self, reply: dict[str, Any], field: str, rows: int) -> NDArray[np.float32]:
        """Return observations of group ``critic``, which a reply without the group does not contain."""
        return codec.tensor({field: b"", **reply}, field, "<f4", rows, self.spec.critic_len)

    def scene(self, env: int) -> dict[str, Any]:
        """Return shapes and poses of one robot, and its ground, for rendering."""
        self._check_open()
        request: dict[str, object] = {"epoch": self._epoch, "env": env}
        return self._connection.request(self._methods["render"], request, self._options.timeout_s, "timeout_s")

    def close(self) -> None:
        """End the lease. Further calls have no effect."""
        if not self._release.alive:
            return
        try:
            self._resolve_abandoned_request()
            request: dict[str, object] = {"epoch": self._epoch, "seq": self._last_seq + 1}
            self._connection.request(self._methods["close"], request, self._options.timeout_s, "timeout_s")
        except Error:
            # The error does not matter to a closed client. The server releases the lease after the grace period.
            pass
        finally:
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
        pending = self._connection.pending(self._methods[method], {**request, "epoch": self._epoch, "seq": seq})
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
        self, option: Literal["timeout_s", "reset_timeout_s"], timeout_s: float | None = None
    ) -> dict[str, Any]:
        """Wait for the reply to the pending request for ``timeout_s``, or as long as ``option`` says.

        After a timeout the request stays pending, because it may have been executed. A reply or an error with effects
        consumes its number.
        """
        assert self._pending is not None
        method, seq, pending, _ = self._pending
        try:
            limit_s = getattr(self._options, option) if timeout_s is None else timeout_s
            reply = self._connection.wait_reply(pending, limit_s, option)
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
                self._await_pending("reset_timeout_s")
            except RequestTimeoutError:
                raise
            except Error:
                # Its error is not needed, but whether its number was consumed is.
                pass


def checked_actions(actions: NDArray[Any], num_envs: int, spec: codec.Spec) -> NDArray[np.float32]:
    """Return actions, (num_envs, action_len) finite numbers, as contiguous little-endian float32."""
    given = np.asarray(actions)
    expected = (num_envs, spec.action_len)
    if given.shape != expected:
        raise InvalidActionError(f"`actions` has shape {given.shape}; {expected} is expected")
    if given.dtype.kind not in "fiu":
        raise InvalidActionError(f"`actions` has dtype {given.dtype}; float32 is expected")
    checked = np.ascontiguousarray(given, dtype="<f4")
    if not np.isfinite(checked).all():
        env, entry = (int(index) for index in np.argwhere(~np.isfinite(checked))[0])
        raise InvalidActionError(
            f"the action of environment {env}, {spec.action_entry(entry)}, is {checked[env, entry]}\n"
            "  nothing was stepped; check the policy that computed the action"
        )
    return checked


def _flags(options: ConnectOptions) -> tuple[str, ...]:
    flags = ["--task", options.task, "--envs", _CAPACITY]
    if options.config is not None:
        flags += ["--config", options.config]
    if options.model is not None:
        flags += ["--model", options.model]
    if options.shared_memory:
        flags.append("--shared-memory")
    return tuple(flags)


def _release(connection: Connection, server: EmbeddedServer | None) -> None:
    connection.close()
    if server is not None:
        server.release()
