"""Errors after which the client cannot know whether a request was executed."""

import multiprocessing
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from twinstep import Error, Go2Env, Go2VectorEnv, MalformedError
from twinstep.connection import Connection
from twinstep.query import Pending


@pytest.fixture
def counters() -> Iterator[Go2VectorEnv]:
    envs = Go2VectorEnv(2, task="counter")
    envs.reset()
    yield envs
    envs.close()


def actions(value: float) -> np.ndarray:
    return np.full((2, 12), value, dtype=np.float32)


def echoed(obs: np.ndarray) -> float:
    """Return the action that the task ``counter`` repeats in its observation."""
    return float(obs[0, 33])


@pytest.mark.parametrize("sent", [False, True])
def test_interrupt_while_sending_never_exchanges_transitions(
    counters: Go2VectorEnv, monkeypatch: pytest.MonkeyPatch, sent: bool
) -> None:
    send = Pending.send

    def interrupted(self: Pending) -> None:
        if sent:
            send(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(Pending, "send", interrupted)
    with pytest.raises(KeyboardInterrupt):
        counters.step(actions(0.25))
    monkeypatch.undo()
    with pytest.raises(Error, match="has no reply yet"):
        counters.step(actions(0.75))
    obs, *_ = counters.recv()
    assert echoed(obs) == 0.25
    obs, *_ = counters.step(actions(0.75))
    assert (echoed(obs), obs[0, 0]) == (0.75, 2.0), "two steps were executed, each once"


def test_interrupt_after_the_reply_returns_it_again(counters: Go2VectorEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    wait = Connection.wait_reply

    def interrupted(self: Connection, *arguments: Any, **options: Any) -> dict[str, Any]:
        wait(self, *arguments, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(Connection, "wait_reply", interrupted)
    with pytest.raises(KeyboardInterrupt):
        counters.step(actions(0.25))
    monkeypatch.undo()
    obs, *_ = counters.recv()
    assert (echoed(obs), obs[0, 0]) == (0.25, 1.0)


@pytest.mark.parametrize("damage", [{"seq": 1}, {"obs": b""}])
def test_reply_that_cannot_be_read_blocks_steps_until_a_reset(
    counters: Go2VectorEnv, monkeypatch: pytest.MonkeyPatch, damage: dict[str, Any]
) -> None:
    wait = Connection.wait_reply

    def damaged(self: Connection, *arguments: Any, **options: Any) -> dict[str, Any]:
        return {**wait(self, *arguments, **options), **damage}

    monkeypatch.setattr(Connection, "wait_reply", damaged)
    with pytest.raises(MalformedError):
        counters.step(actions(0.25))
    monkeypatch.undo()
    with pytest.raises(Error, match="state of the environments is unknown"):
        counters.step(actions(0.5))
    with pytest.raises(Error, match="state of the environments is unknown"):
        counters.reset(options={"reset_mask": np.array([True, False])})
    obs, _ = counters.reset()
    assert obs[0, 0] == 1.0, "the damaged step was executed once"
    obs, *_ = counters.step(actions(0.5))
    assert (echoed(obs), obs[0, 0]) == (0.5, 2.0)


def _child(endpoint: str, errors: Any) -> None:
    try:
        Go2Env(endpoint=endpoint, task="counter")
    except Exception as error:
        errors.put(f"{type(error).__name__}: {error}")


def test_forked_process_gets_an_error_that_names_spawn(counters: Go2VectorEnv) -> None:
    endpoint = counters._remote._connection.endpoint
    context = multiprocessing.get_context("fork")
    errors = context.Queue()
    child = context.Process(target=_child, args=(endpoint, errors))
    child.start()
    assert "ForkedProcessError" in (error := errors.get(timeout=10)), error
    assert "spawn" in error
    child.join(10)
    assert child.exitcode == 0


def test_asynchronous_vector_environment_works_with_spawn() -> None:
    envs = gym.make_vec(
        "twinstep/Go2-Walk-v0", num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"}
    )
    obs, _ = envs.reset(seed=3)
    assert obs.shape == (2, 45)
    envs.close()
