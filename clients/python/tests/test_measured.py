"""Evaluation, identification and diagnosis from Python."""

import csv
import json
import math
from pathlib import Path

import pytest

import twinstep

KP, KD, RATE_HZ = 20.0, 0.5, 200
INERTIA, MASS, LENGTH = 0.02, 0.5, 0.2
VISCOUS = 0.4

ARM = f"""<robot name="arm"><link name="base"/>
<joint name="elbow" type="revolute"><parent link="base"/><child link="forearm"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="20" velocity="20"/></joint>
<link name="forearm"><inertial><origin xyz="0 0 -{LENGTH}"/><mass value="{MASS}"/>
<inertia ixx="{INERTIA}" iyy="{INERTIA}" izz="{INERTIA}" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> tuple[Path, Path]:
    """Return the file of an arm of one joint, and a log of one with viscous friction that the file lacks."""
    robot, log = tmp_path / "arm.toml", tmp_path / "log"
    (tmp_path / "arm.urdf").write_text(ARM)
    # The PD loop of the drive runs once a row.
    robot.write_text(f'robot = "arm.urdf"\n\n[control]\nactuator_hz = {RATE_HZ}\n')
    log.mkdir()
    meta = {
        "rate_hz": RATE_HZ,
        "joints": ["elbow"],
        "tau_sensor": "current",
        "segments": [{"name": "sines", "base": "fixed"}],
        "kp": KP,
        "kd": KD,
    }
    (log / "meta.json").write_text(json.dumps(meta))
    q = dq = torque = 0.0
    steps = 20
    dt = 1 / (RATE_HZ * steps)
    with open(log / "data.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", "segment", "q_cmd_elbow", "q_elbow", "dq_elbow", "tau_measured_elbow"])
        for row in range(20 * RATE_HZ):
            t = row / RATE_HZ
            wanted = 0.6 * math.sin(2 * math.pi * 0.4 * t) + 0.3 * math.sin(2 * math.pi * 1.7 * t)
            start = [f"{value:.9f}" for value in (t, 0, wanted, q, dq)]
            torque = KP * (wanted - q) - KD * dq
            mean = 0.0
            for _ in range(steps):
                gravity = MASS * 9.81 * LENGTH * math.sin(q)
                dq += dt * (torque - VISCOUS * dq - gravity) / (INERTIA + MASS * LENGTH**2)
                q += dt * dq
                mean += torque / steps
            rows.writerow([*start, f"{mean:.9f}"])
    return robot, log


def test_diagnosis_names_the_hidden_friction_with_its_size(arm: tuple[Path, Path], tmp_path: Path) -> None:
    robot, log = arm
    found = twinstep.diagnose(log, model=robot, out=tmp_path / "diagnosis")
    assert [cause.name for cause in found.causes] == ["viscous_friction"]
    estimate = next(iter(found.causes[0].parameters.values()))
    assert estimate.value == pytest.approx(VISCOUS, rel=0.15)
    assert found.baseline.q_rad is not None
    assert found.extended.q_rad is not None
    assert found.extended.q_rad < 0.3 * found.baseline.q_rad
    assert found.model.exists()
    assert "viscous_friction" in found._repr_html_()


def test_identification_returns_estimates_with_intervals(arm: tuple[Path, Path], tmp_path: Path) -> None:
    robot, log = arm
    out = tmp_path / "fitted.toml"
    found = twinstep.identify([log], model=robot, effects=["viscous_friction@all"], out=out, until_s=10.0)
    (effect,) = found.effects
    estimate = effect.parameters["coefficient_nms"]
    assert estimate.value == pytest.approx(VISCOUS, rel=0.1)
    assert isinstance(estimate.low, float)
    assert isinstance(estimate.high, float)
    assert estimate.low < VISCOUS < estimate.high
    before, after = (twinstep.evaluate(log, model=model, from_s=10.0) for model in (robot, out))
    assert before.q_rad is not None
    assert after.q_rad is not None
    assert after.q_rad < 0.3 * before.q_rad


def test_bad_input_has_the_message_of_the_program(tmp_path: Path) -> None:
    with pytest.raises(twinstep.InvalidOptionError, match="nothing_here"):
        twinstep.evaluate(tmp_path / "nothing_here")


def test_adaptation_has_what_was_predicted_and_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    predicted = {"mean": [0.2, 0.1], "reduction": 0.5, "interval": [0.4, 0.6], "falls": [2, 0], "errors": []}
    found = {
        "causes": ["payload@base"],
        "error": "velocity error",
        "unit": "m/s",
        "predicted": predicted,
        "found": None,
        "is_adapted": True,
    }
    program = tmp_path / "program"
    program.write_text(f"#!/bin/sh\ncat <<'END'\n{json.dumps(found)}\nEND\n")
    program.chmod(0o755)
    monkeypatch.setenv("TWINSTEP_SERVER", str(program))
    adapted = twinstep.adapt("walk.safetensors", "log", out=tmp_path / "adapted")
    assert adapted.predicted == twinstep.Comparison(0.2, 0.1, 0.5, (0.4, 0.6), (2, 0))
    assert adapted.found is None
    assert adapted.is_adapted
    assert adapted.policy == tmp_path / "adapted" / "policy.safetensors"


def test_policy_that_is_not_there_is_named_by_adapt(tmp_path: Path) -> None:
    with pytest.raises(twinstep.InvalidOptionError, match=r"nothing\.safetensors"):
        twinstep.adapt(tmp_path / "nothing.safetensors", "log", out=tmp_path / "adapted")
