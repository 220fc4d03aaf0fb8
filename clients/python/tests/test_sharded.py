"""Environments on several servers, which are killed, suspended and restarted."""

import contextlib
import dataclasses
import itertools
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from loopback import free_endpoint, router, suspend, wait_for_servers

import twinstep
from twinstep import ConnectOptions, EmbeddedServer, Go2VectorEnv, RemoteVecEnv, ShardedVecEnv, StepBatch
from twinstep.recovery import recovery_seed
from twinstep.server import find_program

N, FIRST = 5, 2
"""Number of rows, and number of those on the first of two servers."""
LIMIT = 15
OPTIONS = ConnectOptions(critic=True, timeout_s=1.0)


class Server:
    """A server at a fixed endpoint, which can be killed and started again."""

    def __init__(self, envs: int, *flags: str) -> None:
        self.endpoint = free_endpoint()
        self._flags = ["--listen", self.endpoint, "--envs", str(envs), "--lease-grace-s", "0.5", *flags]
        self.start()

    def start(self) -> None:
        command = [find_program(), "serve", "--until-stdin-closes", *self._flags]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline().startswith("listening ")

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def start() -> Iterator[Callable[..., Server]]:
    started: list[Server] = []

    def create(envs: int = 64, *flags: str) -> Server:
        started.append(Server(envs, *flags))
        return started[-1]

    yield create
    for server in started:
        server.kill()


def actions(step: int) -> np.ndarray:
    return np.random.default_rng(step).uniform(-1, 1, (N, 12)).astype(np.float32)


def sharded(*servers: Server, autoreset: str = "SameStep") -> ShardedVecEnv:
    endpoints = [server.endpoint for server in servers]
    return ShardedVecEnv(OPTIONS, endpoints, num_envs=N, autoreset=autoreset, max_episode_steps=LIMIT)


def alone(num_envs: int = N, autoreset: str = "SameStep") -> RemoteVecEnv:
    return RemoteVecEnv(OPTIONS, num_envs=num_envs, autoreset=autoreset, max_episode_steps=LIMIT)


def step(envs: RemoteVecEnv | ShardedVecEnv, given: np.ndarray) -> StepBatch:
    envs.send(given)
    return envs.recv()


def until_recovered() -> Iterator[int]:
    """Count steps, with pauses, and fail after some time."""
    deadline = time.monotonic() + 20
    for index in itertools.count(1):
        yield index
        assert time.monotonic() < deadline, "no server was leased again"
        time.sleep(0.02)


def assert_rows_equal(first: StepBatch, second: StepBatch, rows: slice) -> None:
    for name in ("obs", "reward", "terminated", "truncated", "critic_obs"):
        np.testing.assert_array_equal(getattr(first, name)[rows], getattr(second, name)[rows], err_msg=name)


@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep", "Disabled"])
def test_rows_are_the_same_on_any_number_of_servers(start: Callable[..., Server], autoreset: str) -> None:
    servers = [start(), start(), start()]
    seeds, some = np.arange(40, 40 + N, dtype=np.uint64), np.array([True, False, True, True, False])
    batches: list[list[Any]] = []
    for envs in (alone(autoreset=autoreset), *(sharded(*servers[:count], autoreset=autoreset) for count in (1, 2, 3))):
        found: list[Any] = [envs.reset(seeds, None), envs.reset(seeds + 9, some, some[::-1]), envs.reset(None, None)]
        for index in range(2 * LIMIT + 3):
            batch = step(envs, actions(index))
            found.append(dataclasses.asdict(batch) | {"round_trip_s": 0.0})
            if autoreset == "Disabled" and len(batch.ended):
                found.append(envs.reset(None, batch.terminated | batch.truncated))
        assert sum(len(one["ended"]) for one in found if isinstance(one, dict)) >= 2 * N
        batches.append(found)
        envs.close()
    for found in batches[1:]:
        np.testing.assert_equal(found, batches[0])


def test_steps_are_sent_to_all_servers_before_a_reply_is_awaited(
    start: Callable[..., Server], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def recorded(name: str) -> Callable[..., Any]:
        method = getattr(RemoteVecEnv, name)
        return lambda *arguments: (calls.append(name), method(*arguments))[1]

    envs = sharded(start(), start())
    envs.reset(None, None)
    for name in ("send", "recv"):
        monkeypatch.setattr(RemoteVecEnv, name, recorded(name))
    step(envs, actions(0))
    assert calls == ["send", "send", "recv", "recv"]
    envs.close()


@pytest.mark.parametrize("fault", ["killed", "suspended"])
@pytest.mark.parametrize("room", ["on the same server", "on another server"])
def test_a_lost_server_costs_its_own_rows_one_episode(start: Callable[..., Server], fault: str, room: str) -> None:
    first, second = start(64 if room == "on another server" else FIRST), start(N - FIRST)
    envs, unsharded = sharded(first, second), alone()
    kept, lost = slice(0, FIRST), slice(FIRST, N)
    seeds = np.arange(N, dtype=np.uint64)
    np.testing.assert_array_equal(envs.reset(seeds, None), unsharded.reset(seeds, None))
    for index in range(8):
        last = step(envs, actions(index))
        assert_rows_equal(last, step(unsharded, actions(index)), slice(0, N))
    recovered, truncated, new_actions, new_batches = -1, 0, [], []
    deadline = time.monotonic() + 40
    index = 7
    while len(new_batches) < 2 * LIMIT and time.monotonic() < deadline:
        index += 1
        if index == 8:
            # Before the step is sent, so that it is in progress when the server is killed.
            suspend(second.process.pid)
        envs.send(actions(index))
        if index == 8 and fault == "killed":
            second.kill()
        batch = envs.recv()
        assert_rows_equal(batch, step(unsharded, actions(index)), kept)
        assert not batch.held[kept].any()
        if index == 8:
            assert batch.truncated[lost].all()
            assert batch.ended[batch.ended_lost].tolist() == list(range(FIRST, N))
            assert batch.ended_length[batch.ended_lost].tolist() == [8] * (N - FIRST)
            np.testing.assert_array_equal(batch.final_obs[batch.ended_lost], last.obs[lost])
        truncated += batch.ended_lost.sum()
        if recovered < 0:
            assert batch.held[lost].all()
            assert not batch.reward[lost].any()
            assert not batch.terminated[lost].any()
            if (batch.obs[lost] == last.obs[lost]).all():
                np.testing.assert_array_equal(batch.critic_obs[lost], last.critic_obs[lost])
                if index == 12 and room == "on the same server":
                    second.start() if fault == "killed" else os.kill(second.process.pid, signal.SIGCONT)
                time.sleep(0.02)
                continue
            recovered, first_obs = index, batch.obs[lost]
            continue
        assert not batch.held.any()
        new_actions.append(actions(index)[lost])
        new_batches.append(batch)
    assert len(new_batches) == 2 * LIMIT, "the rows were leased again"
    assert truncated == N - FIRST, "each lost robot was truncated once"
    if fault == "suspended":
        os.kill(second.process.pid, signal.SIGCONT)
    expected = alone(N - FIRST)
    new_seeds = [recovery_seed(int(seed), 1) for seed in seeds[lost]]
    np.testing.assert_array_equal(first_obs, expected.reset(np.array(new_seeds, np.uint64), None))
    for given, batch in zip(new_actions, new_batches, strict=True):
        one = step(expected, given)
        for name in ("obs", "reward", "terminated", "truncated", "critic_obs"):
            np.testing.assert_array_equal(getattr(batch, name)[lost], getattr(one, name))
    for each in (envs, unsharded, expected):
        each.close()


def test_seeds_that_are_given_without_a_server_are_used_when_there_is_one(start: Callable[..., Server]) -> None:
    first, second = start(FIRST), start(N - FIRST)
    envs, unsharded = sharded(first, second), alone()
    envs.reset(None, None)
    second.kill()
    assert step(envs, actions(0)).ended_lost.sum() == N - FIRST
    seeds = np.arange(70, 70 + N, dtype=np.uint64)
    expected = unsharded.reset(seeds, None)
    np.testing.assert_array_equal(envs.reset(seeds, None)[:FIRST], expected[:FIRST])
    second.start()
    for index in until_recovered():
        batch = step(envs, actions(index))
        assert not batch.ended_lost.any()
        if (batch.obs[FIRST:] == expected[FIRST:]).all():
            break
    envs.close()
    unsharded.close()


def test_steps_without_any_server_raise_until_one_is_back(start: Callable[..., Server]) -> None:
    first, second = start(N), start(N)
    options = dataclasses.replace(OPTIONS, connect_timeout_s=0.5)
    endpoints = [first.endpoint, second.endpoint]
    envs = ShardedVecEnv(options, endpoints, num_envs=N, autoreset="NextStep", max_episode_steps=None)
    envs.reset(None, None)
    first.kill()
    second.kill()
    batch = step(envs, actions(0))
    assert batch.truncated.all()
    assert batch.ended_lost.all()
    for call in (lambda: envs.send(actions(1)), lambda: envs.reset(None, None)):
        with pytest.raises(twinstep.NoServerError, match="all servers are lost"):
            call()
    with pytest.raises(twinstep.Error, match="environment 0 has no server now"):
        envs.scene(0)
    first.start()
    for index in until_recovered():
        with contextlib.suppress(twinstep.NoServerError):
            batch = step(envs, actions(index))
            assert not batch.truncated.any()
            if not batch.held.any():
                break
    envs.close()


@pytest.mark.parametrize("names", [("a", "b"), ("go2", "go2")])
def test_servers_that_were_discovered_behind_a_router_share_the_robots(names: tuple[str, str]) -> None:
    with router() as endpoint:
        servers = [EmbeddedServer(("--task", "walk", "--name", name, "--connect", endpoint)) for name in names]
        found = wait_for_servers(endpoint, 2)
        envs = Go2VectorEnv(N, endpoints=found, autoreset_mode="SameStep", max_episode_steps=LIMIT)
        leased = {4096 - (info.free_envs or 0) for info in twinstep.discover(endpoint)}
        assert leased == {FIRST, N - FIRST}
        reference = Go2VectorEnv(N, autoreset_mode="SameStep", max_episode_steps=LIMIT)
        np.testing.assert_array_equal(envs.reset(seed=4)[0], reference.reset(seed=4)[0])
        for index in range(LIMIT):
            ours, one = envs.step(actions(index)), reference.step(actions(index))
            np.testing.assert_equal(ours[:4], one[:4])
            assert ours[4].keys() == one[4].keys()
        assert one[3].all(), "all episodes have ended"
        assert envs.lease.count(", ") == 1
        envs.close()
        reference.close()
        for server in servers:
            server.release()


def test_infos_of_the_environments_say_which_rows_are_lost_and_held(start: Callable[..., Server]) -> None:
    sb3 = pytest.importorskip("twinstep.sb3", exc_type=ImportError)
    first, second = start(FIRST), start(N - FIRST)
    envs = sb3.make_vec_env(n_envs=N, seed=1, endpoints=[first.endpoint, second.endpoint], timeout_s=1.0)
    envs.reset()
    last, *_ = envs.step(actions(0))
    second.kill()
    _, reward, done, infos = envs.step(actions(1))
    assert done.tolist() == [False] * FIRST + [True] * (N - FIRST)
    for row in range(FIRST, N):
        assert (infos[row]["lost"], infos[row]["held"], infos[row]["TimeLimit.truncated"]) == (True, True, True)
        assert "reward_terms" not in infos[row]
        np.testing.assert_array_equal(infos[row]["terminal_observation"], last[row])
    _, reward, done, infos = envs.step(actions(2))
    assert not done.any()
    assert [info.get("held", False) for info in infos] == [False] * FIRST + [True] * (N - FIRST)
    assert not reward[FIRST:].any()
    (search,) = (thread for thread in threading.enumerate() if thread.name == "twinstep-recovery")
    envs.close()
    search.join(10)
    assert not search.is_alive()


def test_a_lost_server_has_no_reward_terms_in_the_log_of_rsl_rl(start: Callable[..., Server]) -> None:
    rsl_rl = pytest.importorskip("twinstep.rsl_rl", exc_type=ImportError)
    torch = pytest.importorskip("torch")
    first, second = start(FIRST), start(N - FIRST)
    envs = rsl_rl.make_vec_env(num_envs=N, endpoints=[first.endpoint, second.endpoint], timeout_s=1.0)
    envs.step(torch.zeros(N, 12))
    second.kill()
    _, _, done, extras = envs.step(torch.zeros(N, 12))
    assert done.tolist() == [False] * FIRST + [True] * (N - FIRST)
    assert extras["time_outs"].tolist() == [0.0] * FIRST + [1.0] * (N - FIRST)
    assert "log" not in extras
    envs.close()


def test_invalid_use_raises_before_anything_is_sent(start: Callable[..., Server]) -> None:
    first, second = start(64), start(64, "--task", "counter")
    endpoints = [first.endpoint, first.endpoint]
    for arguments, words in (
        ({"endpoints": []}, r"`endpoints` = \[\]; a list of at least one server is expected"),
        ({"endpoints": first.endpoint}, "a list of at least one server is expected"),
        ({"endpoints": endpoints, "endpoint": first.endpoint}, "`endpoint` and `endpoints` are set"),
        ({"endpoints": endpoints * 3}, "`num_envs` = 5; must be at least 1 per server: 6"),
    ):
        with pytest.raises(twinstep.InvalidOptionError, match=words):
            Go2VectorEnv(N, **arguments)
    with pytest.raises(twinstep.SpecMismatchError):
        Go2VectorEnv(N, endpoints=[first.endpoint, second.endpoint])
    envs = Go2VectorEnv(N, endpoints=endpoints, autoreset_mode="Disabled", max_episode_steps=1)
    with pytest.raises(twinstep.ResetNeededError, match="environment 0 has no episode"):
        envs.step(actions(0))
    envs.reset(seed=1)
    wrong = actions(0)
    wrong[4, 1] = np.nan
    with pytest.raises(twinstep.InvalidActionError, match=r"environment 4, joint_position_offset\[FL_thigh\], is nan"):
        envs.step(wrong)
    envs.step(actions(0))
    mask = np.arange(N) != 3
    envs.reset(options={"reset_mask": mask})
    with pytest.raises(twinstep.ResetNeededError, match="environment 3 has no episode"):
        envs.step(actions(0))
    assert [info.free_envs for info in twinstep.discover(first.endpoint)] == [64 - N]
    envs.close()
    with pytest.raises(twinstep.Error, match="the environment is closed"):
        envs._remote.send(actions(0))
    assert [info.free_envs for info in twinstep.discover(first.endpoint)] == [64]
