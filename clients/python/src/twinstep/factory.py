"""Factory of environments for other processes."""

from dataclasses import asdict, dataclass, field
from typing import cast

from .env import Go2Env, OptionArguments, RenderMode
from .options import ConnectOptions


@dataclass(frozen=True)
class EnvFactory:
    """Creates a :class:`Go2Env` at each call. Unlike an environment, it can be pickled.

    Attributes
    ----------
    options
        Server and task. Without an endpoint, each process starts a server of its own.
    max_episode_steps
        Policy steps after which the server truncates an episode. Default: 1000, as in ``gymnasium.make``.
    render_mode, info_timing
        As for :class:`Go2Env`.

    Examples
    --------
    >>> factory = EnvFactory(ConnectOptions(endpoint="tcp/127.0.0.1:7447"))
    >>> envs = gymnasium.vector.AsyncVectorEnv([factory] * 4, context="spawn")  # doctest: +SKIP
    """

    options: ConnectOptions = field(default_factory=ConnectOptions)
    max_episode_steps: int = 1000
    render_mode: RenderMode | None = None
    info_timing: bool = False

    def __call__(self) -> Go2Env:
        """Create an environment."""
        return Go2Env(
            max_episode_steps=self.max_episode_steps,
            render_mode=self.render_mode,
            info_timing=self.info_timing,
            **cast(OptionArguments, asdict(self.options)),
        )
