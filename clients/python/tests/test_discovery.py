"""Discovery of servers at an endpoint."""

import os
import signal
import time

import pytest
from loopback import free_endpoint, router, suspend, wait_for_servers

import twinstep
from twinstep import EmbeddedServer, Go2VectorEnv, discover


def test_servers_behind_a_router_are_found_with_task_and_free_environments() -> None:
    with router() as endpoint:
        assert discover(endpoint) == []
        walk = EmbeddedServer(("--task", "walk", "--name", "rex", "--envs", "8", "--connect", endpoint))
        counter = EmbeddedServer(("--task", "counter", "--name", "fido", "--envs", "4", "--connect", endpoint))
        wait_for_servers(endpoint, 2)
        envs = Go2VectorEnv(3, robot="rex", endpoint=endpoint)
        envs.reset(seed=1)
        envs.step(envs.action_space.sample())
        fido, rex = discover(endpoint)
        assert [(info.endpoint, info.robot, info.reachable) for info in (fido, rex)] == [
            (endpoint, "fido", True),
            (endpoint, "rex", True),
        ]
        assert (rex.max_envs, rex.free_envs, rex.max_envs_per_client, rex.env_steps) == (8, 5, 8, 3)
        assert (fido.max_envs, fido.free_envs, fido.max_envs_per_client, fido.env_steps) == (4, 4, 4, 0)
        assert rex.spec is not None
        assert fido.spec is not None
        assert (rex.spec.task, fido.spec.task, rex.spec.robot) == ("walk", "counter", "go2")
        assert (rex.spec.hash, rex.server_id) == (envs.twinstep_spec.hash, envs._remote._connection.server_id)
        assert rex.protocols == (1, 1)
        assert (rex.server_version or "").startswith("twinstep ")
        envs.close()
        walk.release()
        counter.release()


def test_a_server_that_does_not_answer_is_not_reachable() -> None:
    with router() as endpoint:
        first = EmbeddedServer(("--task", "counter", "--name", "rex", "--connect", endpoint))
        second = EmbeddedServer(("--task", "counter", "--name", "fido", "--connect", endpoint))
        wait_for_servers(endpoint, 2)
        suspend(second.pid)
        since = time.monotonic()
        fido, rex = discover(endpoint, timeout_s=0.5)
        assert time.monotonic() - since < 3
        assert (fido.robot, fido.reachable, fido.spec, fido.free_envs) == ("fido", False, None, None)
        assert (rex.robot, rex.reachable, rex.free_envs) == ("rex", True, 4096)
        os.kill(second.pid, signal.SIGCONT)
        first.release()
        second.release()


def test_client_takes_the_server_with_the_most_free_environments() -> None:
    with router() as endpoint:
        servers = [EmbeddedServer(("--task", "counter", "--envs", n, "--connect", endpoint)) for n in ("4", "6")]
        small, large = sorted(wait_for_servers(endpoint, 2), key=lambda info: info.max_envs or 0)
        found: list[str] = []
        for robot in (None, "go2", None):
            envs = Go2VectorEnv(1, task="counter", endpoint=endpoint, robot=robot)
            found.append(envs._remote._connection.server_id)
            if len(found) == 1:
                filler = Go2VectorEnv(4, task="counter", endpoint=endpoint)
            envs.close()
        assert found == [large.server_id, small.server_id, small.server_id]
        filler.close()
        for server in servers:
            server.release()


def test_a_server_that_does_not_answer_for_a_second_is_not_chosen() -> None:
    with router() as endpoint:
        servers = [EmbeddedServer(("--task", "counter", "--envs", n, "--connect", endpoint)) for n in ("4", "6")]
        small, _ = sorted(wait_for_servers(endpoint, 2), key=lambda info: info.max_envs or 0)
        suspend(servers[1].pid)
        since = time.monotonic()
        envs = Go2VectorEnv(1, task="counter", endpoint=endpoint)
        assert time.monotonic() - since > 0.9
        assert envs._remote._connection.server_id == small.server_id
        os.kill(servers[1].pid, signal.SIGCONT)
        envs.close()
        for server in servers:
            server.release()


def test_client_does_not_choose_between_different_robots_or_tasks() -> None:
    with router() as endpoint:
        servers = [
            EmbeddedServer(("--task", task, "--name", name, "--connect", endpoint))
            for task, name in (("counter", "go2"), ("walk", "go2"), ("counter", "spot"))
        ]
        wait_for_servers(endpoint, 3)
        for robot, words in (
            (None, "3 robots are visible, and `robot` is not set; visible: "),
            ("go2", "2 robots have the name `go2`, and differ in task or layout or do not reply; visible: "),
        ):
            since = time.monotonic()
            with pytest.raises(twinstep.AmbiguousRobotError, match=words):
                Go2VectorEnv(1, task="counter", endpoint=endpoint, robot=robot, connect_timeout_s=1.0)
            assert time.monotonic() - since > 0.9
        Go2VectorEnv(1, task="counter", endpoint=endpoint, robot="spot").close()
        for server in servers:
            server.release()


def test_invalid_endpoint_and_timeout_are_errors() -> None:
    with pytest.raises(twinstep.NoServerError, match="no program accepts connections there"):
        discover(free_endpoint(), connect_timeout_s=0.3)
    with pytest.raises(twinstep.InvalidOptionError, match="`timeout_s` = 0 s; must be greater than 0"):
        discover("tcp/127.0.0.1:9", timeout_s=0)
