"""Ctrl-C during training."""

import os
import signal
import subprocess
import sys
import textwrap

import pytest
from test_env import assert_ends

pytest.importorskip("stable_baselines3", reason='Stable-Baselines3 is not installed: pip install "twinstep[sb3]"')

# A shell starts programs in the background with SIGINT ignored, and Python keeps that.
PROGRAM = textwrap.dedent("""
    import signal

    signal.signal(signal.SIGINT, signal.default_int_handler)

    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from twinstep.sb3 import make_vec_env


    class Learning(BaseCallback):
        def _on_step(self):
            if self.n_calls == 100:
                print("learning", flush=True)
            return True


    torch.set_num_threads(1)
    envs = make_vec_env(n_envs=4)
    print(envs.envs._remote._connection._server.pid, flush=True)
    PPO("MlpPolicy", envs, n_steps=32, batch_size=64).learn(10_000_000, callback=Learning())
""")


def test_interrupted_training_leaves_no_process_behind() -> None:
    agent = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    assert agent.stdout is not None
    server = int(agent.stdout.readline())
    # Only now: an interrupt during an import of torch may end in its C++ code.
    assert "learning" in iter(lambda: agent.stdout.readline().strip(), "")
    os.killpg(agent.pid, signal.SIGINT)
    _, printed = agent.communicate(timeout=60)
    assert "KeyboardInterrupt" in printed
    assert_ends(server)
