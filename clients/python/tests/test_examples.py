"""All examples run."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import twinstep
from twinstep.exploration import evaluate_exploration

EXAMPLES = Path(__file__).parent.parent / "examples"
ROOT = EXAMPLES.parents[2]


def run(name: str, *arguments: str) -> str:
    """Run an example and return its output."""
    command = [sys.executable, "-W", "error", str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_random_agent() -> None:
    assert "mean reward of a step" in run("random_agent.py", "--envs", "2", "--steps", "10")


def test_overlap() -> None:
    assert "overlap " in run("overlap.py", "--envs", "2", "--steps", "10")


def test_minimal_client() -> None:
    server = twinstep.EmbeddedServer(("--task", "walk", "--envs", "64"))
    assert len(run("minimal_client.py", server.endpoint).splitlines()) == 10
    server.release()


def test_an_agent_is_trained_and_runs_on_another_server(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    printed = run("ppo.py", "--envs", "4", "--steps", "192", "--out", str(tmp_path))
    assert "192 steps" in printed
    assert "velocity error" in printed
    server = twinstep.EmbeddedServer(("--task", "walk", "--envs", "64"))
    printed = run("remote.py", "--endpoint", server.endpoint, "--policy", str(tmp_path), "--steps", "10")
    server.release()
    assert printed.startswith("mean reward of a step")


def test_rsl_rl_trains_a_policy(tmp_path: Path) -> None:
    pytest.importorskip("rsl_rl")
    printed = run("ppo_rsl_rl.py", "--envs", "4", "--steps", "192", "--out", str(tmp_path))
    assert "192 steps" in printed
    assert "velocity error" in printed


def test_exploration_policies_are_trained_by_either_library(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("rsl_rl")
    # The networks of the ensemble's own tests, as the actuators of a Go2 with the gains of the policy.
    ensemble = tmp_path / "actuators.safetensors"
    golden = (ROOT / "ensemble/golden/actuators.safetensors").read_bytes()
    ensemble.write_bytes(golden.replace(b"[25.0,0.6]", b"[30, 0.75]"))
    model = tmp_path / "robot.toml"
    model.write_text(f'robot = "go2"\n[actuator]\nmode = "replace"\nensemble = "{ensemble}"\n')
    base = ROOT / "data/policies/walk.safetensors"
    for name in ("explore_sb3.py", "explore_rsl_rl.py"):
        robot = ("--model", str(model), "--base", str(base))
        printed = run(name, *robot, "--envs", "4", "--steps", "192", "--out", str(tmp_path / name))
        measured = re.search(r"192 steps in .*: uncertainty ([\d.]+) nat, [\d.]+ falls", printed)
        assert measured, printed
        assert float(measured[1]) > 0.0


def test_task_without_uncertainty_is_no_exploration() -> None:
    with pytest.raises(twinstep.SpecMismatchError, match="the task is `walk`"):
        evaluate_exploration(lambda obs: np.zeros((len(obs), 12), np.float32), 2, task="walk")
