"""The child process of ``twinstep bench sim`` that measures baseline simulators."""

import importlib.util
import json
import subprocess
import sys

from twinstep.server import find_program


def test_child_lists_and_measures_the_installed_baselines() -> None:
    command = [find_program(), "mjcf", "--timestep", "0.005"]
    model = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    setup = {
        "models": {"mujoco 200": model},
        "threads": [1],
        "targets": [[0.0] * 12] * 2,
        "actions": [[0.0] * 12] * 2,
        "policy_dt": 0.02,
        "restarts": False,
        "num_envs": 3,
        "window_s": 0.01,
    }
    child = subprocess.run(
        [sys.executable, "-m", "twinstep.baseline_simulators"],
        input=f"{json.dumps(setup)}\nmujoco 200\n",
        capture_output=True,
        text=True,
        check=True,
    )
    names, rate = child.stdout.splitlines()
    assert "mujoco 200" in json.loads(names)
    assert float(rate) > 0
    if importlib.util.find_spec("envpool") is None:
        assert "skipped: envpool is not installed" in child.stderr
