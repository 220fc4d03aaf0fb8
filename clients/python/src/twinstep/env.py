"""One robot as a Gymnasium environment."""

from collections.abc import Sequence
from typing import Any, Literal, TypedDict, Unpack

import gymnasium
import numpy as np
from numpy.typing import NDArray

from .codec import Spec
from .discovery import ServerInfo
from .errors import InvalidActionError, InvalidOptionError
from .grouped import AllGroups
from .options import UNLIMITED, ConnectOptions
from .pickling import NotPicklable
from .remote import RemoteVecEnv
from .render import Viewer
from .sharded import ShardedVecEnv
from .spaces import action_space, observation_space
from .step import StepBatch

RenderMode = Literal["rgb_array", "human"]


class OptionArguments(TypedDict, total=False):
    """Keyword arguments that :class:`Go2Env` and :class:`Go2VectorEnv` pass to :class:`twinstep.ConnectOptions`."""

    endpoint: str | None
    robot: str | None
    task: str
    config: str | None
    model: str | None
    zenoh_config: str | None
    shared_memory: bool
    spec_hash: str | None
    critic: bool
    timeout_s: float
    reset_timeout_s: float
    connect_timeout_s: float


class VectorOptionArguments(OptionArguments, total=False):
    """Keyword arguments of vector environments: also several servers, see :class:`twinstep.ShardedVecEnv`."""

    endpoints: Sequence[str | ServerInfo] | None


class Go2Env(NotPicklable, gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One robot, simulated or real.

    Parameters
    ----------
    render_mode
        ``"rgb_array"``, ``"human"`` (needs the extra ``[render]``), or ``None``.
    max_episode_steps
        Policy steps after which the server truncates an episode. With ``None`` the time limit is that of
        ``gymnasium.make``.
    info_timing
        Adds ``round_trip_s`` [s] to the info of every step. Without it, infos depend only on seed and actions.
    **options
        See :class:`twinstep.ConnectOptions`.

    Notes
    -----
    Observation (45,) and action (12,) are float32; ``docs/go2-walk.md`` lists their entries with units and frames.
    """

    # `gymnasium.make` reads the modes here. An environment adds `render_fps`, the rate of its policy.
    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"]}  # noqa: RUF012

    def __init__(
        self,
        *,
        render_mode: RenderMode | None = None,
        max_episode_steps: int | None = None,
        info_timing: bool = False,
        **options: Unpack[OptionArguments],
    ) -> None:
        checked_mode = checked_render_mode(render_mode)
        self.render_mode = checked_mode
        self._info_timing = info_timing
        self._remote = RemoteVecEnv(
            ConnectOptions(**options),
            num_envs=1,
            autoreset="Disabled",
            max_episode_steps=UNLIMITED if max_episode_steps is None else max_episode_steps,
        )
        self._viewer = open_viewer(checked_mode, self._remote)
        self.twinstep_spec = self._remote.spec
        self.metadata = {**self.metadata, "render_fps": render_fps(self._remote.spec)}
        self.observation_space = observation_space(self._remote.spec)
        self.action_space = action_space(self._remote.spec)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Parameters
        ----------
        seed
            Equal seeds give equal episodes. ``None`` continues the random stream.
        options
            Not supported.

        Returns
        -------
        obs : (45,) float32
        info : dict
            With the option ``critic``: ``critic_obs``, (critic_len,) float32. Else empty.
        """
        super().reset(seed=seed)
        if options:
            raise InvalidOptionError(f"`options` has {sorted(options)}; a single environment has no options")
        seeds = None if seed is None else np.array([seed], dtype=np.uint64)
        obs = self._remote.reset(seeds, None)[0]
        self._show()
        return obs, self._critic_info()

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one policy period (20 ms).

        Parameters
        ----------
        action : (12,) float32
            Offsets from the default pose in units of ``action_scale``, joints in the spec's order.

        Returns
        -------
        obs : (45,) float32
        reward : float
        terminated, truncated : bool
        info : dict
            At the end of an episode ``reward_terms``, the episode's sum of each weighted reward term, and
            ``diverged`` if the simulation became NaN or infinite. With the option ``critic``: ``critic_obs``. On a
            robot in real time: ``tick``, ``stamp_ns``, ``late_ticks``, ``applied`` (12,), and ``refused`` and
            ``fault`` if there are any, as in ``protocol/SPEC.md``.
        """
        self.send(action)
        return self.recv()

    def set_velocity_command(self, command: NDArray[np.float32]) -> None:
        """Set the velocity command of every later step and episode, in place of the task's own.

        Parameters
        ----------
        command : (3,) float32
            Forward [m/s], left [m/s], yaw rate [rad/s], within the bounds of ``velocity_command`` in the spec. A server
            that is older than this command ignores it.
        """
        self._remote.set_velocity_commands(np.asarray(command)[None])

    def set_gait_command(self, command: NDArray[np.float32]) -> None:
        """Set the gait command of every later step and episode of the task ``gait``, in place of the task's own.

        Parameters
        ----------
        command : (4,) float32
            Step frequency [Hz], phases of FR, RL and RR relative to FL [cycles], within the bounds of
            ``step_frequency`` and ``phase_offset`` in the spec. A server that is older than this command ignores it.
        """
        self._remote.set_gait_commands(np.asarray(command)[None])

    def send(self, action: NDArray[np.float32]) -> None:
        """Send an action without waiting. Call :meth:`recv` next."""
        given = np.asarray(action)
        if given.shape != self.action_space.shape:
            raise InvalidActionError(f"`action` has shape {given.shape}; {self.action_space.shape} is expected")
        self._remote.send(given[None])

    def recv(self) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Wait for the result of the action; may be called again after a ``RequestTimeoutError``."""
        batch = self._remote.recv()
        info = {**self._critic_info(), **batch.robot}
        if len(batch.ended):
            info["reward_terms"] = reward_terms(batch, 0, self.twinstep_spec.reward_terms)
            if batch.ended_diverged[0]:
                info["diverged"] = True
        if self._info_timing:
            info["round_trip_s"] = batch.round_trip_s
        self._show()
        return batch.obs[0], float(batch.reward[0]), bool(batch.terminated[0]), bool(batch.truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Render the robot: (480, 640, 3) uint8 with ``render_mode="rgb_array"``, else ``None``."""
        if self.render_mode is None:
            gymnasium.logger.warn("render was called, but `render_mode` is not set: make(..., render_mode='rgb_array')")
            return None
        image = self._draw()
        return image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """End the lease and close the window."""
        if self._viewer is not None:
            self._viewer.close()
        self._remote.close()

    def _critic_info(self) -> dict[str, Any]:
        return {"critic_obs": self._remote.critic_obs[0]} if self.twinstep_spec.critic_len > 0 else {}

    def _show(self) -> None:
        if self.render_mode == "human":
            self._draw()

    def _draw(self) -> NDArray[np.uint8]:
        assert self._viewer is not None
        return self._viewer.draw(self._remote.scene(0))


def checked_render_mode(mode: str | None) -> RenderMode | None:
    """Return ``mode`` if it is a valid render mode."""
    if mode is None or mode == "rgb_array" or mode == "human":
        return mode
    raise InvalidOptionError(f"`render_mode` = {mode!r}; expected is 'rgb_array', 'human' or None")


def render_fps(spec: Spec) -> int:
    """Return the rate of the policy [Hz], at which a video of one image per step has the speed of the robot."""
    return max(1, round(1 / spec.policy_dt))


def open_viewer(mode: RenderMode | None, remote: RemoteVecEnv | ShardedVecEnv | AllGroups) -> Viewer | None:
    """Return the viewer of a render mode. Ends the lease if there is none, because pygame is not installed."""
    try:
        return None if mode is None else Viewer(mode, fps=render_fps(remote.spec))
    except BaseException:
        remote.close()
        raise


def reward_terms(batch: StepBatch, index: int, names: tuple[str, ...]) -> dict[str, float]:
    """Return the sum of each weighted reward term of the ``index``-th episode that ended."""
    return {name: float(value) for name, value in zip(names, batch.ended_terms[index], strict=True)}
