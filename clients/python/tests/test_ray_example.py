"""The example ``ray_rollouts.py``: its worker without Ray, and the program with Ray where it is installed."""

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loopback import router, wait_for_servers

import twinstep
from twinstep import EmbeddedServer

EXAMPLE = Path(__file__).parent.parent / "examples" / "ray_rollouts.py"
HAS_RAY = importlib.util.find_spec("ray") is not None
N, STEPS = 3, 4


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Run two servers of the same robot behind a router."""
    with router() as endpoint:
        servers = [EmbeddedServer(("--task", "walk", "--envs", "8", "--connect", endpoint)) for _ in range(2)]
        wait_for_servers(endpoint, 2)
        yield endpoint
        for server in servers:
            server.release()


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(EXAMPLE), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_workers_without_ray_step_different_robots_on_different_servers(endpoint: str) -> None:
    spec = importlib.util.spec_from_file_location("ray_rollouts", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    workers = [example.Worker(endpoint, N, index * N) for index in range(2)]
    assert [info.free_envs for info in twinstep.discover(endpoint)] == [8 - N, 8 - N]
    weights = np.full((45, 12), 0.01, np.float32)
    rollouts = [worker.rollout(weights, STEPS) for worker in workers]
    envs = twinstep.Go2VectorEnv(2 * N, autoreset_mode="SameStep")
    obs, _ = envs.reset(seed=0)
    for step in range(STEPS):
        np.testing.assert_array_equal(obs, np.concatenate([rollout[0][step] for rollout in rollouts]))
        noise = np.concatenate([rollout[1][step] for rollout in rollouts])
        actions = np.concatenate([rollout[0][step] @ weights for rollout in rollouts]) + noise
        obs, reward, *_ = envs.step(actions)
        np.testing.assert_array_equal(reward, np.concatenate([rollout[2][step] for rollout in rollouts]))
    better, mean = example.improve(weights, rollouts)
    assert mean == pytest.approx(np.mean([rollout[2] for rollout in rollouts]))
    assert better.shape == weights.shape
    assert (better != weights).any()
    for each in (envs, *(worker.envs for worker in workers)):
        each.close()


@pytest.mark.skipif(HAS_RAY, reason="Ray is installed")
def test_the_error_without_ray_says_how_to_install_it() -> None:
    done = run("--endpoint", "tcp/127.0.0.1:9")
    assert done.returncode == 1
    assert done.stderr == "Ray is not installed here\n  pip install ray\n"


@pytest.mark.skipif(not HAS_RAY, reason="Ray is not installed: pip install ray")
def test_ray_workers_return_rollouts_to_one_learner(endpoint: str) -> None:
    done = run("--endpoint", endpoint, "--envs", "4", "--steps", "5", "--updates", "2")
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith(("worker", "update"))]
    assert [line.split(":")[0] for line in lines] == ["worker 0", "worker 1", "update 0", "update 1"]
