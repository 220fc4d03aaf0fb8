"""Simulated and real Unitree Go2 robots as Gymnasium environments.

>>> import gymnasium as gym
>>> import twinstep
>>> envs = gym.make_vec("twinstep/Go2-Walk-v0", num_envs=64)  # doctest: +SKIP

``endpoint=`` selects a remote server or the robot. By default the bundled server starts on this machine and terminates
with this process.
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

import gymnasium

from .checker import VecEnvError, check_vec_env
from .codec import MalformedError, Spec, SpecField
from .discovery import ServerInfo, discover
from .env import Go2Env
from .errors import (
    AmbiguousRobotError,
    Error,
    ForkedProcessError,
    InvalidActionError,
    InvalidOptionError,
    LeaseLostError,
    NoServerError,
    NotPicklableError,
    RequestRejectedError,
    RequestTimeoutError,
    ResetNeededError,
    ServerExitedError,
    SpecMismatchError,
    VersionError,
)
from .factory import EnvFactory
from .grouped import GroupedVecEnv
from .measured import (
    Adaptation,
    CommandError,
    Comparison,
    Diagnosis,
    Effect,
    Estimate,
    Identification,
    ModelErrors,
    adapt,
    diagnose,
    evaluate,
    identify,
)
from .options import ConnectOptions
from .remote import RemoteVecEnv
from .rollout import GaussianPolicy, Trajectory
from .server import EmbeddedServer, ServerNotFoundError, ServerStartError
from .sharded import ShardedVecEnv
from .step import StepBatch
from .stop import stop_robot
from .vector_env import Go2VectorEnv

if TYPE_CHECKING:
    from . import rsl_rl as rsl_rl
    from . import sb3 as sb3

__all__ = [
    "Adaptation",
    "AmbiguousRobotError",
    "CommandError",
    "Comparison",
    "ConnectOptions",
    "Diagnosis",
    "Effect",
    "EmbeddedServer",
    "EnvFactory",
    "Error",
    "Estimate",
    "ForkedProcessError",
    "GaussianPolicy",
    "Go2Env",
    "Go2VectorEnv",
    "GroupedVecEnv",
    "Identification",
    "InvalidActionError",
    "InvalidOptionError",
    "LeaseLostError",
    "MalformedError",
    "ModelErrors",
    "NoServerError",
    "NotPicklableError",
    "RemoteVecEnv",
    "RequestRejectedError",
    "RequestTimeoutError",
    "ResetNeededError",
    "ServerExitedError",
    "ServerInfo",
    "ServerNotFoundError",
    "ServerStartError",
    "ShardedVecEnv",
    "Spec",
    "SpecField",
    "SpecMismatchError",
    "StepBatch",
    "Trajectory",
    "VecEnvError",
    "VersionError",
    "adapt",
    "check_vec_env",
    "diagnose",
    "discover",
    "evaluate",
    "identify",
    "stop_robot",
]

# With the number of policy steps of an episode: 20 s, a jump 3 s, getting up 5 s.
_MAX_EPISODE_STEPS = {
    "walk": 1000,
    "track": 1000,
    "jump": 150,
    "gait": 1000,
    "attitude": 1000,
    "explore": 1000,
    "getup": 250,
}
for _task, _max_episode_steps in _MAX_EPISODE_STEPS.items():
    gymnasium.register(
        id=f"twinstep/Go2-{_task.capitalize()}-v0",
        entry_point="twinstep.env:Go2Env",
        vector_entry_point="twinstep.vector_env:Go2VectorEnv",
        max_episode_steps=_max_episode_steps,
        kwargs={"task": _task},
    )
# Any robot: `robot=` is a shipped one, such as "g1", or its model file.
for _task in ("pose", "walk"):
    gymnasium.register(
        id=f"twinstep/{_task.capitalize()}-v0",
        entry_point="twinstep.env:Go2Env",
        vector_entry_point="twinstep.vector_env:Go2VectorEnv",
        max_episode_steps=1000,
        kwargs={"task": _task},
    )

if not TYPE_CHECKING:
    # For a type checker, this function would make every name an attribute of the package.
    def __getattr__(name: str) -> ModuleType:
        """Import a module of an extra at its first use. The error without the extra says how to install it."""
        if name not in ("rsl_rl", "sb3"):
            raise AttributeError(f"module `twinstep` has no attribute `{name}`")
        return importlib.import_module(f".{name}", __name__)
