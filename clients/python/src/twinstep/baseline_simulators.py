"""Baseline simulators of ``twinstep bench``: MuJoCo C, and EnvPool's Go1.

``python -m twinstep.baseline_simulators`` is a child process of the bench. It reads one line of JSON with models and
motion and prints the list of installed baselines. It then reads names of baselines, and prints for each the env-steps
per second of one window. The bench measures its own windows in between. The process terminates when its stdin closes.
"""

import importlib
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from .bench import installed

Advance = Callable[[], int]
"""Function that advances all robots and returns the number of env-steps."""

GO1 = "Go1JoystickFlatTerrain-v1"


def baselines(setup: dict[str, Any]) -> dict[str, Callable[[], Advance]]:
    """Return a function that prepares each installed baseline, by name."""
    found = dict[str, Callable[[], Advance]]()
    if installed("mujoco"):
        for name, model in setup["models"].items():
            found[name] = lambda model=model: mujoco_trot(model, setup)
    if setup["threads"] and installed("envpool"):
        for threads in setup["threads"]:
            found[f"envpool {threads}"] = lambda threads=threads: envpool_trot(threads, setup)
    return found


def mujoco_trot(xml: str, setup: dict[str, Any]) -> Advance:
    """Prepare ``mujoco.rollout`` of all robots on one thread.

    A rollout is open loop, so the model contains position actuators. Their PD loop runs at every physics step, in our
    engines at 200 Hz.
    """
    mujoco: Any = importlib.import_module("mujoco")
    rollout: Any = importlib.import_module("mujoco.rollout")
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, start, kind)
    states = np.tile(start, (setup["num_envs"], 1))
    targets = np.array(setup["targets"])
    steps = round(setup["policy_dt"] / model.opt.timestep)
    control = np.repeat(targets, steps, axis=0)[None]

    def advance() -> int:
        nonlocal states
        # With one MjData, rollout uses one thread.
        trajectory, _ = rollout.rollout(model, data, states, control)
        if not setup["restarts"]:
            states = np.array(trajectory[:, -1])
        return len(states) * len(targets)

    return advance


def envpool_trot(threads: int, setup: dict[str, Any]) -> Advance:
    """Prepare MuJoCo Playground's Go1 in EnvPool, with its own observations, rewards and resets."""
    envpool: Any = importlib.import_module("envpool")
    envs = envpool.make_gymnasium(GO1, num_envs=setup["num_envs"], num_threads=threads)
    envs.reset()
    # The order of its legs is FR, FL, RR, RL. The action scale is the same as ours.
    actions_in_order = np.array(setup["actions"]).reshape(-1, 4, 3)[:, [1, 0, 3, 2]].reshape(-1, 12)
    actions = np.repeat(actions_in_order[:, None], setup["num_envs"], axis=1)

    def advance() -> int:
        for action in actions:
            envs.step(action)
        return actions.shape[0] * actions.shape[1]

    return advance


def main() -> None:
    """Handle the requests of the bench."""
    setup = json.loads(sys.stdin.readline())
    prepare = baselines(setup)
    print(json.dumps(list(prepare)), flush=True)
    ready = dict[str, Advance]()
    for line in sys.stdin:
        name = line.strip()
        if name not in ready:
            ready[name] = prepare[name]()
            # Warm-up: the first steps contain falls and memory allocation.
            ready[name]()
        count, since = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - since) < setup["window_s"]:
            count += ready[name]()
        print(count / elapsed, flush=True)


if __name__ == "__main__":
    main()
