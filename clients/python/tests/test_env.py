"""One robot and many, on the bundled server."""

import os
import signal
import stat
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import twinstep
from twinstep import Go2Env, Go2VectorEnv
from twinstep.remote import RemoteVecEnv


@pytest.fixture
def counters() -> Iterator[Go2VectorEnv]:
    envs = Go2VectorEnv(3, task="counter")
    envs.reset()
    yield envs
    envs.close()


def test_observation_and_action_have_the_shapes_and_bounds_of_the_spec() -> None:
    with Go2Env() as env:
        obs, info = env.reset(seed=1)
        assert env.observation_space.contains(obs)
        assert (obs.shape, obs.dtype, info) == ((45,), np.float32, {})
        obs, reward, terminated, truncated, info = env.step(np.zeros(12, np.float32))
        assert env.observation_space.contains(obs)
        assert (type(reward), terminated, truncated, info) == (float, False, False, {})
        assert env.twinstep_spec.joint_order[:3] == ("FL_hip", "FL_thigh", "FL_calf")


def test_row_of_a_vector_is_the_single_environment_with_its_seed() -> None:
    actions = np.random.default_rng(1).uniform(-1, 1, (100, 3, 12)).astype(np.float32)
    envs = gym.make_vec("twinstep/Go2-Walk-v0", num_envs=3, max_episode_steps=40)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    rows = [envs.reset(seed=5)[0]] + [envs.step(action)[0] for action in actions[:39]]
    envs.close()
    with Go2Env(max_episode_steps=40) as env:
        single = [env.reset(seed=6)[0]] + [env.step(action[1])[0] for action in actions[:39]]
    np.testing.assert_array_equal(np.array(rows)[:, 1], single)


def test_velocity_commands_of_the_agent_replace_those_of_the_task() -> None:
    commands = np.array([[0.5, 0.0, 0.0], [-0.25, 0.125, 1.0]], np.float32)
    envs = Go2VectorEnv(2, max_episode_steps=3)
    envs.reset(seed=1)
    envs.set_velocity_commands(commands)
    for _ in range(5):
        obs = envs.step(np.zeros((2, 12), np.float32))[0]
        np.testing.assert_array_equal(obs[:, 6:9], commands)
    with pytest.raises(twinstep.InvalidOptionError, match=r"environment 1: velocity_command\[0\] is 7.0; -5 to 5"):
        envs.set_velocity_commands(np.array([[0, 0, 0], [7, 0, 0]], np.float32))
    envs.close()
    with Go2Env() as env:
        env.reset(seed=1)
        env.set_velocity_command(commands[1])
        np.testing.assert_array_equal(env.step(np.zeros(12, np.float32))[0][6:9], commands[1])


def test_gait_commands_of_the_agent_replace_those_of_the_task() -> None:
    gaits = np.array([[2.5, 0.5, 0.5, 0.0], [3.5, 0.0, 0.5, 0.5]], np.float32)
    envs = Go2VectorEnv(2, task="gait", max_episode_steps=3)
    envs.reset(seed=1)
    envs.set_gait_commands(gaits)
    for _ in range(5):
        np.testing.assert_array_equal(envs.step(np.zeros((2, 12), np.float32))[0][:, 45:49], gaits)
    with pytest.raises(twinstep.InvalidOptionError, match=r"environment 1: phase_offset\[2\] is 1.5; 0 to 1"):
        envs.set_gait_commands(np.array([[2, 0, 0, 0], [2, 0, 0, 1.5]], np.float32))
    envs.close()
    with Go2Env() as walker, pytest.raises(twinstep.InvalidOptionError, match="`walk` has no gait command"):
        walker.set_gait_command(gaits[0])


def test_a_task_without_velocity_commands_refuses_them(counters: Go2VectorEnv) -> None:
    counters.set_velocity_commands(np.zeros((3, 3), np.float32))
    with pytest.raises(twinstep.RequestRejectedError, match="the task `counter` has no velocity command"):
        counters.step(np.zeros((3, 12), np.float32))


def test_a_sequence_of_seeds_sets_each_environment() -> None:
    with Go2Env() as env:
        first = env.reset(seed=9)[0]
    envs = Go2VectorEnv(2)
    obs, _ = envs.reset(seed=[3, 9])
    np.testing.assert_array_equal(obs[1], first)
    with pytest.raises(twinstep.InvalidOptionError, match="`seed` has 1 entries; 2 are expected"):
        envs.reset(seed=[3])
    envs.close()


def test_an_environment_without_a_seed_continues_its_random_stream() -> None:
    envs = Go2VectorEnv(3)
    envs.reset(seed=[1, 2, 3])
    continued, _ = envs.reset()
    fresh, _ = envs.reset(seed=[7, 8, 9])
    envs.reset(seed=[1, 2, 3])
    mixed, _ = envs.reset(seed=[7, None, 9])
    np.testing.assert_array_equal(mixed, [fresh[0], continued[1], fresh[2]])
    envs.reset(seed=[1, 2, 3])
    masked, _ = envs.reset(seed=[7, None, 9], options={"reset_mask": np.array([False, True, True])})
    np.testing.assert_array_equal(masked[1:], mixed[1:])
    envs.close()


def test_seeds_with_none_reset_each_environment_once(counters: Go2VectorEnv) -> None:
    for seed in ([1, None, 3], [None, None, None], [None, 0, None]):
        before, _ = counters.reset()
        obs, _ = counters.reset(seed=seed)
        np.testing.assert_array_equal(obs[:, 1], before[:, 1] + 1)


def test_an_incomplete_reset_blocks_steps_until_a_complete_one(
    counters: Go2VectorEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = RemoteVecEnv._send

    def fails_without_seeds(self: RemoteVecEnv, method: str, request: dict[str, object]) -> None:
        if "seeds" not in request:
            raise twinstep.NoServerError("the Zenoh session is closed")
        send(self, method, request)

    monkeypatch.setattr(RemoteVecEnv, "_send", fails_without_seeds)
    with pytest.raises(twinstep.NoServerError):
        counters.reset(seed=[1, None, 3])
    monkeypatch.undo()
    with pytest.raises(twinstep.Error, match="only the environments with a seed were reset"):
        counters.step(np.zeros((3, 12), np.float32))
    counters.reset(seed=[1, None, 3])
    counters.step(np.zeros((3, 12), np.float32))


def test_privileged_observations_are_in_the_info_with_the_option_critic() -> None:
    envs = Go2VectorEnv(2, critic=True, autoreset_mode="SameStep", max_episode_steps=2)
    names = [part.name for part in envs.twinstep_spec.critic_observation]
    assert names == ["true_linear_velocity", "true_angular_velocity", "base_height", "foot_force"]
    _, info = envs.reset(seed=1)
    assert info["critic_obs"].shape == (2, 11)
    assert ((info["critic_obs"][:, 6] > 0.2) & (info["critic_obs"][:, 6] < 0.5)).all(), "height of the base"
    envs.step(np.zeros((2, 12), dtype=np.float32))
    *_, info = envs.step(np.zeros((2, 12), dtype=np.float32))
    assert info["critic_obs"].shape == info["final_info"]["critic_obs"].shape == (2, 11)
    assert (info["critic_obs"] != info["final_info"]["critic_obs"]).any()
    envs.close()
    env = Go2Env(critic=True)
    assert env.reset(seed=1)[1]["critic_obs"].shape == (11,)
    assert env.step(np.zeros(12, dtype=np.float32))[4]["critic_obs"].shape == (11,)
    env.close()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_info_at_the_end_of_an_episode_has_its_reward_terms(mode: str) -> None:
    envs = Go2VectorEnv(2, autoreset_mode=mode, max_episode_steps=4)
    envs.reset(seed=1)
    total = np.zeros(2)
    for _ in range(4):
        obs, reward, _, truncated, infos = envs.step(np.zeros((2, 12), np.float32))
        total += reward
    assert truncated.all()
    if mode == "SameStep":
        assert infos["_final_obs"].all()
        assert not np.array_equal(infos["final_obs"][0], obs[0])
        infos = infos["final_info"]
    terms = infos["reward_terms"]
    assert infos["_reward_terms"].all()
    np.testing.assert_allclose(sum(terms[name] for name in envs.twinstep_spec.reward_terms), total, atol=1e-5)
    if mode == "Disabled":
        with pytest.raises(twinstep.ResetNeededError):
            envs.step(np.zeros((2, 12), np.float32))
        envs.reset(options={"reset_mask": np.array([True, True])})
    envs.step(np.zeros((2, 12), np.float32))
    envs.close()


def test_reset_mask_resets_where_it_is_true(counters: Go2VectorEnv) -> None:
    obs, _ = counters.reset(options={"reset_mask": np.array([False, True, False])})
    assert obs[:, 1].tolist() == [1, 2, 1]
    for mask, words in (
        (np.array([True]), r"bool \(1,\); bool \(3,\) is expected"),
        (np.array([1, 0, 0]), r"int64 \(3,\); bool \(3,\) is expected"),
        (np.zeros(3, np.bool_), "has no true entry"),
    ):
        with pytest.raises(twinstep.InvalidOptionError, match=words):
            counters.reset(options={"reset_mask": mask})
    with pytest.raises(twinstep.InvalidOptionError, match=r"'speed'.*only 'reset_mask' is supported"):
        counters.reset(options={"speed": 1})


def test_returned_arrays_are_new_and_writable(counters: Go2VectorEnv) -> None:
    first = counters.step(np.zeros((3, 12), np.float32))
    kept = [array.copy() for array in first[:4]]
    counters.step(np.ones((3, 12), np.float32))
    for array, copy in zip(first[:4], kept, strict=True):
        np.testing.assert_array_equal(array, copy)
        assert array.flags.writeable


def test_sent_actions_overlap_with_the_policy(counters: Go2VectorEnv) -> None:
    for step in range(1, 20):
        counters.send(np.zeros((3, 12), np.float32))
        with pytest.raises(twinstep.Error, match="last `step` has no reply yet"):
            counters.send(np.zeros((3, 12), np.float32))
        assert (counters.recv()[0][:, 0] == step).all()
    with pytest.raises(twinstep.Error, match="call `send` before `recv`"):
        counters.recv()


def test_round_trip_is_in_the_info_only_with_info_timing(counters: Go2VectorEnv) -> None:
    assert counters.step(np.zeros((3, 12), np.float32))[4] == {}
    envs = Go2VectorEnv(2, task="counter", info_timing=True)
    envs.reset()
    infos = envs.step(np.zeros((2, 12), np.float32))[4]
    assert 0 < infos["round_trip_s"][0] < 5
    envs.close()


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.zeros((3, 11), np.float32), r"`actions` has shape \(3, 11\); \(3, 12\) is expected"),
        (np.zeros((3, 12), np.complex64), "`actions` has dtype complex64; float32 is expected"),
        (np.full((3, 12), np.nan), r"environment 0, joint_position_offset\[FL_hip\], is nan"),
        (np.where(np.eye(3, 12, 4), np.inf, 0), r"environment 0, joint_position_offset\[FR_thigh\], is inf"),
    ],
)
def test_invalid_actions_are_named_and_not_executed(counters: Go2VectorEnv, actions: np.ndarray, words: str) -> None:
    with pytest.raises(twinstep.InvalidActionError, match=words):
        counters.step(actions)
    assert counters.step(np.zeros((3, 12), np.float32))[0][0, 0] == 1


def test_environments_of_one_process_share_a_server_until_the_last_is_closed() -> None:
    first, second = Go2VectorEnv(1, task="counter"), Go2VectorEnv(1, task="counter")
    server = first._remote._connection._server
    assert server is second._remote._connection._server
    first.close()
    assert server.alive
    second.close()
    assert not server.alive


def test_server_of_a_program_can_be_reached_by_its_user_only() -> None:
    envs = Go2VectorEnv(1, task="counter")
    protocol, _, socket = envs._remote._connection._server.endpoint.partition("/")
    folder = Path(socket).parent
    assert protocol == "unixsock-stream"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    envs.close()
    assert not folder.exists()


def test_server_starts_where_the_folder_for_temporary_files_has_a_long_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / ("long" * 30)
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    envs = Go2VectorEnv(1, task="counter")
    envs.reset()
    envs.close()


@pytest.mark.parametrize("cause", ["exit", "SIGKILL"])
def test_server_terminates_with_its_parent(cause: str) -> None:
    program = textwrap.dedent("""
        import sys, twinstep
        envs = twinstep.Go2VectorEnv(1, task="counter")
        print(envs._remote._connection._server.pid, flush=True)
        sys.stdin.read()
    """)
    parent = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    server = int(parent.stdout.readline())
    if cause == "SIGKILL":
        parent.kill()
    parent.communicate()
    assert_ends(server)


def assert_ends(server: int) -> None:
    for _ in range(400):
        if not is_running(server):
            return
        time.sleep(0.05)
    os.kill(server, signal.SIGKILL)
    raise AssertionError("the server still runs 20 s after its parent has terminated")


def is_running(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as line:
            return line.read().split()[2] != "Z"
    except FileNotFoundError:
        return False
