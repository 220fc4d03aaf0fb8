"""The exported step of the golden ensemble in onnxruntime, compared with the kernel in Rust."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from twinstep.onnx import EnsembleFile, EnsembleFileError

GOLDEN = Path(__file__).parents[3] / "ensemble" / "golden"
ENSEMBLE = GOLDEN / "actuators.safetensors"


def export(ensemble: Path, out: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "twinstep.onnx", str(ensemble), str(out)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> onnxruntime.InferenceSession:
    out = tmp_path_factory.mktemp("onnx") / "step.onnx"
    done = export(ENSEMBLE, out)
    assert done.returncode == 0, done.stderr
    return onnxruntime.InferenceSession(out, providers=["CPUExecutionProvider"])


def test_step_agrees_with_the_kernel(session: onnxruntime.InferenceSession) -> None:
    expected = json.loads((GOLDEN / "expected.json").read_text())
    columns = json.loads(session.get_modelmeta().custom_metadata_map["inputs"])
    assert columns[:2] == ["position_error", "velocity_error"]
    one_hot = np.array([[float(joint.endswith(f"_{kind}")) for kind in columns[2:]] for joint in expected["joints"]])
    assert one_hot.sum() == 12
    members, _, hidden = session.get_inputs()[1].shape
    h = c = np.zeros((members, 12, hidden), np.float32)
    for row, errors in enumerate(expected["errors"]):
        xi = np.concatenate([np.array(errors), one_hot], axis=1).astype(np.float32)
        mean, variance, h, c = session.run(["mean", "variance", "next_h", "next_c"], {"xi": xi, "h": h, "c": c})
        assert np.abs(mean - expected["mean"][row]).max() < 1e-4, row
        assert np.abs(variance - expected["variance"][row]).max() < 1e-4, row
    assert row == 59


def test_a_row_of_a_batch_equals_the_single_row(session: onnxruntime.InferenceSession) -> None:
    random = np.random.default_rng(1)
    (_, columns), (members, _, hidden) = session.get_inputs()[0].shape, session.get_inputs()[1].shape
    xi = random.normal(size=(5, columns)).astype(np.float32)
    h, c = random.normal(size=(2, members, 5, hidden)).astype(np.float32)
    many = session.run(None, {"xi": xi, "h": h, "c": c})
    single = session.run(None, {"xi": xi[3:4], "h": h[:, 3:4], "c": c[:, 3:4]})
    for one, all_ in zip(single, many, strict=True):
        np.testing.assert_allclose(one[:, 0], all_[:, 3], atol=1e-5)


def test_metadata_is_that_of_the_ensemble(session: onnxruntime.InferenceSession) -> None:
    metadata = session.get_modelmeta().custom_metadata_map
    description = EnsembleFile.read(ENSEMBLE).description
    for name in ("dt", "joints", "joint_input", "gains"):
        assert json.loads(metadata[name]) == description[name]
    assert metadata["tau_sensor"] == description["tau_sensor"]
    assert json.loads(metadata["dt"]) == 0.005


def test_other_files_are_rejected_with_their_path(tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    for content in (b"", b"not at all", (2).to_bytes(8, "little") + b"{}"):
        other.write_bytes(content)
        with pytest.raises(EnsembleFileError, match=r"other\.safetensors is not an ensemble of `twinstep fit`"):
            EnsembleFile.read(other)
    done = export(other, tmp_path / "out.onnx")
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {other} is not an ensemble")
    assert export(tmp_path / "absent", tmp_path / "out.onnx").stderr.startswith("error: [Errno 2]")
    incomplete = EnsembleFile.read(ENSEMBLE)
    del incomplete.arrays["1.lstm.bias"]
    with pytest.raises(EnsembleFileError, match=r"the ensemble has no array '1\.lstm\.bias'"):
        incomplete.stacked("lstm.bias")
