"""A lease of environments on a server: the one place where requests get their numbers."""

import time
import weakref
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import codec
from .errors import Error, InvalidActionError, InvalidOptionError, RequestTimeoutError, RequestRejectedError, SpecMismatchError
from .connection import Connection, Pending
from .server import EmbeddedServer

UNLIMITED = 2**32 - 1
"""``max_episode_steps`` that never truncates."""

_CAPACITY = "1000000"
_CONSUMES_SEQ = ("diverged", "internal")


@dataclass(frozen=True)
class ConnectOptions:
    """Where environments come from; the same for every kind of environment.

    Attributes
    ----------
    endpoint
        Zenoh endpoint of a server, a robot, or a router before them. ``None`` starts the bundled server.
    robot
        The robot's name; needed where several are visible at ``endpoint``.
    task
        What the robots are asked to do; a server at ``endpoint`` must have this task.
    config, model
        Config file and model file of the bundled server (``twinstep serve --help``); not with ``endpoint``.
    zenoh_config
        Zenoh configuration file (JSON5) for TLS, user and password.
    spec_hash
        Refuse a server on which an agent trained for this hash would not work.
    timeout_s, reset_timeout_s
        How long to wait for a step and for a reset [s].
    """

    endpoint: str | None = None
    robot: str | None = None
    task: str = "walk"
    config: str | None = None
    model: str | None = None
    zenoh_config: str | None = None
    spec_hash: str | None = None
    timeout_s: float = 5.0
    reset_timeout_s: float = 10.0

    def __post_init__(self) -> None:
        """Check what can be checked without a server."""
        if self.endpoint is not None and (self.config is not None or self.model is not None):
            raise InvalidOptionError("`config` and `model` are the bundled server's: leave them out, or `endpoint`")
        for name in ("timeout_s", "reset_timeout_s"):
            value = getattr(self, name)
            if not value > 0:
                raise InvalidOptionError(f"`{name}` = {value} is not more than 0 s")


@dataclass
class StepBatch:
    """What one step gave. Arrays are fresh: nobody else writes into them.

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
    final_obs : (k, obs_len) float32, or empty
        Their last observations, where autoreset is SameStep.
    round_trip_s
        From sending the actions to having the answer [s].
    """

    obs: NDArray[np.float32]
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    ended: NDArray[np.int64]
    ended_length: NDArray[np.int64]
    ended_terms: NDArray[np.float32]
    final_obs: NDArray[np.float32]
    round_trip_s: float = field(compare=False)


class RemoteVecEnv:
    """Environments on a server, for this client alone.

    Parameters
    ----------
    options
        Where they come from.
    num_envs
        How many.
    autoreset
        ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``; done in the server.
    max_episode_steps
        Policy steps after which an episode is truncated; the task's own number if ``None``.
    """

    def __init__(self, options: ConnectOptions, *, num_envs: int, autoreset: str, max_episode_steps: int | None) -> None:
        if num_envs < 1:
            raise InvalidOptionError(f"`num_envs` = {num_envs}; at least 1 is expected")
        if max_episode_steps is not None and not 1 <= max_episode_steps <= UNLIMITED:
            raise InvalidOptionError(f"`max_episode_steps` = {max_episode_steps} is outside 1..={UNLIMITED}")
        self.num_envs = num_envs
        self._options = options
        server = EmbeddedServer.shared(_flags(options)) if options.endpoint is None else None
        try:
            endpoint = options.endpoint if server is None else server.endpoint
            assert endpoint is not None
            connection = Connection(endpoint, robot=options.robot, zenoh_config=options.zenoh_config, server=server)
        except BaseException:
            if server is not None:
                server.release()
            raise
        # Runs at garbage collection and at the end of the interpreter, if `close` did not.
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
                f"  start it with `--task {options.task}`, or make the environment of `{found}`"
            )
        request: dict[str, object] = {
            "client": connection.client,
            "num_envs": self.num_envs,
            "autoreset": autoreset,
            "max_episode_steps": max_episode_steps,
            "spec_hash": options.spec_hash,
        }
        lease = connection.request(connection.querier("lease"), request, options.reset_timeout_s)
        self.spec = codec.read_spec(lease, connection.hello["spec_hash"])
        self.lease: str = lease["lease"]
        self._epoch: int = lease["epoch"]
        self._last_seq: int = lease["last_seq"]
        self._methods = {
            method: connection.querier(f"env/{lease['lease']}/{method}") for method in ("reset", "step", "render", "close")
        }
        self._pending: tuple[str, Pending, float] | None = None

    def reset(self, seeds: NDArray[np.uint64] | None, mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
        """Start episodes anew.

        Parameters
        ----------
        seeds : (num_envs,) uint64, optional
            Without, each environment continues its random stream.
        mask : (num_envs,) bool, optional
            Where to reset; everywhere without.

        Returns
        -------
        obs : (num_envs, obs_len) float32
            Observations of all environments, reset or not.
        """
        self._resolve_abandoned_request()
        request: dict[str, object] = {}
        if seeds is not None:
            request["seeds"] = seeds.astype("<u8").tobytes()
        if mask is not None:
            request["mask"] = mask.astype(np.uint8).tobytes()
        self._send("reset", request)
        reply = self._await_pending(self._options.reset_timeout_s)
        return codec.tensor(reply, "obs", "<f4", self.num_envs, self.spec.obs_len)

    def send(self, actions: NDArray[Any]) -> None:
        """Send actions without waiting: the policy may compute while the server steps. :meth:`recv` is next."""
        if self._pending is not None:
            raise Error(
                f"the last `{self._pending[0]}` is not answered yet\n"
                "  `recv` waits for it again; `reset` settles it and starts anew"
            )
        self._send("step", {"actions": self._checked(actions).tobytes()})

    def recv(self) -> StepBatch:
        """Wait for what the sent actions gave. May be called again after a :class:`RequestTimeoutError`."""
        if self._pending is None:
            raise Error("nothing was sent: call `send` before `recv`")
        if self._pending[0] != "step":
            raise Error(f"the last `{self._pending[0]}` is not answered yet\n  `reset` settles it and starts anew")
        since = self._pending[2]
        reply = self._await_pending(self._options.timeout_s)
        n, k, obs_len = self.num_envs, len(reply.get("ended_env", b"")) // 4, self.spec.obs_len
        terms = len(self.spec.reward_terms)
        return StepBatch(
            obs=codec.tensor(reply, "obs", "<f4", n, obs_len),
            reward=codec.tensor(reply, "reward", "<f4", n),
            terminated=codec.tensor(reply, "terminated", "?", n),
            truncated=codec.tensor(reply, "truncated", "?", n),
            ended=codec.tensor(reply, "ended_env", "<u4", k).astype(np.int64),
            ended_length=codec.tensor(reply, "ended_length", "<u4", k).astype(np.int64),
            ended_terms=codec.tensor(reply, "ended_terms", "<f4", k, terms),
            final_obs=codec.tensor(reply, "final_obs", "<f4", k if reply.get("final_obs") else 0, obs_len),
            round_trip_s=time.monotonic() - since,
        )

    def scene(self, env: int) -> dict[str, Any]:
        """Shapes and poses of one robot and its ground, for drawing."""
        return self._connection.request(self._methods["render"], {"epoch": self._epoch, "env": env}, self._options.timeout_s)

    def close(self) -> None:
        """Give the environments back; does nothing the second time."""
        if not self._release.alive:
            return
        try:
            self._resolve_abandoned_request()
            request: dict[str, object] = {"epoch": self._epoch, "seq": self._last_seq + 1}
            self._connection.request(self._methods["close"], request, self._options.timeout_s)
        except Error:
            # Whatever is wrong with the server, this client is done with it; a lease that is left is freed in time.
            pass
        finally:
            self._release()

    def _send(self, method: str, request: dict[str, object]) -> None:
        if not self._release.alive:
            raise Error("the environment is closed")
        payload = codec.encode({**request, "epoch": self._epoch, "seq": self._last_seq + 1})
        self._pending = (method, Pending(self._methods[method], payload), time.monotonic())

    def _await_pending(self, timeout_s: float) -> dict[str, Any]:
        """Wait for the answer to the pending request.

        Without an answer it stays pending, because it may have been executed. Its number is used up by an answer, or
        by an error that had effects.
        """
        assert self._pending is not None
        try:
            reply = self._connection.wait_reply(self._pending[1], timeout_s)
        except (RequestTimeoutError, KeyboardInterrupt):
            raise
        except Error as error:
            self._pending = None
            self._last_seq += isinstance(error, RequestRejectedError) and error.code in _CONSUMES_SEQ
            raise
        self._pending = None
        self._last_seq += 1
        return reply

    def _resolve_abandoned_request(self) -> None:
        if self._pending is not None:
            try:
                self._await_pending(self._options.reset_timeout_s)
            except RequestTimeoutError:
                raise
            except Error:
                # Why it was refused no longer matters, only that its number is settled.
                pass

    def _checked(self, actions: NDArray[Any]) -> NDArray[np.float32]:
        given = np.asarray(actions)
        expected = (self.num_envs, self.spec.action_len)
        if given.shape != expected:
            raise InvalidActionError(f"`actions` has shape {given.shape}; {expected} is expected")
        if given.dtype.kind not in "fiu":
            raise InvalidActionError(f"`actions` has dtype {given.dtype}; float32 is expected")
        checked = np.ascontiguousarray(given, dtype="<f4")
        if not np.isfinite(checked).all():
            env, entry = (int(index) for index in np.argwhere(~np.isfinite(checked))[0])
            raise InvalidActionError(
                f"the action of environment {env}, {self.spec.action_entry(entry)}, is {checked[env, entry]}\n"
                "  nothing was stepped; look at what computed the action"
            )
        return checked


def _flags(options: ConnectOptions) -> tuple[str, ...]:
    flags = ["--task", options.task, "--envs", _CAPACITY]
    if options.config is not None:
        flags += ["--config", options.config]
    if options.model is not None:
        flags += ["--model", options.model]
    return tuple(flags)


def _release(connection: Connection, server: EmbeddedServer | None) -> None:
    connection.close()
    if server is not None:
        server.release()
