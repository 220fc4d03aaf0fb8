"""Views of the single robots of a vector environment, for access to attributes and methods by name."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .vector_env import Go2VectorEnv

_SHARED = {
    "spec": "spec",
    "twinstep_spec": "twinstep_spec",
    "render_mode": "render_mode",
    "metadata": "metadata",
    "observation_space": "single_observation_space",
    "action_space": "single_action_space",
}
"""Attributes of a row, and the attributes of the vector environment that hold their values."""

_OWN = ("index", "reset", "render")


class SubEnvView:
    """View of one robot, for ``get_attr``, ``set_attr`` and ``call`` of Gymnasium and Stable-Baselines3.

    Attributes
    ----------
    index
        Row of the robot in every array.
    spec, twinstep_spec, render_mode, metadata
        Those of the vector environment, equal for all robots.
    observation_space, action_space
        Spaces of one robot.

    Notes
    -----
    Other attributes can be set. They belong to one robot and exist only in this process: the server does not read them.
    """

    __slots__ = ("_attributes", "_envs", "index")

    index: int
    _envs: "Go2VectorEnv"
    _attributes: dict[str, Any]

    def __init__(self, envs: "Go2VectorEnv", index: int, attributes: dict[str, Any]) -> None:
        for name, value in (("index", index), ("_envs", envs), ("_attributes", attributes)):
            object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Any:
        if name in _SHARED:
            return getattr(self._envs, _SHARED[name])
        # A copy asks for private names before `__init__` has set any.
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._attributes:
            return self._attributes[name]
        known = ", ".join([*_OWN, *_SHARED, *self._attributes])
        raise AttributeError(f"an environment has no attribute `{name}`; it has {known}")

    def __setattr__(self, name: str, value: object) -> None:
        if name in _SHARED:
            raise AttributeError(
                f"`{name}` is the same for all robots and cannot be set; create new environments with it"
            )
        if name in _OWN or name.startswith("_"):
            raise AttributeError(f"`{name}` cannot be set")
        self._attributes[name] = value

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode of this robot. The episodes of the others continue.

        Returns
        -------
        obs : (45,) float32
        info : dict
            With the option ``critic``: ``critic_obs``, (critic_len,) float32. Else empty.
        """
        mask = np.arange(self._envs.num_envs) == self.index
        seeds = None if seed is None else np.where(mask, seed, 0).tolist()
        obs, infos = self._envs.reset(seed=seeds, options={**(options or {}), "reset_mask": mask})
        return obs[self.index], {name: values[self.index] for name, values in infos.items() if name[0] != "_"}

    def render(self) -> NDArray[np.uint8] | None:
        """Render the robot: (480, 640, 3) uint8 with ``render_mode="rgb_array"``, else ``None``."""
        return self._envs.draw(self.index) if self._envs.render_mode == "rgb_array" else None
