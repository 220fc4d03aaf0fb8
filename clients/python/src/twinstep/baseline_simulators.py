"""The simulators that ``twinstep bench`` measures beside its own: MuJoCo C, and EnvPool's Go1.

``python -m twinstep.baseline_simulators`` is a child of the bench. It reads one line of JSON with models and motion, prints
the list of the peers that are installed, and then answers each name with the env-steps a second of one window, so that
the bench can take its own windows in between. It ends with its stdin.
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
"""Advances all robots and returns how many env-steps that were."""

GO1 = "Go1JoystickFlatTerrain-v1"


def peers(setup: dict[str, Any]) -> dict[str, Callable[[], Advance]]:
    """What can be measured here: a function that prepares each peer, by name."""
    found = dict[str, Callable[[], Advance]]()
    if installed("mujoco"):
        for physics_hz, model in setup["models"].items():
            found[f"mujoco {physics_hz}"] = lambda model=model: mujoco_trot(model, setup)
    if installed("envpool"):
        for threads in setup["threads"]:
            found[f"envpool {threads}"] = lambda threads=threads: envpool_trot(threads, setup)
    return found


def mujoco_trot(xml: str, setup: dict[str, Any]) -> Advance:
    """``mujoco.rollout`` of all robots on one thread.

    A rollout is open loop, so the drive is in the model: position actuators, whose PD acts at every step of the
    physics and not at 200 Hz as in ours.
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
        # One MjData: no pool of threads.
        passed, _ = rollout.rollout(model, data, states, control)
        states = np.array(passed[:, -1])
        return len(states) * len(targets)

    return advance


def envpool_trot(threads: int, setup: dict[str, Any]) -> Advance:
    """MuJoCo Playground's Go1 in EnvPool, with its own observations, rewards and resets."""
    envpool: Any = importlib.import_module("envpool")
    envs = envpool.make_gymnasium(GO1, num_envs=setup["num_envs"], num_threads=threads)
    envs.reset()
    # Its legs are FR, FL, RR, RL; the scale of an action is ours.
    own_order = np.array(setup["actions"]).reshape(-1, 4, 3)[:, [1, 0, 3, 2]].reshape(-1, 12)
    actions = np.repeat(own_order[:, None], setup["num_envs"], axis=1)

    def advance() -> int:
        for action in actions:
            envs.step(action)
        return actions.shape[0] * actions.shape[1]

    return advance


def main() -> None:
    """Answer the bench."""
    setup = json.loads(sys.stdin.readline())
    known = peers(setup)
    print(json.dumps(list(known)), flush=True)
    ready = dict[str, Advance]()
    for line in sys.stdin:
        name = line.strip()
        if name not in ready:
            ready[name] = known[name]()
            # The first steps are falls and allocations.
            ready[name]()
        count, since = 0, time.perf_counter()
        while (passed := time.perf_counter() - since) < setup["window_s"]:
            count += ready[name]()
        print(count / passed, flush=True)


if __name__ == "__main__":
    main()
