"""A Gymnasium environment as the task of ``minimal_server.py``: its spec, and the episodes of one lease."""

import hashlib
from collections.abc import Callable
from itertools import groupby
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from minimal_server_wire import Message, RequestError, optional, read, tensor
from numpy.typing import NDArray

UNLIMITED = 2**32 - 1


class Episodes:
    """Environments of one lease, with autoreset and time limit."""

    def __init__(self, make: Callable[[], Any], num_envs: int, autoreset: str, max_steps: int) -> None:
        self.envs = [make() for _ in range(num_envs)]
        self.autoreset, self.max_steps = autoreset, max_steps
        self.space: Any = self.envs[0].action_space
        self.obs = np.zeros((num_envs, spaces.flatdim(self.envs[0].observation_space)), "<f4")
        self.running, self.was_started = np.zeros(num_envs, np.bool_), np.zeros(num_envs, np.bool_)
        self.length, self.episode_return = np.zeros(num_envs, "<u4"), np.zeros(num_envs)

    def start(self, env: int, seed: int | None) -> None:
        """Start an episode; without a seed the environment continues its random stream."""
        self.obs[env] = self.flat(self.envs[env].reset(seed=seed)[0])
        self.running[env] = self.was_started[env] = True
        self.length[env], self.episode_return[env] = 0, 0.0

    def flat(self, obs: Any) -> NDArray[np.float32]:
        """Return an observation as a vector."""
        return np.asarray(spaces.flatten(self.envs[0].observation_space, obs), np.float32)

    def reset(self, message: Message) -> Message:
        """Execute a ``reset``."""
        n = len(self.envs)
        given = optional(message, "seeds", bytes)
        seeds = [None] * n if given is None else tensor(given, "seeds", "<u8", n).tolist()
        mask = tensor(optional(message, "mask", bytes, b"\1" * n), "mask", "u1", n)
        for env in np.flatnonzero(mask):
            self.start(int(env), seeds[env])
        return {"obs": self.obs.tobytes()}

    def step(self, message: Message) -> Message:
        """Execute a ``step``."""
        n, size = len(self.envs), self.space.shape or (1,)
        actions = tensor(read(message, "actions", bytes), "actions", "<f4", n, *size)
        if not np.isfinite(actions).all():
            raise RequestError("not_finite", "actions", f"entry {np.argwhere(~np.isfinite(actions))[0]} is not finite")
        waiting = ~self.running
        missing = waiting & ~self.was_started if self.autoreset == "NextStep" else waiting
        if missing.any():
            raise RequestError("needs_reset", "", f"environment {missing.argmax()} has no episode")
        reward, terminated, truncated = np.zeros(n, "<f4"), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        for env in range(n):
            if waiting[env]:
                self.start(env, None)
            else:
                reward[env], terminated[env], truncated[env] = self.step_one(env, actions[env])
        ended = np.flatnonzero(terminated | truncated)
        self.running[ended] = False
        total = self.episode_return[ended].astype("<f4").tobytes()
        reply: Message = {
            "reward": reward.tobytes(),
            "terminated": terminated.tobytes(),
            "truncated": truncated.tobytes(),
            "ended_env": ended.astype("<u4").tobytes(),
            "ended_length": self.length[ended].tobytes(),
            "ended_return": total,
            "ended_terms": total,
            "final_obs": self.obs[ended].tobytes() if self.autoreset == "SameStep" else b"",
        }
        if self.autoreset == "SameStep":
            for env in ended:
                self.start(int(env), None)
        return {**reply, "obs": self.obs.tobytes()}

    def step_one(self, env: int, action: NDArray[np.float32]) -> tuple[float, bool, bool]:
        """Step one environment, and return reward, terminated and truncated."""
        obs, reward, terminated, truncated, _ = self.envs[env].step(native_action(self.space, action))
        self.obs[env] = self.flat(obs)
        self.length[env] += 1
        self.episode_return[env] += reward
        truncated = truncated or self.length[env] >= self.max_steps
        return float(reward), bool(terminated), bool(truncated and not terminated)


def native_action(space: Any, action: NDArray[np.float32]) -> Any:
    """Return the action of an environment: clipped to its bounds; a whole number for a discrete space."""
    if type(space) is spaces.Discrete:
        return int(space.start) + int(np.clip(np.rint(action[0]), 0, space.n - 1))
    return np.clip(action, space.low, space.high).astype(space.dtype).reshape(space.shape)


def describe(name: str, env: Any) -> Message:
    """Return the ``spec``. What only a robot has is empty or 0."""
    action: Any = env.action_space
    obs = cast(Any, spaces.flatten_space(env.observation_space))
    if type(action) not in (spaces.Box, spaces.Discrete) or type(obs) is not spaces.Box:
        raise SystemExit(f"{name}: the spaces {action} and {obs} have no fixed number of float32 entries")
    is_discrete = type(action) is spaces.Discrete
    low, high = (np.zeros(1), np.full(1, action.n - 1)) if is_discrete else (action.low, action.high)
    fps: float = env.metadata.get("render_fps") or 1.0

    def part(kind: str, low: NDArray[Any], high: NDArray[Any]) -> list[Message]:
        """Describe neighbouring entries with the same bounds by one field."""
        groups = [list(group) for _, group in groupby(zip(low.ravel().tolist(), high.ravel().tolist(), strict=True))]
        names = [f"{kind}_{index}" for index in range(len(groups))]
        return [
            {"name": name, "size": len(group), "unit": "", "low": group[0][0], "high": group[0][1], "description": kind}
            for name, group in zip(names, groups, strict=True)
        ]

    limit = env.spec.max_episode_steps
    return {
        "task": name,
        "robot": name,
        "observation": part("observation", obs.low, obs.high),
        "action": part("action", low, high),
        "joint_order": [],
        "policy_dt": 1 / fps,
        "actuator_dt": 1 / fps,
        "kp": 0.0,
        "kd": 0.0,
        "action_scale": 1.0,
        "default_pose": [],
        "reward_terms": ["reward"],
        "max_episode_steps": UNLIMITED if limit is None else limit,
    }


def spec_hash(spec: Message) -> str:
    """Return the hash of what agent and environment must agree on."""

    def number(value: float) -> str:
        return np.format_float_positional(value, trim="-")

    lists = {kind: [f"{part['name']}:{part['size']}" for part in spec[kind]] for kind in ("observation", "action")}
    lists["joint_order"] = spec["joint_order"]
    lists |= {name: [number(spec[name])] for name in ("policy_dt", "kp", "kd", "action_scale")}
    lists["default_pose"] = list(map(number, spec["default_pose"]))
    text = "".join(f"{name} {' '.join(entries)}\n" for name, entries in lists.items())
    return hashlib.sha256(text.encode()).digest()[:16].hex()
