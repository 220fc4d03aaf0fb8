import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from twinstep.convert_npz import JOINTS, ConversionError, columns, main
from twinstep.server import find_program

ROWS = 200


def arrays() -> dict[str, np.ndarray]:
    t = np.arange(ROWS) / 200
    q_cmd = np.tile([0.0, 0.8, -1.5], 4) + 0.2 * np.sin(8 * t)[:, None]
    return {"t": t, "q_cmd": q_cmd, "q": 0.9 * q_cmd, "quat": np.tile([1.0, 0.0, 0.0, 0.0], (ROWS, 1))}


def test_arrays_become_columns_in_the_order_of_the_joints():
    order = [*JOINTS[3:], *JOINTS[:3]]
    table = columns(arrays(), order)
    assert len(table) == 1 + 12 + 12 + 4
    np.testing.assert_array_equal(table["q_FR_thigh"], arrays()["q"][:, 1])
    np.testing.assert_array_equal(table["quat_w"], np.ones(ROWS))


@pytest.mark.parametrize(
    ("name", "array", "expected"),
    [
        ("q", np.zeros((ROWS, 3)), "`q` has 3 columns; it needs 12"),
        ("torque", np.zeros((ROWS, 12)), "quantities with several columns are q, dq"),
        ("dq", np.zeros((3, 12)), "`t` has 200 rows"),
        ("t", np.zeros((ROWS, 2)), "array `t` is missing"),
        ("note", np.full(ROWS, "text"), "not numbers"),
    ],
)
def test_wrong_arrays_are_named(name: str, array: np.ndarray, expected: str):
    with pytest.raises(ConversionError, match=expected):
        columns(arrays() | {name: array})


def test_twinstep_reads_the_converted_log(tmp_path: Path):
    np.savez(tmp_path / "chirp.npz", **arrays())
    out = tmp_path / "chirp"
    options = ["--out", str(out), "--base", "fixed", "--kp", "30", "--kd", "0.8"]
    assert main([str(tmp_path / "chirp.npz"), *options]) == 0
    assert json.loads((out / "meta.json").read_text())["rate_hz"] == 200
    described = subprocess.run([find_program(), "log", str(out)], capture_output=True, text=True, check=True)
    assert "200 rows" in described.stdout
    assert main([str(tmp_path / "chirp.npz"), *options]) == 1, "an existing folder is kept"
    assert main([str(tmp_path / "nothing.npz"), *options]) == 1
