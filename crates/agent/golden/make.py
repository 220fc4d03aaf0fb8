"""Writes small networks as exporters write them, with random inputs and the outputs of onnxruntime.

Needs torch, onnx, onnxscript and onnxruntime. One JSON file a network: `inputs` and `outputs` by name, each a list of steps.
"""

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

warnings.filterwarnings("ignore")
OUT = Path(sys.argv[1])
torch.manual_seed(1)
random = np.random.default_rng(1)
OBS, ACT = 9, 3


def run(name, states=()):
    onnx.load(OUT / f"{name}.onnx")
    session = ort.InferenceSession(str(OUT / f"{name}.onnx"), providers=["CPUExecutionProvider"])
    steps, kept = [], {}
    for _ in range(3):
        feed = {}
        for port in session.get_inputs():
            shape = [d if isinstance(d, int) else 1 for d in port.shape]
            feed[port.name] = kept.get(
                port.name,
                random.normal(size=shape).astype(np.float32)
                if port.name not in dict(states)
                else np.zeros(shape, np.float32),
            )
        out = session.run(None, feed)
        names = [o.name for o in session.get_outputs()]
        result = dict(zip(names, out, strict=False))
        steps.append(
            {
                "inputs": {k: v.ravel().tolist() for k, v in feed.items()},
                "outputs": {k: np.asarray(v, np.float32).ravel().tolist() for k, v in result.items()},
            }
        )
        kept = {i: result[o] for i, o in states}
    (OUT / f"{name}.json").write_text(json.dumps(steps))


def export(name, module, inputs, outputs, args, dynamo, states=(), opset=None, dynamic=None):
    kwargs = {"input_names": inputs, "output_names": outputs, "dynamo": dynamo}
    if opset:
        kwargs["opset_version"] = opset
    if dynamic and not dynamo:
        kwargs["dynamic_axes"] = dynamic
    if dynamo:
        kwargs["external_data"] = False
        kwargs["verbose"] = False
    torch.onnx.export(module.eval(), args, str(OUT / f"{name}.onnx"), **kwargs)
    run(name, states)


class Recurrent(nn.Module):
    """As rsl_rl exports an actor with memory."""

    def __init__(self, kind):
        super().__init__()
        self.rnn = getattr(nn, kind)(OBS, 5, num_layers=2)
        self.actor = nn.Sequential(nn.Linear(5, 4), nn.ELU(), nn.Linear(4, ACT))
        self.kind = kind

    def forward(self, obs, h_in, c_in=None):
        state = (h_in, c_in) if self.kind == "LSTM" else h_in
        x, state = self.rnn(obs.unsqueeze(0), state)
        action = self.actor(x.squeeze(0))
        return (action, *state) if self.kind == "LSTM" else (action, state)


class TwoInputs(nn.Module):
    """An observation and its history apart, with a variational encoder: DreamWaQ, RMA."""

    def __init__(self):
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(5 * OBS, 8), nn.ELU(), nn.Linear(8, 2 * 4))
        self.actor = nn.Sequential(nn.Linear(OBS + 4, 8), nn.ELU(), nn.Linear(8, ACT))

    def forward(self, obs, obs_history):
        mean, _ = torch.chunk(self.encoder(obs_history), 2, dim=-1)
        return self.actor(torch.cat([mean, obs], dim=-1))


class Adaptation(nn.Module):
    """A convolution over time, as the adaptation module of RMA."""

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(OBS, 4)
        self.convolution = nn.Sequential(
            nn.Conv1d(4, 6, 3, stride=2), nn.ReLU(), nn.Conv1d(6, 4, 2, padding=1, dilation=2), nn.ReLU(), nn.Flatten()
        )
        self.actor = nn.LazyLinear(ACT)

    def forward(self, obs):
        x = self.linear(obs.reshape(-1, 10, OBS)).permute(0, 2, 1)
        return torch.tanh(self.actor(self.convolution(x)))


class Transformer(nn.Module):
    def __init__(self):
        super().__init__()
        self.token = nn.Linear(OBS, 8)
        self.layer = nn.TransformerEncoderLayer(8, 2, 16, activation="gelu", batch_first=True)
        self.actor = nn.Linear(8, ACT)

    def forward(self, obs):
        x = self.token(obs.view(1, 5, OBS))
        return self.actor(self.layer(x)[:, -1])


class Normalised(nn.Module):
    def __init__(self, activation):
        super().__init__()
        self.mean, self.std = nn.Buffer(torch.randn(OBS)), nn.Buffer(torch.rand(OBS) + 0.5)
        self.net = nn.Sequential(
            nn.Linear(OBS, 6), nn.LayerNorm(6), activation, nn.Linear(6, 6), activation, nn.Linear(6, ACT)
        )

    def forward(self, obs):
        x = torch.clamp((obs - self.mean) / (self.std + 1e-2), -5, 5)
        x = torch.where(x.abs() > 4, torch.zeros_like(x), x)
        return self.net(x)


for dynamo in (False, True):
    end = "dynamo" if dynamo else "script"
    lstm, gru = Recurrent("LSTM"), Recurrent("GRU")
    obs, h = torch.zeros(1, OBS), torch.zeros(2, 1, 5)
    export(
        f"lstm_{end}",
        lstm,
        ["obs", "h_in", "c_in"],
        ["actions", "h_out", "c_out"],
        (obs, h, h),
        dynamo,
        [("h_in", "h_out"), ("c_in", "c_out")],
    )
    export(f"gru_{end}", gru, ["obs", "h_in"], ["actions", "h_out"], (obs, h), dynamo, [("h_in", "h_out")])
    export(
        f"two_inputs_{end}", TwoInputs(), ["obs", "obs_history"], ["actions"], (obs, torch.zeros(1, 5 * OBS)), dynamo
    )
    adaptation = Adaptation()
    adaptation(torch.zeros(1, 10 * OBS))
    export(f"adaptation_{end}", adaptation, ["obs"], ["actions"], (torch.zeros(1, 10 * OBS),), dynamo)
    export(f"transformer_{end}", Transformer(), ["obs"], ["actions"], (torch.zeros(1, 5 * OBS),), dynamo)
    export(f"gelu_{end}", Normalised(nn.GELU()), ["obs"], ["actions"], (obs,), dynamo)
    export(f"mish_{end}", Normalised(nn.Mish()), ["obs"], ["actions"], (obs,), dynamo, opset=18 if dynamo else 17)
    export(f"silu_{end}", Normalised(nn.SiLU()), ["obs"], ["actions"], (obs,), dynamo)
export(
    "elu_opset11",
    nn.Sequential(nn.Linear(OBS, 6), nn.ELU(), nn.Linear(6, ACT)),
    ["obs"],
    ["actions"],
    (torch.zeros(1, OBS),),
    False,
    opset=11,
    dynamic={"obs": {0: "batch"}, "actions": {0: "batch"}},
)


# As brax and tf2onnx write a policy with a Gaussian head: Sub, Mul, Gemm, swish, Split, Tanh, opset 11.
def f(*shape):
    return random.normal(size=shape).astype(np.float32)


initial = {"mean": f(OBS), "factor": f(OBS), "w1": f(OBS, 8), "b1": f(8), "w2": f(8, 2 * ACT), "b2": f(2 * ACT)}
nodes = [
    helper.make_node("Sub", ["obs", "mean"], ["a"]),
    helper.make_node("Mul", ["a", "factor"], ["b"]),
    helper.make_node("Gemm", ["b", "w1", "b1"], ["c"]),
    helper.make_node("Sigmoid", ["c"], ["d"]),
    helper.make_node("Mul", ["c", "d"], ["e"]),
    helper.make_node("Gemm", ["e", "w2", "b2"], ["g"]),
    helper.make_node("Split", ["g"], ["loc", "scale"], axis=-1, split=[ACT, ACT]),
    helper.make_node("Tanh", ["loc"], ["continuous_actions"]),
]
graph = helper.make_graph(
    nodes,
    "policy",
    [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, OBS])],
    [helper.make_tensor_value_info("continuous_actions", TensorProto.FLOAT, [1, ACT])],
    [numpy_helper.from_array(v, k) for k, v in initial.items()],
)
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 11)])
model.ir_version = 7
onnx.save(model, OUT / "brax_split.onnx")
run("brax_split")
