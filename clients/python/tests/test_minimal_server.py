"""The example server, which knows only ``protocol/SPEC.md``, with the client of the package."""

import hashlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from loopback import free_endpoint

import twinstep
from twinstep import ConnectOptions, Go2VectorEnv
from twinstep.connection import Connection
from twinstep.remote import RemoteVecEnv

EXAMPLES = Path(__file__).parent.parent / "examples"
N = 3


@pytest.fixture(scope="module")
def serve() -> Iterator[Callable[[str], str]]:
    """Start the example server with an environment; return its endpoint."""
    processes: dict[str, tuple[str, subprocess.Popen[str]]] = {}

    def start(env_id: str) -> str:
        if env_id not in processes:
            endpoint = free_endpoint()
            command = [sys.executable, EXAMPLES / "minimal_server.py", "--env", env_id, "--listen", endpoint]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            assert process.stdout is not None
            assert process.stdout.readline() == f"listening {endpoint}\n"
            processes[env_id] = (endpoint, process)
        return processes[env_id][0]

    yield start
    for _, process in processes.values():
        process.terminate()
        process.communicate()


@pytest.fixture
def endpoint(serve: Callable[[str], str]) -> str:
    return serve("Pendulum-v1")


@pytest.fixture
def envs(endpoint: str) -> Iterator[RemoteVecEnv]:
    options = ConnectOptions(endpoint=endpoint, task="Pendulum-v1")
    envs = RemoteVecEnv(options, num_envs=2, autoreset="Disabled", max_episode_steps=None)
    yield envs
    envs.close()


def env_steps(endpoint: str) -> int | None:
    (info,) = twinstep.discover(endpoint)
    return info.env_steps


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_transitions_equal_those_of_the_local_environment(
    serve: Callable[[str], str], env_id: str, mode: AutoresetMode
) -> None:
    local = SyncVectorEnv([lambda: gym.make(env_id, max_episode_steps=15)] * N, autoreset_mode=mode)
    remote = Go2VectorEnv(N, endpoint=serve(env_id), task=env_id, autoreset_mode=mode, max_episode_steps=15)
    rng = np.random.default_rng(1)
    np.testing.assert_array_equal(remote.reset(seed=7)[0], local.reset(seed=7)[0])
    ends = 0
    for _ in range(40):
        actions = rng.uniform(-2, 2, (N, 1)).astype(np.float32)
        if env_id == "CartPole-v1":
            actions = rng.integers(0, 2, (N, 1)).astype(np.float32)
        given = actions[:, 0].astype(np.int64) if env_id == "CartPole-v1" else actions
        obs, reward, terminated, truncated, info = local.step(given)
        remote_obs, remote_reward, *remote_ends, remote_info = remote.step(actions)
        np.testing.assert_array_equal(remote_obs, obs)
        np.testing.assert_array_equal(remote_reward, reward.astype(np.float32))
        np.testing.assert_array_equal(remote_ends, [terminated, truncated & ~terminated])
        done = terminated | truncated
        ends += done.sum()
        if done.any() and mode is AutoresetMode.SAME_STEP:
            for env in np.flatnonzero(done):
                np.testing.assert_array_equal(remote_info["final_obs"][env], info["final_obs"][env])
        if done.any() and mode is AutoresetMode.DISABLED:
            with pytest.raises(twinstep.ResetNeededError):
                remote.step(actions)
            options = {"reset_mask": done}
            np.testing.assert_array_equal(remote.reset(options=options)[0], local.reset(options=dict(options))[0])
    assert ends >= N
    local.close()
    remote.close()


def test_the_example_client_steps_the_example_server(endpoint: str) -> None:
    command = [sys.executable, "-W", "error", EXAMPLES / "minimal_client.py", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert len(done.stdout.splitlines()) == 10


def request(envs: RemoteVecEnv, method: str, **fields: object) -> dict[str, Any]:
    """Send a request, which is not checked by the client."""
    message = {"epoch": envs._epoch, "seq": envs._last_seq + 1, **fields}
    return envs._connection.request(f"env/{envs.lease}/{method}", message, 5.0, "timeout_s")


def test_a_repeated_request_is_not_executed_again(endpoint: str, envs: RemoteVecEnv) -> None:
    envs.reset(np.arange(2, dtype=np.uint64), None)
    before = env_steps(endpoint)
    actions = np.ones((2, 1), np.float32).tobytes()
    first = request(envs, "step", actions=actions)
    assert request(envs, "step", actions=actions) == first
    assert env_steps(endpoint) == before + 2
    for method, fields in (("step", {"actions": bytes(8)}), ("reset", {}), ("step", {"actions": actions, "seq": 1})):
        with pytest.raises(twinstep.RequestRejectedError) as error:
            request(envs, method, **fields)
        assert error.value.code == "stale_sequence"
    with pytest.raises(twinstep.RequestRejectedError) as error:
        request(envs, "step", actions=actions, seq=4)
    assert error.value.code == "sequence_gap"
    assert env_steps(endpoint) == before + 2
    envs._last_seq += 1


def test_requests_without_the_secret_of_the_lease_are_refused(endpoint: str, envs: RemoteVecEnv) -> None:
    envs.reset(None, None)
    before = env_steps(endpoint)
    other = Connection(endpoint, robot=None, zenoh_config=None, server=None, connect_timeout_s=5.0)
    step = f"env/{envs.lease}/step"
    message = {"epoch": envs._epoch, "seq": envs._last_seq + 1, "actions": bytes(8)}
    for secret in (other._secret, b"", envs._connection._secret[:-1]):
        other._secret = secret
        with pytest.raises(twinstep.LeaseLostError, match="the attached secret is not its secret"):
            other.request(step, message, 5.0, "timeout_s")
    assert env_steps(endpoint) == before
    request(envs, "step", actions=bytes(8))
    envs._last_seq += 1
    other.close()


@pytest.mark.parametrize(
    ("method", "fields", "expected"),
    [
        ("step", {"actions": bytes(4)}, ("bad_shape", "actions")),
        ("step", {"actions": [0.0, 0.0]}, ("malformed", "actions")),
        ("step", {}, ("malformed", "actions")),
        ("step", {"actions": bytes(8), "seq": -1}, ("malformed", "seq")),
        ("step", {"actions": bytes(4500)}, ("too_large", "")),
        ("reset", {"seeds": bytes(8)}, ("bad_shape", "seeds")),
        ("reset", {"mask": b"\1"}, ("bad_shape", "mask")),
        ("render", {"env": 0}, ("unknown_key", "")),
        ("step", {"actions": np.full(2, np.nan, "<f4").tobytes()}, twinstep.InvalidActionError),
        ("step", {"actions": bytes(8), "protocol": 9}, twinstep.VersionError),
        ("step", {"actions": bytes(8), "epoch": 2}, twinstep.LeaseLostError),
    ],
)
def test_invalid_requests_get_typed_errors_and_change_nothing(
    endpoint: str, envs: RemoteVecEnv, method: str, fields: dict[str, object], expected: Any
) -> None:
    envs.reset(None, None)
    before = env_steps(endpoint)
    with pytest.raises(twinstep.Error) as error:
        request(envs, method, **fields)
    if isinstance(error.value, twinstep.RequestRejectedError):
        assert (error.value.code, error.value.field) == expected
    else:
        assert type(error.value) is expected
    assert env_steps(endpoint) == before
    request(envs, "step", actions=bytes(8))
    envs._last_seq += 1


def test_step_before_the_first_reset_is_rejected(envs: RemoteVecEnv) -> None:
    envs.send(np.zeros((2, 1), np.float32))
    with pytest.raises(twinstep.ResetNeededError):
        envs.recv()


def test_a_lease_is_granted_once_released_by_close_and_reclaimed_with_its_secret(endpoint: str) -> None:
    def lease(connection: Connection, **fields: object) -> dict[str, Any]:
        message = {"client": connection.client, "num_envs": 2, "autoreset": "NextStep", **fields}
        return connection.request("lease", message, 5.0, "timeout_s")

    def free() -> int | None:
        (info,) = twinstep.discover(endpoint)
        return info.free_envs

    assert free() == 64
    first, second = (
        Connection(endpoint, robot=None, zenoh_config=None, server=None, connect_timeout_s=5.0) for _ in range(2)
    )
    granted = lease(first)
    assert lease(first) == granted
    assert free() == 62
    with pytest.raises(twinstep.RequestRejectedError, match="64") as error:
        lease(second, num_envs=63)
    assert error.value.code == "too_many_envs"
    reclaim = {"lease": granted["lease"], "epoch": 1}
    with pytest.raises(twinstep.LeaseLostError):
        lease(second, reclaim=reclaim)
    second._secret = first._secret
    assert lease(second, reclaim=reclaim)["epoch"] == lease(second, reclaim=reclaim)["epoch"] == 2
    close = {"epoch": 1, "seq": 1}
    with pytest.raises(twinstep.LeaseLostError, match="epoch"):
        first.request(f"env/{granted['lease']}/close", close, 5.0, "timeout_s")
    second.request(f"env/{granted['lease']}/close", {**close, "epoch": 2}, 5.0, "timeout_s")
    assert free() == 64
    first.close()
    second.close()


def test_the_spec_hash_is_that_of_the_specification(endpoint: str) -> None:
    (info,) = twinstep.discover(endpoint)
    text = (
        "observation observation_0:2 observation_1:1\naction action_0:1\njoint_order \npolicy_dt 0.03333333333333333\n"
        "kp 0\nkd 0\naction_scale 1\ndefault_pose \n"
    )
    assert info.spec is not None
    assert info.spec.hash == hashlib.sha256(text.encode()).digest()[:16].hex()
    with pytest.raises(twinstep.SpecMismatchError):
        Go2VectorEnv(1, endpoint=endpoint, task="Pendulum-v1", spec_hash="00")
