"""Groups of environments whose steps are in progress at the same time."""

import dataclasses
import os
import signal
import threading
from typing import Any

import gymnasium
import numpy as np
import pytest
from loopback import router, suspend, wait_for_servers

import twinstep
from twinstep import ConnectOptions, EmbeddedServer, GroupedVecEnv, InvalidOptionError, RemoteVecEnv, StepBatch

N, LIMIT = 5, 12
SETTINGS: Any = {"num_envs": N, "autoreset": "SameStep", "max_episode_steps": LIMIT}
SEEDS = np.arange(40, 40 + N, dtype=np.uint64)


def actions(step: int, rows: slice = slice(0, N)) -> np.ndarray:
    return np.random.default_rng(step).uniform(-1, 1, (N, 12)).astype(np.float32)[rows]


def step(envs: RemoteVecEnv | GroupedVecEnv, given: np.ndarray) -> StepBatch:
    if isinstance(envs, GroupedVecEnv):
        return envs.step(given)
    envs.send(given)
    return envs.recv()


@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep", "Disabled"])
def test_rows_are_the_same_in_any_number_of_groups(autoreset: str) -> None:
    options, settings = ConnectOptions(critic=True), SETTINGS | {"autoreset": autoreset}
    some = np.array([True, False, False, True, False])
    results: list[list[Any]] = []
    for groups in (None, 1, 2, 3, 5):
        envs = (
            RemoteVecEnv(options, **settings) if groups is None else GroupedVecEnv(options, groups=groups, **settings)
        )
        # The mask leaves whole groups without a reset.
        found: list[Any] = [envs.reset(SEEDS, None), envs.reset(SEEDS + 9, some, some[::-1]), envs.reset(None, None)]
        for index in range(2 * LIMIT + 3):
            batch = step(envs, actions(index))
            found.append(dataclasses.asdict(batch) | {"round_trip_s": 0.0})
            np.testing.assert_array_equal(envs.critic_obs, batch.critic_obs)
            if index == LIMIT - 1 and autoreset == "SameStep":
                assert len(batch.final_obs) == len(batch.final_critic_obs) == len(batch.ended) > 0
            if autoreset == "Disabled" and len(batch.ended):
                found.append(envs.reset(None, batch.terminated | batch.truncated))
        assert sum(len(one["ended"]) for one in found if isinstance(one, dict)) >= 2 * N
        scene, expected = envs.scene(N - 1)["pose"], results[0][-1] if results else None
        results.append([*found, scene])
        assert expected is None or scene == expected
        envs.close()
    for found in results[1:]:
        np.testing.assert_equal(found, results[0])


def test_each_group_is_stepped_on_its_own() -> None:
    alone, envs = RemoteVecEnv(ConnectOptions(), **SETTINGS), GroupedVecEnv(ConnectOptions(), groups=2, **SETTINGS)
    np.testing.assert_array_equal(envs.reset(SEEDS, None), alone.reset(SEEDS, None))
    assert [envs.rows(group) for group in range(envs.num_groups)] == [slice(0, 2), slice(2, 5)]
    expected = [step(alone, actions(index)) for index in range(LIMIT)]
    # Group 1 is always one step behind group 0.
    envs.send(0, actions(0, envs.rows(0)))
    for index in range(LIMIT):
        envs.send(1, actions(index, envs.rows(1)))
        for group in (0, 1):
            batch = envs.recv(group)
            for name in ("obs", "reward", "terminated", "truncated"):
                np.testing.assert_array_equal(
                    getattr(batch, name), getattr(expected[index], name)[envs.rows(group)], err_msg=name
                )
            if group == 0 and index + 1 < LIMIT:
                envs.send(0, actions(index + 1, envs.rows(0)))
    envs.close()
    alone.close()


def test_groups_without_seeds_have_different_robots() -> None:
    envs = GroupedVecEnv(ConnectOptions(), groups=2, **SETTINGS | {"num_envs": 4})
    first = envs.reset(None, None)
    assert len(np.unique(first, axis=0)) == 4
    again = envs.reset(None, None)
    assert len(np.unique(np.concatenate([first, again]), axis=0)) == 8, "the random streams continue"
    # With a seed for the first row of each group only, the others continue.
    seeded = np.array([True, False, True, False])
    third = envs.reset(SEEDS[:4], None, seeded)
    np.testing.assert_array_equal(third[seeded], envs.reset(SEEDS[:4], None)[seeded])
    assert len(np.unique(np.concatenate([first, again, third]), axis=0)) == 12
    envs.close()


def test_all_groups_are_sent_before_a_reply_is_awaited(monkeypatch: pytest.MonkeyPatch) -> None:
    envs = GroupedVecEnv(ConnectOptions(task="counter"), groups=3, **SETTINGS)
    envs.reset(None, None)
    calls: list[str] = []
    for name in ("send", "recv"):
        method = getattr(RemoteVecEnv, name)
        monkeypatch.setattr(RemoteVecEnv, name, lambda *given, n=name, m=method: (calls.append(n), m(*given))[1])
    envs.step(actions(0))
    assert calls == ["send"] * 3 + ["recv"] * 3
    envs.close()


def test_an_error_of_one_group_keeps_the_results_of_the_others() -> None:
    settings = SETTINGS | {"autoreset": "Disabled", "max_episode_steps": None}
    envs = GroupedVecEnv(ConnectOptions(task="counter"), groups=2, **settings)
    # Group 1 has no episodes yet.
    envs.reset(None, np.arange(N) < 2)
    with pytest.raises(twinstep.ResetNeededError):
        envs.step(actions(0))
    with pytest.raises(twinstep.Error, match="group 0 has a result that was not received: nothing was stepped"):
        envs.step(actions(0))
    with pytest.raises(twinstep.Error, match="the last `step` of group 0 has a result"):
        envs.send(0, actions(0, envs.rows(0)))
    assert envs.recv(0).obs[:, 0].tolist() == [1, 1]
    with pytest.raises(twinstep.Error, match="no request is in progress"):
        envs.recv(1)
    envs.reset(None, None)
    assert envs.step(actions(1)).obs[:, 0].tolist() == [2, 2, 1, 1, 1]
    envs.close()


def test_a_step_that_timed_out_is_received_later() -> None:
    server = EmbeddedServer(("--task", "counter"))
    envs = GroupedVecEnv(ConnectOptions(task="counter", endpoint=server.endpoint, timeout_s=0.5), groups=2, **SETTINGS)
    envs.reset(None, None)
    suspend(server.pid)
    with pytest.raises(twinstep.RequestTimeoutError):
        envs.step(actions(0))
    threading.Timer(0.2, os.kill, (server.pid, signal.SIGCONT)).start()
    envs.reset(None, None)
    assert envs.step(actions(0)).obs[:, 0].tolist() == [2] * N, "both groups have executed both steps once"
    envs.close()
    server.release()


def test_all_groups_are_at_one_server_and_invalid_use_raises() -> None:
    for groups in (0, N + 1):
        with pytest.raises(twinstep.InvalidOptionError, match=f"`groups` = {groups} is not allowed: 1 to {N}, the"):
            GroupedVecEnv(ConnectOptions(), groups=groups, **SETTINGS)
    with router() as endpoint:
        servers = [EmbeddedServer(("--task", "counter", "--envs", "8", "--connect", endpoint)) for _ in range(2)]
        wait_for_servers(endpoint, 2)
        envs = GroupedVecEnv(ConnectOptions(task="counter", endpoint=endpoint), groups=2, **SETTINGS)
        assert sorted(info.free_envs or 0 for info in twinstep.discover(endpoint)) == [8 - N, 8]
        envs.reset(None, None)
        wrong = actions(0)
        wrong[N - 1, 1] = np.nan
        with pytest.raises(twinstep.InvalidActionError, match="environment 4, "):
            envs.step(wrong)
        assert envs.step(actions(0)).obs[:, 0].tolist() == [1] * N, "the wrong actions have stepped no group"
        envs.close()
        assert [info.free_envs for info in twinstep.discover(endpoint)] == [8, 8]
        # No server has room for both groups, and the first is released.
        envs = GroupedVecEnv(ConnectOptions(task="counter", endpoint=endpoint), groups=2, **SETTINGS | {"num_envs": 8})
        envs.close()
        with pytest.raises(twinstep.RequestRejectedError):
            GroupedVecEnv(ConnectOptions(task="counter", endpoint=endpoint), groups=2, **SETTINGS | {"num_envs": 10})
        assert [info.free_envs for info in twinstep.discover(endpoint)] == [8, 8]
        for server in servers:
            server.release()


def test_vector_environment_with_groups_steps_like_one_without() -> None:
    found: list[list[Any]] = []
    for groups in (1, 3):
        envs = gymnasium.make_vec("twinstep/Go2-Walk-v0", num_envs=N, groups=groups, critic=True)
        obs, info = envs.reset(seed=40)
        results: list[Any] = [obs, info["critic_obs"]]
        for index in range(4):
            *result, info = envs.step(actions(index))
            results += [*result, info["critic_obs"]]
        found.append(results)
        assert isinstance(envs.unwrapped, twinstep.Go2VectorEnv)
        assert envs.unwrapped.lease.count(", ") == groups - 1
        envs.close()
    np.testing.assert_equal(found[1], found[0])


def test_groups_are_refused_with_several_servers_and_in_rollouts() -> None:
    with pytest.raises(InvalidOptionError, match="`groups` = 2 and `endpoints` are set"):
        twinstep.Go2VectorEnv(4, groups=2, endpoints=["tcp/127.0.0.1:9"])
    with pytest.raises(InvalidOptionError, match=r"`groups` = 5 is not allowed: 1 to 4"):
        twinstep.Go2VectorEnv(4, groups=5)
    envs = twinstep.Go2VectorEnv(4, groups=2)
    with pytest.raises(InvalidOptionError, match="`rollout` needs one lease"):
        envs.rollout(None, 1, noise_seed=0)  # pyright: ignore[reportArgumentType]
    envs.close()
