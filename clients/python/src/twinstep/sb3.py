"""Stable-Baselines3 ``VecEnv`` of many robots. Requires the extra ``[sb3]``."""

from collections.abc import Iterable, Sequence
from typing import Any, Unpack, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from .env import RenderMode, VectorOptionArguments
from .errors import InvalidOptionError
from .pickling import NotPicklable
from .sub_env import SubEnvView
from .vector_env import Go2VectorEnv

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError('Stable-Baselines3 is not installed here\n  pip install "twinstep[sb3]"') from error

Indices = int | Iterable[int] | None
"""Indices of environments; ``None``: all."""


def make_vec_env(
    env_id: str = "twinstep/Go2-Walk-v0",
    n_envs: int = 1,
    *,
    seed: int | None = None,
    max_episode_steps: int | None = None,
    render_mode: RenderMode | None = None,
    **options: Unpack[VectorOptionArguments],
) -> "Go2VecEnv":
    """Create robots for an agent of Stable-Baselines3, like its function ``make_vec_env``.

    Parameters
    ----------
    env_id
        Registered id of the task.
    n_envs
        Number of robots.
    seed
        Environment i has the seed ``seed + i``. ``None``: a random seed from NumPy's global generator.
    max_episode_steps
        Policy steps after which an episode is truncated. ``None``: the number of the task.
    render_mode
        ``"rgb_array"``, ``"human"`` (shows the first robot), or ``None``.
    **options
        See :class:`twinstep.ConnectOptions`, and ``endpoints`` of :class:`twinstep.Go2VectorEnv`.

    Notes
    -----
    Use ``VecMonitor(make_vec_env(...))`` to record rewards and lengths of episodes.
    """
    arguments: dict[str, Any] = {**options, "render_mode": render_mode}
    if max_episode_steps is not None:
        arguments["max_episode_steps"] = max_episode_steps
    envs = gymnasium.make_vec(env_id, num_envs=n_envs, autoreset_mode=AutoresetMode.SAME_STEP, **arguments)
    vec_env = Go2VecEnv(cast(Go2VectorEnv, envs))
    vec_env.seed(seed)
    return vec_env


class Go2VecEnv(NotPicklable, VecEnv):
    """Robots on one server as a ``VecEnv``.

    Parameters
    ----------
    envs
        Robots with ``autoreset_mode="SameStep"``, which Stable-Baselines3 requires.
    """

    def __init__(self, envs: Go2VectorEnv) -> None:
        mode = envs.metadata["autoreset_mode"]
        if mode is not AutoresetMode.SAME_STEP:
            raise InvalidOptionError(f"`autoreset_mode` = {mode.value!r}; Stable-Baselines3 needs 'SameStep'")
        self.envs = envs
        self.twinstep_spec = envs.twinstep_spec
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        # VecVideoRecorder reads the frame rate here.
        self.metadata = {**envs.metadata, **self.metadata}

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes, with the seeds of :meth:`seed` the first time; later the random streams continue.

        Returns
        -------
        obs : (n_envs, 45) float32
        """
        obs, infos = self.envs.reset(seed=list(self._seeds))
        self._reset_seeds()
        self.reset_infos = [_critic_info(infos, env) for env in range(self.num_envs)]
        return obs

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Send actions, (n_envs, 12) float32, without waiting."""
        self.envs.send(actions)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Wait for the result of the actions.

        Returns
        -------
        obs : (n_envs, 45) float32
            Where an episode ended, the first observation of the next.
        reward : (n_envs,) float32
        done : (n_envs,) bool
        infos : list of dict
            ``TimeLimit.truncated``. Where an episode ended also ``terminal_observation`` and ``reward_terms``, the sum
            of each weighted reward term over the episode. With the option ``critic``: ``critic_obs``, (critic_len,)
            float32, and where an episode ended ``terminal_critic_obs``. With ``endpoints``: ``held`` is True where the
            action was not executed because the robot has no server, and ``lost`` where the server was lost.
        """
        obs, reward, terminated, truncated, vector_info = self.envs.recv()
        done = terminated | truncated
        infos = [{"TimeLimit.truncated": False, **_critic_info(vector_info, env)} for env in range(self.num_envs)]
        for env in map(int, np.flatnonzero(vector_info.get("held", ()))):
            infos[env]["held"] = True
        for env in map(int, np.flatnonzero(done)):
            self.reset_infos[env] = _critic_info(vector_info, env)
            final = _info_of(vector_info["final_info"], env)
            if "critic_obs" in final:
                final["terminal_critic_obs"] = final.pop("critic_obs")
            infos[env] |= {
                "TimeLimit.truncated": bool(truncated[env] and not terminated[env]),
                "terminal_observation": vector_info["final_obs"][env],
                **final,
            }
        return obs, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """End the lease. Further calls have no effect."""
        self.envs.close()

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Reject options, because the reset of a robot has none."""
        given = options if isinstance(options, list) else [options or {}]
        names = sorted({name for of_env in given for name in of_env})
        if names:
            raise InvalidOptionError(f"`options` has {names}; the reset of a robot has no options")

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Render every robot, (480, 640, 3) uint8 each; ``None`` each unless ``render_mode="rgb_array"``."""
        return self.envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of :class:`SubEnvView` of each of the environments ``indices``."""
        return [getattr(row, attr_name) for row in self._sub_envs(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute on the client side for each of the environments ``indices``."""
        for row in self._sub_envs(indices):
            setattr(row, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of :class:`SubEnvView` on each of the environments ``indices``."""
        return [getattr(row, method_name)(*method_args, **method_kwargs) for row in self._sub_envs(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        """Return ``False`` for each of the environments ``indices``: they have no wrappers."""
        return [False for _ in self._sub_envs(indices)]

    def _sub_envs(self, indices: Indices) -> list[SubEnvView]:
        return [self.envs.sub_env(index) for index in self._get_indices(indices)]


def _critic_info(vector_info: dict[str, Any], env: int) -> dict[str, Any]:
    """Return the privileged observation of one environment; empty without the option ``critic``."""
    return {"critic_obs": vector_info["critic_obs"][env]} if "critic_obs" in vector_info else {}


def _info_of(vector_info: dict[str, Any], env: int) -> dict[str, Any]:
    """Return the info of one environment from those of all: each ``key`` has a mask ``_key``."""
    info: dict[str, Any] = {}
    for key, values in vector_info.items():
        if key.startswith("_") or not vector_info[f"_{key}"][env]:
            continue
        if isinstance(values, dict):
            info[key] = _info_of(cast(dict[str, Any], values), env)
        else:
            info[key] = values[env] if np.ndim(values[env]) else values[env].item()
    return info
