import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from twinstep.convert_npz import JOINTS, ConversionError, columns, convert, main
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
        ("note", np.full(ROWS, 1j), "not numbers"),
        ("kp", np.ones(7), "one number, 12, or one per row"),
        ("t", np.float32(1.7e9) + np.arange(ROWS, dtype=np.float32) / 200, "float32 with values near 1700000000"),
        ("t", np.arange(ROWS)[::-1] / 200, "does not advance in row 1"),
        ("t", np.zeros(1), "1 rows"),
    ],
)
def test_wrong_arrays_are_named(name: str, array: np.ndarray, expected: str):
    with pytest.raises(ConversionError, match=expected):
        columns(arrays() | {name: array})


def test_constants_and_names_beside_the_samples_are_used(tmp_path: Path):
    order = [*JOINTS[3:], *JOINTS[:3]]
    stiff = np.array([40.0 if name.endswith("calf") else 20.0 for name in order])
    beside = {
        "kp": stiff,
        "kd": np.float64(0.5),
        "joint_names": np.array([f"{name}_joint" for name in order]),
        "mass": 15.0,
    }
    found = convert(arrays() | {name: np.asarray(value) for name, value in beside.items()})
    assert found.joints == order
    assert found.gains == {"kp": stiff.tolist(), "kd": 0.5}
    np.testing.assert_array_equal(found.columns["q_FR_hip"], arrays()["q"][:, 0])
    assert any("mass" in note for note in found.notes)
    np.savez(tmp_path / "walk.npz", **arrays(), **beside)
    assert main([str(tmp_path / "walk.npz"), "--out", str(tmp_path / "walk"), "--base", "fixed"]) == 0
    described = subprocess.run(
        [find_program(), "log", str(tmp_path / "walk")], capture_output=True, text=True, check=False
    )
    assert described.returncode == 0, described.stderr
    without_time = {name: array for name, array in arrays().items() if name != "t"}
    np.testing.assert_allclose(convert(without_time, rate=200.0).columns["t"], arrays()["t"])


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
