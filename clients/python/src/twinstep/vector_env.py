"""Gymnasium vector environment of many robots, which one message steps."""

from collections.abc import Sequence
from functools import partial
from typing import Any, Unpack, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from .discovery import ServerInfo
from .env import OptionArguments, RenderMode, checked_render_mode, open_viewer, render_fps, reward_terms
from .errors import InvalidOptionError
from .grouped import AllGroups
from .options import ConnectOptions
from .pickling import NotPicklable
from .remote import RemoteVecEnv
from .render import Viewer
from .rollout import GaussianPolicy, Trajectory
from .sharded import ShardedVecEnv
from .spaces import action_space, observation_space
from .step import StepBatch
from .sub_env import SubEnvView

StepResult = tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


class Go2VectorEnv(NotPicklable, VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """``num_envs`` robots on one server. Row i with seed s equals the single environment with seed s + i.

    Parameters
    ----------
    num_envs
        Number of robots.
    autoreset_mode
        ``AutoresetMode`` or its value, ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``; executed by the server.
    max_episode_steps
        Policy steps after which an episode is truncated. ``None``: the number of the task.
    render_mode
        As for :class:`Go2Env`; ``"human"`` shows the first robot.
    info_timing
        Adds ``round_trip_s`` [s] to the info of every step. Without it, infos depend only on seeds and actions.
    endpoints
        Endpoints of several servers, or results of :func:`twinstep.discover`, among which the robots are divided; see
        :class:`twinstep.ShardedVecEnv`. Not allowed with ``endpoint``.
    groups
        Number of groups of robots with a lease each. The server steps one group while it receives and sends others.
        Results do not depend on it. An agent that steps group by group uses :class:`twinstep.GroupedVecEnv`.
    **options
        See :class:`twinstep.ConnectOptions`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: RenderMode | None = None,
        info_timing: bool = False,
        endpoints: Sequence[str | ServerInfo] | None = None,
        groups: int = 1,
        **options: Unpack[OptionArguments],
    ) -> None:
        mode = _autoreset_mode(autoreset_mode)
        checked_mode = checked_render_mode(render_mode)
        self.render_mode = checked_mode
        self._mode = mode
        self._info_timing = info_timing
        settings = ConnectOptions(**options)
        if endpoints is not None and groups != 1:
            raise InvalidOptionError(f"`groups` = {groups} and `endpoints` are set; one of them is expected")
        if endpoints is not None:
            create = partial(ShardedVecEnv, settings, endpoints)
        else:
            create = partial(RemoteVecEnv, settings) if groups == 1 else partial(AllGroups, settings, groups)
        self._remote = create(num_envs=num_envs, autoreset=mode.value, max_episode_steps=max_episode_steps)
        self._viewer = open_viewer(checked_mode, self._remote)
        self.num_envs = num_envs
        self.twinstep_spec = self._remote.spec
        self.metadata = {
            "render_modes": ["rgb_array", "human"],
            "render_fps": render_fps(self._remote.spec),
            "autoreset_mode": mode,
        }
        self.single_observation_space = observation_space(self._remote.spec)
        self.single_action_space = action_space(self._remote.spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._attributes: list[dict[str, Any]] = [{} for _ in range(num_envs)]

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,  # pyright: ignore[reportIncompatibleMethodOverride]
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes.

        Parameters
        ----------
        seed
            Environment i has the seed ``seed + i``, or entry i of a sequence. ``None`` continues the random streams,
            as an entry that of its environment. A sequence with both sends two requests.
        options
            ``{"reset_mask": mask}``, mask (num_envs,) bool, resets only the environments where it is true.

        Returns
        -------
        obs : (num_envs, 45) float32
            Observations of all environments, reset or not.
        info : dict
            With the option ``critic``: ``critic_obs``, (num_envs, critic_len) float32. Else empty.
        """
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=None if seed is None else int(seed))
        seeds, seeded = self._seeds(seed)
        obs = self._remote.reset(seeds, self._mask(options), seeded)
        self._show()
        return obs, self._critic_info()

    @property
    def lease(self) -> str:
        """Id of the lease, as in the server's log."""
        return self._remote.lease

    def step(self, actions: NDArray[np.float32]) -> StepResult:
        """Advance every environment by one policy period (20 ms).

        Parameters
        ----------
        actions : (num_envs, 12) float32
            Offsets from the default pose in units of ``action_scale``, joints in the spec's order.

        Returns
        -------
        obs : (num_envs, 45) float32
        reward : (num_envs,) float64
        terminated, truncated : (num_envs,) bool
        info : dict
            ``reward_terms`` of the episodes that ended; with ``"SameStep"`` in ``final_info``, next to ``final_obs``.
            ``diverged`` is next to ``reward_terms`` for robots whose simulation became NaN or infinite.
            With ``endpoints``: ``lost`` in place of ``reward_terms`` for robots whose server was lost in this step, and
            ``held``, (num_envs,) bool, true for robots whose action was not executed because they have no server.
            With the option ``critic``: ``critic_obs``, and ``critic_obs`` in ``final_info``.
        """
        self.send(actions)
        return self.recv()

    def set_velocity_commands(self, commands: NDArray[np.float32]) -> None:
        """Set the velocity commands of every later step and episode, in place of the task's own.

        Parameters
        ----------
        commands : (num_envs, 3) float32
            Forward [m/s], left [m/s], yaw rate [rad/s], within the bounds of ``velocity_command`` in the spec. A server
            that is older than these commands ignores them.
        """
        self._remote.set_velocity_commands(commands)

    def set_gait_commands(self, commands: NDArray[np.float32]) -> None:
        """Set the gait commands of every later step and episode of the task ``gait``, in place of the task's own.

        Parameters
        ----------
        commands : (num_envs, 4) float32
            Step frequency [Hz], phases of FR, RL and RR relative to FL [cycles], within the bounds of
            ``step_frequency`` and ``phase_offset`` in the spec. A server that is older than these commands ignores
            them.
        """
        self._remote.set_gait_commands(commands)

    def send(self, actions: NDArray[np.float32]) -> None:
        """Send actions without waiting, so that the caller can compute during the step. Call :meth:`recv` next."""
        self._remote.send(actions)

    def recv(self) -> StepResult:
        """Wait for the result of the actions; may be called again after a ``RequestTimeoutError``."""
        batch = self._remote.recv()
        infos = self._infos(batch)
        self._show()
        return batch.obs, batch.reward.astype(np.float64), batch.terminated, batch.truncated, infos

    def rollout(self, policy: GaussianPolicy, steps: int, *, noise_seed: int) -> Trajectory:
        """Run a policy on the server for some steps of all environments: one request instead of one for each step.

        Starts from the current observations, so call :meth:`reset` before the first rollout. ``step`` may follow. Not
        available in the autoreset mode ``"Disabled"``, and with ``endpoints`` or ``groups``: a learner with several
        servers has an environment for each of them.

        Parameters
        ----------
        policy
            The policy, which samples its actions on the server. Its weights are sent only if they have changed.
        steps
            Number of steps, 1 to ``max_rollout_steps`` of the server.
        noise_seed
            The noise of environment i is a function of ``noise_seed + i`` alone. Use another one for each rollout.
        """
        if not isinstance(self._remote, RemoteVecEnv):
            raise InvalidOptionError("`rollout` needs one lease; create an environment for each endpoint or group")
        trajectory = self._remote.rollout(policy, steps, noise_seed=noise_seed)
        self._show()
        return trajectory

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Render every robot: a tuple of (480, 640, 3) uint8 with ``render_mode="rgb_array"``, else ``None``."""
        if self.render_mode is None:
            gymnasium.logger.warn("render was called, but `render_mode` is not set: make(..., render_mode='rgb_array')")
            return None
        if self.render_mode == "human":
            self._show()
            return None
        return tuple(self.draw(env) for env in range(self.num_envs))

    def sub_env(self, index: int) -> SubEnvView:
        """Return a view of one robot, which has the attributes and methods of :meth:`call`."""
        return SubEnvView(self, index, self._attributes[index])

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every robot, or return an attribute: one value per robot, as in ``SyncVectorEnv``.

        Parameters
        ----------
        name
            Name in :class:`twinstep.sub_env.SubEnvView`: ``render``, ``reset``, ``spec``, ``metadata``, ….

        Raises
        ------
        AttributeError
            There is no such method or attribute; the message contains the names that exist.
        """
        # All are looked up before the first is called.
        found = [getattr(self.sub_env(index), name) for index in range(self.num_envs)]
        return tuple(one(*args, **kwargs) if callable(one) else one for one in found)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of every robot, see :meth:`call`."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every robot in this process; the server does not read it.

        Parameters
        ----------
        name
            Name of the attribute. Attributes that come from the server cannot be set.
        values
            A list or tuple with one value per robot, or one value for all.
        """
        given = cast(Sequence[Any], values if isinstance(values, list | tuple) else [values] * self.num_envs)
        if len(given) != self.num_envs:
            raise InvalidOptionError(f"`values` has {len(given)} entries; {self.num_envs} are expected")
        for index, value in enumerate(given):
            setattr(self.sub_env(index), name, value)

    def close_extras(self, **kwargs: Any) -> None:
        """End the lease and close the window."""
        viewer: Viewer | None = getattr(self, "_viewer", None)
        if viewer is not None:
            viewer.close()
        if hasattr(self, "_remote"):
            self._remote.close()

    def _seeds(
        self, seed: int | Sequence[int | None] | None
    ) -> tuple[NDArray[np.uint64] | None, NDArray[np.bool_] | None]:
        """Return the seed of each environment, and which of them have one; ``None``: none, and all."""
        if seed is None:
            return None, None
        if isinstance(seed, int | np.integer):
            return (np.arange(self.num_envs, dtype=np.uint64) + np.uint64(seed)).astype(np.uint64), None
        if len(seed) != self.num_envs:
            raise InvalidOptionError(f"`seed` has {len(seed)} entries; {self.num_envs} are expected")
        negative = [one for one in seed if one is not None and one < 0]
        if negative:
            raise InvalidOptionError(f"`seed` has {negative[0]}; must be 0 or more")
        seeds = np.array([one or 0 for one in seed], dtype=np.uint64)
        return seeds, np.array([one is not None for one in seed], dtype=np.bool_)

    def _mask(self, options: dict[str, Any] | None) -> NDArray[np.bool_] | None:
        unknown = sorted(set(options or ()) - {"reset_mask"})
        if unknown:
            raise InvalidOptionError(f"`options` has {unknown}; only 'reset_mask' is supported")
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return None
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise InvalidOptionError(
                f"`options['reset_mask']` is {mask.dtype} {mask.shape}; bool ({self.num_envs},) is expected"
            )
        if not mask.any():
            raise InvalidOptionError("`options['reset_mask']` has no true entry; at least one is expected")
        return mask

    def _infos(self, batch: StepBatch) -> dict[str, Any]:
        infos = self._critic_info()
        if batch.robot:
            infos = self._add_info(infos, batch.robot, 0)
        names = self.twinstep_spec.reward_terms
        for index, env in enumerate(batch.ended):
            lost = bool(batch.ended_lost[index])
            info: dict[str, Any] = {"lost": True} if lost else {"reward_terms": reward_terms(batch, index, names)}
            if batch.ended_diverged[index]:
                info["diverged"] = True
            if self._mode is AutoresetMode.SAME_STEP:
                if self.twinstep_spec.critic_len > 0:
                    info["critic_obs"] = batch.final_critic_obs[index]
                info = {"final_obs": batch.final_obs[index], "final_info": info}
            infos = self._add_info(infos, info, int(env))
        if batch.held.any():
            infos["held"] = batch.held
            infos["_held"] = np.ones(self.num_envs, dtype=np.bool_)
        if self._info_timing:
            infos["round_trip_s"] = np.full(self.num_envs, batch.round_trip_s)
            infos["_round_trip_s"] = np.ones(self.num_envs, dtype=np.bool_)
        return infos

    def _critic_info(self) -> dict[str, Any]:
        if self.twinstep_spec.critic_len == 0:
            return {}
        return {"critic_obs": self._remote.critic_obs, "_critic_obs": np.ones(self.num_envs, dtype=np.bool_)}

    def _show(self) -> None:
        if self.render_mode == "human":
            self.draw(0)

    def draw(self, env: int) -> NDArray[np.uint8]:
        """Render one robot: (480, 640, 3) uint8; requires a ``render_mode``."""
        assert self._viewer is not None
        return self._viewer.draw(self._remote.scene(env))


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(repr(known.value) for known in AutoresetMode)
        raise InvalidOptionError(f"`autoreset_mode` = {mode!r}; expected is one of {known}") from error
