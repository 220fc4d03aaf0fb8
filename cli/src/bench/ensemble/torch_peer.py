"""The networks of `twinstep bench ensemble` in PyTorch, on one thread.

Reads a line of JSON (hidden, members, robots, window_s), answers with the queries that it has, and then to each query,
"members robots", with the median time in microseconds of one row of every joint, over one window.
"""

import json
import sys
import time

try:
    import torch
    from torch.nn.functional import softplus
except ImportError as error:
    sys.exit(f"lacks PyTorch: {error}")

torch.set_num_threads(1)
torch.manual_seed(1)


class Member:
    """One network, by PyTorch's own LSTM cell."""

    def __init__(self, hidden, rows):
        self.cell = torch.nn.LSTMCell(2, hidden)
        head = lambda: torch.nn.Sequential(torch.nn.Linear(hidden, hidden), torch.nn.ReLU(), torch.nn.Linear(hidden, 1))
        self.mean, self.variance = head(), head()
        self.state = (torch.zeros(rows, hidden), torch.zeros(rows, hidden))

    def hear(self, errors):
        self.state = self.cell(errors, self.state)
        hidden = self.state[0]
        return self.mean(hidden), softplus(self.variance(hidden)) + 1e-6


class Stack:
    """Several networks as one batched product, and how much they disagree."""

    def __init__(self, members, hidden, rows):
        random = lambda *shape: 0.2 * torch.randn(*shape)
        self.weight, self.bias = random(members, 2 + hidden, 4 * hidden), random(members, 1, 4 * hidden)
        self.layers = [random(members, hidden, 2 * hidden), random(members, 1, 2 * hidden)]
        self.outputs = [random(members, hidden, 1) for _ in range(2)]
        self.hidden = hidden
        self.state = [torch.zeros(members, rows, hidden) for _ in range(2)]

    def hear(self, errors):
        state, cell = self.state
        heard = torch.cat([errors.expand(state.shape[0], -1, -1), state], 2)
        into, forget, new, out = torch.baddbmm(self.bias, heard, self.weight).chunk(4, 2)
        cell = forget.sigmoid() * cell + into.sigmoid() * new.tanh()
        state = out.sigmoid() * cell.tanh()
        self.state = [state, cell]
        layers = torch.baddbmm(self.layers[1], state, self.layers[0]).relu().chunk(2, 2)
        mean, raw = (layer.contiguous() @ output for layer, output in zip(layers, self.outputs))
        variance = softplus(raw) + 1e-6
        apart, both = mean.unsqueeze(0) - mean.unsqueeze(1), variance.unsqueeze(0) + variance.unsqueeze(1)
        product = variance.unsqueeze(0) * variance.unsqueeze(1)
        alike = (2 * product.sqrt() / both).sqrt() * (-0.5 * apart * apart / both).exp()
        return -alike.mean((0, 1)).log()


def window(network, errors, seconds):
    times = []
    since = last = time.perf_counter()
    while last - since < seconds or not times:
        network.hear(errors)
        now = time.perf_counter()
        times.append(now - last)
        last = now
    return 1e6 * sorted(times)[len(times) // 2]


def main():
    setup = json.loads(sys.stdin.readline())
    networks = {}
    for members in setup["members"]:
        for robots in setup["robots"]:
            rows = 12 * robots
            network = Member(setup["hidden"], rows) if members == 1 else Stack(members, setup["hidden"], rows)
            networks[f"{members} {robots}"] = (network, torch.randn(rows, 2))
    print(json.dumps(list(networks)), flush=True)
    with torch.inference_mode():
        for line in sys.stdin:
            print(window(*networks[line.strip()], setup["window_s"]), flush=True)


main()
