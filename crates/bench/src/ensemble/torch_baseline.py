"""The networks of `twinstep bench ensemble` in PyTorch.

Reads one line of JSON (hidden, members, robots, learning, window_s) and prints the names of its measurements. Then it
reads names and prints for each the median time over one window in microseconds. A query, "members robots", is one row
of every joint on one thread. "training threads" is one Adam step of one network on this number of threads.
"""

import json
import sys
import time

try:
    import torch
    from torch.nn.functional import gaussian_nll_loss, softplus
except ImportError as error:
    sys.exit(f"lacks PyTorch: {error}")

torch.manual_seed(1)


class Member:
    """One network with PyTorch's LSTM cell."""

    def __init__(self, hidden, rows):
        self.cell = torch.nn.LSTMCell(2, hidden)
        head = lambda: torch.nn.Sequential(torch.nn.Linear(hidden, hidden), torch.nn.ReLU(), torch.nn.Linear(hidden, 1))
        self.mean, self.variance = head(), head()
        self.state = (torch.zeros(rows, hidden), torch.zeros(rows, hidden))

    def step(self, errors):
        self.state = self.cell(errors, self.state)
        hidden = self.state[0]
        return self.mean(hidden), softplus(self.variance(hidden)) + 1e-6


class Stack:
    """Several networks as one batched product, with their epistemic uncertainty."""

    def __init__(self, members, hidden, rows):
        random = lambda *shape: 0.2 * torch.randn(*shape)
        self.weight, self.bias = random(members, 2 + hidden, 4 * hidden), random(members, 1, 4 * hidden)
        self.layers = [random(members, hidden, 2 * hidden), random(members, 1, 2 * hidden)]
        self.outputs = [random(members, hidden, 1) for _ in range(2)]
        self.hidden = hidden
        self.state = [torch.zeros(members, rows, hidden) for _ in range(2)]

    def step(self, errors):
        state, cell = self.state
        inputs = torch.cat([errors.expand(state.shape[0], -1, -1), state], 2)
        into, forget, new, out = torch.baddbmm(self.bias, inputs, self.weight).chunk(4, 2)
        cell = forget.sigmoid() * cell + into.sigmoid() * new.tanh()
        state = out.sigmoid() * cell.tanh()
        self.state = [state, cell]
        layers = torch.baddbmm(self.layers[1], state, self.layers[0]).relu().chunk(2, 2)
        mean, raw = (layer.contiguous() @ output for layer, output in zip(layers, self.outputs))
        variance = softplus(raw) + 1e-6
        difference, total = mean.unsqueeze(0) - mean.unsqueeze(1), variance.unsqueeze(0) + variance.unsqueeze(1)
        product = variance.unsqueeze(0) * variance.unsqueeze(1)
        overlap = (2 * product.sqrt() / total).sqrt() * (-0.5 * difference * difference / total).exp()
        return -overlap.mean((0, 1)).log()


class Training:
    """Training of one network on sequences with PyTorch's LSTM, loss and optimiser.

    The heads process the rows of all sequences at once.
    """

    def __init__(self, hidden, batch, rows):
        self.lstm = torch.nn.LSTM(2, hidden)
        head = lambda: torch.nn.Sequential(torch.nn.Linear(hidden, hidden), torch.nn.ReLU(), torch.nn.Linear(hidden, 1))
        self.mean, self.variance = head(), head()
        modules = torch.nn.ModuleList([self.lstm, self.mean, self.variance])
        self.optimiser = torch.optim.Adam(modules.parameters(), lr=5e-3)
        self.torques = torch.randn(rows, batch, 1)

    def step(self, errors):
        states, _ = self.lstm(errors)
        variance = softplus(self.variance(states)) + 1e-6
        loss = gaussian_nll_loss(self.mean(states), self.torques, variance)
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()


def window(network, errors, seconds):
    times = []
    network.step(errors)
    since = last = time.perf_counter()
    while last - since < seconds or not times:
        network.step(errors)
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
    batch, rows = setup["learning"]["batch"], setup["learning"]["rows"]
    for threads in setup["learning"]["threads"]:
        network = Training(setup["hidden"], batch, rows)
        networks[f"training {threads}"] = (network, torch.randn(rows, batch, 2))
    print(json.dumps(list(networks)), flush=True)
    for line in sys.stdin:
        name, threads = line.strip(), 1
        if name.startswith("training"):
            threads = int(name.split()[1])
        torch.set_num_threads(threads)
        with torch.inference_mode(not name.startswith("training")):
            print(window(*networks[name], setup["window_s"]), flush=True)


main()
