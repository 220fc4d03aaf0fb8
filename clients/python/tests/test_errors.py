"""Exceptions and their messages."""

import os
import re
import signal
import socket
import threading
import time

import gymnasium as gym
import numpy as np
import pytest
import zenoh
from loopback import free_endpoint, suspend

import twinstep
from twinstep import EmbeddedServer, Go2Env, Go2VectorEnv
from twinstep.errors import from_reply

STILL = np.zeros((2, 12), np.float32)


def test_error_without_a_server_says_how_to_start_one() -> None:
    with pytest.raises(twinstep.NoServerError) as error:
        Go2Env(endpoint="tcp/127.0.0.1:9", connect_timeout_s=0.3)
    assert re.match(r"no server answers at tcp/127\.0\.0\.1:9 after 0\.\d s \(`connect_timeout_s`\)", str(error.value))
    assert "no program accepts connections there\n  start a server with `twinstep serve`" in str(error.value)


def test_connect_timeout_bounds_the_wait_for_a_program_that_is_not_a_server() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        since = time.monotonic()
        with pytest.raises(twinstep.NoServerError, match="either it is not a Twinstep server, or it rejects"):
            Go2Env(endpoint=f"tcp/127.0.0.1:{silent.getsockname()[1]}", connect_timeout_s=0.5)
        assert 0.4 < time.monotonic() - since < 3


def test_connect_timeout_bounds_the_wait_for_the_first_reply() -> None:
    config, endpoint = zenoh.Config(), free_endpoint()
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    # A liveliness token without a queryable: the server is visible, and no request gets a reply.
    with (
        zenoh.open(config) as session,
        session.liveliness().declare_token("twinstep/live/server/0123/go2"),
        pytest.raises(twinstep.RequestTimeoutError, match=r"hello` after .* s \(`connect_timeout_s`\): the server is"),
    ):
        Go2Env(endpoint=endpoint, connect_timeout_s=0.5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"endpoint": "nonsense"}, "Zenoh rejects `endpoint` = nonsense"),
        ({"zenoh_config": "/no/such/file"}, "`zenoh_config` = /no/such/file: the file does not exist"),
        ({"endpoint": "tcp/127.0.0.1:9", "model": "robot.toml"}, "`config` and `model` are options of the bundled"),
        ({"timeout_s": 0.0}, "`timeout_s` = 0.0 s; must be greater than 0"),
        ({"connect_timeout_s": -1.0}, "`connect_timeout_s` = -1.0 s; must be greater than 0"),
        ({"render_mode": "ansi"}, "`render_mode` = 'ansi'; expected is 'rgb_array', 'human' or None"),
        ({"max_episode_steps": 0}, "`max_episode_steps` = 0 is not allowed: 1 to"),
    ],
)
def test_errors_name_the_invalid_argument(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(twinstep.InvalidOptionError, match=words):
        Go2Env(**arguments)


def test_errors_name_the_invalid_vector_argument() -> None:
    with pytest.raises(twinstep.InvalidOptionError, match="`num_envs` = 0; must be at least 1"):
        Go2VectorEnv(0)
    with pytest.raises(twinstep.InvalidOptionError, match="expected is one of 'NextStep', 'SameStep', 'Disabled'"):
        Go2VectorEnv(1, autoreset_mode="Sometimes")


def test_error_of_a_server_that_cannot_start_contains_its_log() -> None:
    with pytest.raises(twinstep.ServerStartError, match=r"exit code 2(.|\n)*robot\.toml"):
        Go2Env(model="/no/such/robot.toml")


def test_exploration_without_its_base_policy_says_what_is_missing() -> None:
    with pytest.raises(twinstep.ServerStartError, match=r"`task\.base`"):
        gym.make("twinstep/Go2-Explore-v0")


def test_error_names_the_missing_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TWINSTEP_SERVER", "/no/such/program")
    with pytest.raises(twinstep.ServerNotFoundError, match="`TWINSTEP_SERVER` = /no/such/program is not an executable"):
        Go2Env(task="counter", timeout_s=1.0)


def test_wrong_task_hash_and_robot_are_rejected() -> None:
    server = EmbeddedServer(("--task", "counter", "--name", "fido"))
    with pytest.raises(twinstep.SpecMismatchError, match="has the task `counter`, not `walk`"):
        Go2Env(endpoint=server.endpoint)
    with pytest.raises(twinstep.SpecMismatchError, match="`spec_hash` = 00 differs from this server's"):
        Go2Env(endpoint=server.endpoint, task="counter", spec_hash="00")
    with pytest.raises(twinstep.AmbiguousRobotError, match="0 robots have the name `rex`; visible: fido"):
        Go2Env(endpoint=server.endpoint, task="counter", robot="rex", connect_timeout_s=0.2)
    with Go2Env(endpoint=server.endpoint, task="counter", robot="fido") as env:
        env.reset()
    server.release()


def test_too_many_environments_are_rejected_with_the_number_of_free_ones() -> None:
    server = EmbeddedServer(("--task", "counter", "--envs", "8"))
    with pytest.raises(twinstep.RequestRejectedError, match="`num_envs` = 9 is too large: 8 of 8 are free") as error:
        Go2VectorEnv(9, task="counter", endpoint=server.endpoint)
    assert (error.value.code, error.value.field) == ("too_many_envs", "num_envs")
    server.release()


def test_step_before_reset_is_rejected() -> None:
    with Go2Env(task="counter") as env, pytest.raises(twinstep.ResetNeededError):
        env.step(np.zeros(12, np.float32))


def test_exit_of_the_server_raises_at_once_and_a_new_environment_starts_a_new_server() -> None:
    envs = Go2VectorEnv(2, task="counter")
    envs.reset()
    server = envs._remote._connection._server
    os.kill(server.pid, signal.SIGKILL)
    since = time.monotonic()
    with pytest.raises(twinstep.ServerExitedError, match=r"terminated by signal 9; its last log(.|\n)*robot `go2`"):
        envs.step(STILL)
    assert time.monotonic() - since < 5
    envs.close()
    envs = Go2VectorEnv(2, task="counter")
    envs.reset()
    assert envs.step(STILL)[0][0, 0] == 1
    envs.close()


def test_suspended_server_causes_a_timeout_and_its_step_is_executed_once() -> None:
    envs = Go2VectorEnv(2, task="counter", timeout_s=1.5)
    envs.reset()
    server = envs._remote._connection._server
    suspend(server.pid)
    with pytest.raises(twinstep.RequestTimeoutError, match=r"no reply from unixsock-stream/"):
        envs.step(STILL)
    with pytest.raises(twinstep.Error, match="has no reply yet"):
        envs.send(STILL)
    os.kill(server.pid, signal.SIGCONT)
    assert envs.recv()[0][0, 0] == 1
    assert envs.step(STILL)[0][0, 0] == 2
    envs.close()


def test_closing_does_not_wait_for_a_server_that_does_not_read() -> None:
    server = EmbeddedServer(("--task", "counter"))
    envs = Go2VectorEnv(2, task="counter", endpoint=server.endpoint, timeout_s=0.5, reset_timeout_s=4.0)
    suspend(server.pid)
    # Longer than the lease of the link, after which Zenoh tries to open another.
    with pytest.raises(twinstep.RequestTimeoutError, match=r"connection is lost .* is running and not suspended"):
        envs.reset()
    since = time.monotonic()
    envs._remote._release()
    assert time.monotonic() - since < 5
    os.kill(server.pid, signal.SIGCONT)
    server.release()


def test_reset_waits_for_an_abandoned_step() -> None:
    envs = Go2VectorEnv(2, task="counter", timeout_s=0.5)
    envs.reset()
    server = envs._remote._connection._server
    suspend(server.pid)
    reason = "no longer visible: it has .*, or, without a router, it is unresponsive|is running and not suspended"
    with pytest.raises(TimeoutError, match=reason):
        envs.step(STILL)
    threading.Timer(0.3, os.kill, (server.pid, signal.SIGCONT)).start()
    obs, _ = envs.reset()
    assert obs[0, :2].tolist() == [1, 2], "one step, two resets"
    envs.close()


def test_server_that_simulates_has_no_robot_to_stop() -> None:
    env = Go2Env(task="counter")
    endpoint = env._remote._connection.endpoint
    with pytest.raises(twinstep.RequestRejectedError, match="there is no robot to stop"):
        twinstep.stop_robot(endpoint)
    env.close()


def test_closed_environment_raises() -> None:
    env = Go2Env(task="counter")
    env.close()
    env.close()
    with pytest.raises(twinstep.Error, match="the environment is closed"):
        env.reset()


def test_every_error_reply_is_a_twinstep_error_with_its_hint() -> None:
    for code, kind in (("version", twinstep.VersionError), ("stale_epoch", twinstep.LeaseLostError)):
        error = from_reply(code, "", "what", "how")
        assert type(error) is kind
        assert str(error) == "what\n  how"
    assert isinstance(from_reply("brand_new", "field", "what", ""), twinstep.RequestRejectedError)
