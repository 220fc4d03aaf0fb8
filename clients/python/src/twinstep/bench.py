"""Measure the stepping rate from Python, compared with baselines: ``python -m twinstep.bench [--json]``.

Baselines that are not installed are skipped with a message on stderr: ``pip install "twinstep[bench]"``.
"""

import argparse
import importlib.util
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from .grouped import GroupedVecEnv
from .options import ConnectOptions
from .server import find_program
from .vector_env import Go2VectorEnv

WINDOWS = 5
NUM_ENVS = (1, 64, 1024)
ANT_ENVS = 64
GROUPS, GROUP_ENVS = 3, 64
SHARED_MEMORY_ENVS = (1024, 4096)

Row = dict[str, Any]


def measure_rate(once: Callable[[], object], window_s: float) -> tuple[float, float]:
    """Return the calls per second and the median time of a call [µs], each the median of five windows."""
    once()
    rates, medians = list[float](), list[float]()
    for _ in range(WINDOWS):
        times = list[float]()
        since = last = time.perf_counter()
        while last - since < window_s:
            once()
            now = time.perf_counter()
            times.append(now - last)
            last = now
        rates.append(len(times) / (last - since))
        medians.append(1e6 * statistics.median(times))
    return statistics.median(rates), statistics.median(medians)


def measure_alternately(cases: Sequence[Callable[[], object]], window_s: float) -> list[float]:
    """Return the calls per second of each case, the median of five windows.

    The windows alternate, so that other programs on the machine disturb all cases alike.
    """
    rates: list[list[float]] = [[] for _ in cases]
    for once in cases:
        once()
    for _ in range(WINDOWS):
        for once, of_case in zip(cases, rates, strict=True):
            calls, since = 0, time.perf_counter()
            while time.perf_counter() - since < window_s:
                once()
                calls += 1
            of_case.append(calls / (time.perf_counter() - since))
    return [statistics.median(of_case) for of_case in rates]


@contextmanager
def stepping(num_envs: int, task: str, *, shared_memory: bool = False) -> Generator[Callable[[], object], None, None]:
    """Yield a function that executes one step of ``num_envs`` robots of the bundled server."""
    envs = Go2VectorEnv(num_envs, task=task, shared_memory=shared_memory)
    envs.reset(seed=1)
    actions = np.zeros((num_envs, 12), np.float32)
    try:
        yield lambda: envs.step(actions)
    finally:
        envs.close()


def transport(window_s: float) -> Iterator[Row]:
    """Measure the transport without physics, compared with dm_env_rpc with the same observation."""
    reference = dm_env_rpc_rate(window_s)
    for num_envs in NUM_ENVS:
        with stepping(num_envs, "counter") as step:
            rate, median_us = measure_rate(step, window_s)
        yield row(f"physics off, {num_envs} envs", rate, "round trips/s")
        yield row(f"physics off, {num_envs} envs, p50", median_us, "us")
        yield row(f"physics off, {num_envs} envs", rate * num_envs, "env-steps/s", "dm_env_rpc", reference)


def physics(window_s: float) -> Iterator[Row]:
    """Measure steps with physics, compared with the same environments in process and Ant-v5 of the baselines."""
    program = subprocess.run(
        [find_program(), "bench", "remote", "--json", "--window-s", str(window_s)], capture_output=True, check=True
    )
    in_process = {each["case"]: each["value"] for each in json.loads(program.stdout)["rows"]}
    for num_envs in NUM_ENVS:
        with stepping(num_envs, "walk") as step:
            rate = measure_rate(step, window_s)[0] * num_envs
        local = in_process.get(f"walk in process, {num_envs} envs")
        yield row(f"walk, {num_envs} envs", rate, "env-steps/s", "the same in process, in Rust", local)
        if num_envs == ANT_ENVS:
            for baseline, baseline_rate in ant_rates(window_s):
                yield row(f"walk, {num_envs} envs", rate, "env-steps/s", f"{baseline}, Ant-v5", baseline_rate)


def shared_memory(window_s: float) -> Iterator[Row]:
    """Measure the transport through shared memory, compared with TCP."""
    for num_envs in SHARED_MEMORY_ENVS:
        with stepping(num_envs, "counter") as tcp, stepping(num_envs, "counter", shared_memory=True) as shared:
            rates = measure_alternately([shared, tcp], window_s)
        yield row(f"shared memory, {num_envs} envs", rates[0], "round trips/s", "TCP", rates[1])


def groups(window_s: float) -> Iterator[Row]:
    """Measure three groups of 64 robots in flight, compared with one lease of 64 and one of 192.

    The actions come from a small network: the groups step while it computes.
    """
    generator = np.random.default_rng(1)
    weights = [generator.normal(0, 0.05, size).astype(np.float32) for size in ((45, 256), (256, 12))]

    def policy(obs: NDArray[np.float32]) -> NDArray[np.float32]:
        for weight in weights:
            # Not `@`: the threads of BLAS compete with the server for the cores.
            obs = np.tanh(np.einsum("ij,jk->ik", obs, weight))
        return obs

    num_envs = GROUPS * GROUP_ENVS
    options = ConnectOptions()
    together, one, all_rows = (
        GroupedVecEnv(options, groups=count, num_envs=envs, autoreset="NextStep", max_episode_steps=None)
        for count, envs in ((GROUPS, num_envs), (1, GROUP_ENVS), (1, num_envs))
    )

    def step_groups() -> None:
        for group in range(GROUPS):
            together.send(group, policy(together.recv(group).obs))

    def stepped(envs: GroupedVecEnv) -> Callable[[], object]:
        last = [envs.reset(np.arange(envs.num_envs, dtype=np.uint64), None)]

        def step() -> None:
            last[0] = envs.step(policy(last[0])).obs

        return step

    obs = together.reset(np.arange(num_envs, dtype=np.uint64), None)
    for group in range(GROUPS):
        together.send(group, policy(obs[together.rows(group)]))
    rates = measure_alternately([step_groups, stepped(one), stepped(all_rows)], window_s)
    in_flight, of_one, of_all = rates[0] * num_envs, rates[1] * GROUP_ENVS, rates[2] * num_envs
    case = f"walk, {GROUPS} groups of {GROUP_ENVS}"
    yield row(case, in_flight, "env-steps/s", f"one group of {GROUP_ENVS}", of_one)
    yield row(case, in_flight, "env-steps/s", f"{num_envs} in one lease", of_all)
    for envs in (together, one, all_rows):
        envs.close()


def row(case: str, value: float, unit: str, reference: str | None = None, reference_value: float | None = None) -> Row:
    """Return one measurement; ``ratio`` is our value divided by that of the reference."""
    known = reference_value is not None
    return {
        "case": case,
        "value": value,
        "unit": unit,
        "reference": f"{reference}: {reference_value:.0f}" if known else None,
        "ratio": value / reference_value if known else None,
    }


def ant_rates(window_s: float) -> Iterator[tuple[str, float]]:
    """Measure the env-steps per second of 64 Ant-v5 in each installed baseline."""
    actions = np.zeros((ANT_ENVS, 8), np.float32)
    if installed("mujoco"):
        for mode in ("sync", "async"):
            envs = gymnasium.make_vec("Ant-v5", num_envs=ANT_ENVS, vectorization_mode=mode)
            envs.reset(seed=1)
            yield f"Gymnasium {mode}", measure_rate(lambda envs=envs: envs.step(actions), window_s)[0] * ANT_ENVS
            envs.close()
    if installed("envpool"):
        envpool: Any = importlib.import_module("envpool")
        pool = envpool.make_gymnasium("Ant-v5", num_envs=ANT_ENVS)
        pool.reset()
        yield "EnvPool", measure_rate(lambda: pool.step(actions.astype(np.float64)), window_s)[0] * ANT_ENVS
        pool.close()


def dm_env_rpc_rate(window_s: float) -> float | None:
    """Measure the env-steps per second of one dm_env_rpc environment of the same shapes, over loopback."""
    if not installed("dm_env_rpc"):
        return None
    from .baseline_dm_env_rpc import remote_step

    with remote_step() as step:
        return measure_rate(step, window_s)[0]


def installed(module: str) -> bool:
    """Return true if a baseline is installed; print a message if not."""
    if importlib.util.find_spec(module) is not None:
        return True
    print(f'skipped: {module} is not installed (pip install "twinstep[bench]")', file=sys.stderr)
    return False


PARTS: dict[str, Callable[[float], Iterator[Row]]] = {
    "transport": transport,
    "shared-memory": shared_memory,
    "physics": physics,
    "groups": groups,
}


def main() -> None:
    """Run the measurements and print the results."""
    parser = argparse.ArgumentParser(prog="python -m twinstep.bench", description=__doc__)
    parser.add_argument("what", nargs="?", choices=list(PARTS), help="default: all")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--window-s", type=float, default=1.0, help="length of one of the five windows of each case")
    arguments = parser.parse_args()
    chosen = [PARTS[arguments.what]] if arguments.what else list(PARTS.values())
    rows = list[Row]()
    for part in chosen:
        for each in part(arguments.window_s):
            rows.append(each)
            if not arguments.json:
                comparison = f"   {each['ratio']:.2f} of {each['reference']}" if each["ratio"] is not None else ""
                print(f"{each['case']:<32}{each['value']:>12.0f} {each['unit']:<14}{comparison}", flush=True)
    if arguments.json:
        machine = f"{platform.processor() or platform.machine()}, Python {platform.python_version()}"
        print(json.dumps({"rows": rows, "machine": machine}))


if __name__ == "__main__":
    main()
