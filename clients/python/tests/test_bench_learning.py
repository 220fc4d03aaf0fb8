"""The comparison of training rates."""

import pytest

pytest.importorskip("rsl_rl")
pytest.importorskip("stable_baselines3")

import twinstep
from twinstep.bench_learning import EVALUATED, Timing, train_rsl_rl, train_sb3, train_twinstep


def test_each_library_is_timed_without_its_first_update() -> None:
    server = twinstep.EmbeddedServer(("--task", "walk", "--envs", str(16 + EVALUATED), "--physics-hz", "400"))
    timings = [train(server.endpoint, 8, 2) for train in (train_twinstep, train_rsl_rl, train_sb3)]
    server.release()
    for timing in timings:
        assert timing.env_steps == 8 * 24 * 2
        assert timing.rollout > 0
        assert timing.update > 0


def test_rate_counts_both_parts() -> None:
    assert Timing(rollout=1.5, update=0.5, env_steps=100).rate == 50
