"""``VecEnv`` of ``rsl_rl`` 5 with many robots. Requires the extra ``[rsl-rl]``."""

from dataclasses import asdict
from typing import Any, Unpack, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from .env import VectorOptionArguments
from .errors import InvalidOptionError
from .pickling import NotPicklable
from .vector_env import Go2VectorEnv

try:
    import torch
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError as error:
    raise ImportError('rsl_rl is not installed here\n  pip install "twinstep[rsl-rl]"') from error


def make_vec_env(
    env_id: str = "twinstep/Go2-Walk-v0",
    num_envs: int = 1,
    *,
    seed: int | None = None,
    max_episode_steps: int | None = None,
    device: str = "cpu",
    **options: Unpack[VectorOptionArguments],
) -> "Go2VecEnv":
    """Create robots for an ``OnPolicyRunner``.

    Parameters
    ----------
    env_id
        Registered id of the task.
    num_envs
        Number of robots.
    seed
        Environment i has the seed ``seed + i``.
    max_episode_steps
        Policy steps after which an episode is truncated. ``None``: the number of the task.
    device
        Device of the returned tensors.
    **options
        See :class:`twinstep.ConnectOptions`, and ``endpoints`` of :class:`twinstep.Go2VectorEnv`.
    """
    arguments: dict[str, Any] = dict(options)
    if max_episode_steps is not None:
        arguments["max_episode_steps"] = max_episode_steps
    envs = gymnasium.make_vec(env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **arguments)
    return Go2VecEnv(cast(Go2VectorEnv, envs), seed=seed, device=device)


class Go2VecEnv(NotPicklable, VecEnv):
    """Robots on one server as a ``VecEnv`` with the observation group ``"policy"``.

    With the option ``critic``, there is also the privileged group ``"critic"``: ``obs_groups`` of the runner is then
    ``{"actor": ["policy"], "critic": ["policy", "critic"]}``.

    Parameters
    ----------
    envs
        Robots with ``autoreset_mode="SameStep"``, which rsl_rl requires.
    seed
        Environment i has the seed ``seed + i``.
    device
        Device of the returned tensors.

    Attributes
    ----------
    episode_length_buf : (num_envs,) int64
        Policy steps since the start of each episode. The runner writes to it so that episodes end at different times.
    """

    def __init__(self, envs: Go2VectorEnv, *, seed: int | None = None, device: str = "cpu") -> None:
        mode = envs.metadata["autoreset_mode"]
        if mode is not AutoresetMode.SAME_STEP:
            raise InvalidOptionError(f"`autoreset_mode` = {mode.value!r}; rsl_rl needs 'SameStep'")
        self.envs = envs
        self.twinstep_spec = envs.twinstep_spec
        self.num_envs = envs.num_envs
        self.num_actions = envs.twinstep_spec.action_len
        self.max_episode_length = envs.twinstep_spec.max_episode_steps
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=device)
        self.device = device
        self.cfg = asdict(envs.twinstep_spec)
        self._obs, self._info = envs.reset(seed=seed)

    def get_observations(self) -> TensorDict:
        """Return the last observations: ``policy``, (num_envs, 45) float32, and ``critic`` if it was requested."""
        groups = {"policy": self._tensor(self._obs)}
        if "critic_obs" in self._info:
            groups["critic"] = self._tensor(self._info["critic_obs"])
        return TensorDict(groups, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance every environment by one policy period (20 ms).

        Parameters
        ----------
        actions : (num_envs, 12) float32
            Offsets from the default pose in units of ``action_scale``; the server clips them to [-1, 1].

        Returns
        -------
        obs : TensorDict
            ``policy``, (num_envs, 45) float32. Where an episode ended, the first observation of the next.
        reward : (num_envs,) float32
        done : (num_envs,) bool
        extras : dict
            ``time_outs``, (num_envs,) float32, 1 where the time limit ended the episode. In a step that ended episodes
            also ``log``, the mean of each of their weighted reward terms.
        """
        self._obs, reward, terminated, truncated, step_info = self.envs.step(actions.detach().cpu().numpy())
        self._info = step_info
        self.episode_length_buf += 1
        # The buffer exceeds the server's count only if the runner has written to it.
        at_limit = self.episode_length_buf.cpu().numpy() >= self.max_episode_length
        early = at_limit & ~terminated & ~truncated
        if early.any():
            self._obs, self._info = self.envs.reset(options={"reset_mask": early})
            truncated = truncated | early
        done = self._tensor(terminated | truncated)
        self.episode_length_buf[done] = 0
        extras: dict[str, Any] = {"time_outs": self._tensor((truncated & ~terminated).astype(np.float32))}
        if "reward_terms" in step_info.get("final_info", {}):
            extras["log"] = _mean_terms(step_info["final_info"]["reward_terms"])
        return self.get_observations(), self._tensor(reward.astype(np.float32)), done, extras

    def close(self) -> None:
        """End the lease. Further calls have no effect."""
        self.envs.close()

    def _tensor(self, array: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(array).to(self.device)


def _mean_terms(terms: dict[str, NDArray[Any]]) -> dict[str, float]:
    """Return the mean of each reward term over the environments in the mask ``_<term>``, whose episode ended."""
    return {
        f"/reward/{name}": float(values[terms[f"_{name}"]].mean())
        for name, values in terms.items()
        if not name.startswith("_")
    }
