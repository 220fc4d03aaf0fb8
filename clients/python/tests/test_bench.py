"""Benchmarks run and compare what they say."""

import json
import subprocess
import sys


def test_groups_in_flight_are_compared_with_one_lease() -> None:
    command = [sys.executable, "-m", "twinstep.bench", "groups", "--json", "--window-s", "0.02"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    rows = json.loads(done.stdout)["rows"]
    assert [each["case"] for each in rows] == ["walk, 3 groups of 64"] * 2
    assert [each["reference"].split(":")[0] for each in rows] == ["one group of 64", "192 in one lease"]
    assert all(each["ratio"] > 0 for each in rows)
