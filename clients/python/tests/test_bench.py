"""Benchmarks run and compare what they say."""

import json
import subprocess
import sys
from typing import Any


def bench(what: str) -> list[dict[str, Any]]:
    command = [sys.executable, "-m", "twinstep.bench", what, "--json", "--window-s", "0.02"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return json.loads(done.stdout)["rows"]


def test_groups_in_flight_are_compared_with_one_lease() -> None:
    rows = bench("groups")
    assert [each["case"] for each in rows] == ["walk, 3 groups of 64"] * 2
    assert [each["reference"].split(":")[0] for each in rows] == ["one group of 64", "192 in one lease"]
    assert all(each["ratio"] > 0 for each in rows)


def test_shared_memory_is_compared_with_tcp() -> None:
    rows = bench("shared-memory")
    assert [each["case"] for each in rows] == ["shared memory, 1024 envs", "shared memory, 4096 envs"]
    assert all(each["reference"].startswith("TCP: ") and each["ratio"] > 0 for each in rows)
