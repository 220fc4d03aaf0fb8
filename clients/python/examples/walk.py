"""Walk with a policy of ``twinstep train``, in simulation or on the robot: only the endpoint differs.

Needs onnxruntime. Example: ``python walk.py data/policies/walk.onnx --endpoint tcp/192.168.1.20:7447``
"""

import argparse

import gymnasium as gym
import numpy as np
import onnxruntime

import twinstep

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("policy", help="policy.onnx of `twinstep train`")
parser.add_argument("--endpoint", help="server or robot; default: a simulation in this computer")
parser.add_argument("--velocity", type=float, nargs=3, default=[0.5, 0.0, 0.0], metavar=("VX", "VY", "WZ"))
parser.add_argument("--seconds", type=float, default=10.0)
args = parser.parse_args()

network = onnxruntime.InferenceSession(args.policy, providers=["CPUExecutionProvider"])
env = gym.make("twinstep/Go2-Walk-v0", endpoint=args.endpoint)
go2 = env.unwrapped
assert isinstance(go2, twinstep.Go2Env)
go2.set_velocity_command(np.array(args.velocity, dtype=np.float32))
obs, _ = env.reset(seed=1)
falls, late = 0, 0
for _ in range(round(args.seconds / go2.twinstep_spec.policy_dt)):
    action = np.asarray(network.run(None, {network.get_inputs()[0].name: obs[None]})[0], dtype=np.float32)[0]
    obs, _, terminated, truncated, info = env.step(np.clip(action, -1.0, 1.0))
    late += "refused" in info
    if terminated or truncated:
        falls += terminated
        print(info.get("fault", "the episode has ended"))
        obs, _ = env.reset()
env.close()
print(f"{falls} falls, {late} late actions")
