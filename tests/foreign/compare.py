"""Comparison of the findings of one log with its ground truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from drive import JOINTS, TORQUE_LIMIT, Array

# Value without effect of the parameters that state a size. If it is infinite, sizes are relative to the truth.
SIZE_ORIGIN: dict[str, dict[str, float]] = {
    "pd_gain": {"kp_scale": 1.0, "kd_scale": 1.0},
    "torque_gain": {"gain": 1.0},
    "thermal_derating": {"per_kelvin": 0.0},
    "torque_ripple": {"amplitude_nm": 0.0},
    "stribeck_friction": {"breakaway_nm": 0.0},
    "joint_spring": {"stiffness_nm_rad": 0.0},
    "payload": {"mass_kg": 0.0},
    "ground_friction": {"coefficient": 0.8},
    "ground_stiffness": {"time_constant_s": 0.002},
    "inertia": {},
}
# Root mean square differences [rad, N·m, m, rad/s] below which a channel hardly shows a hidden effect.
VISIBLE = {"q": 0.0005, "tau": 0.02, "pos": 0.001, "gyro": 0.002}
Finding = dict[str, Any]


def scope_joints(scope: str) -> frozenset[str]:
    """Return the joints of a scope; `base`, `ground` and unknown scopes are returned as themselves."""
    sides = {"left": ("FL", "RL"), "right": ("FR", "RR")}
    joints: set[str] = set()
    for part in scope.split("+"):
        names = sides.get(part, (part,))
        joints |= {j for j in JOINTS if part == "all" or any(n in (j, *j.split("_")) for n in names)}
    return frozenset(joints) or frozenset([scope])


def is_visible(truth: dict[str, Any]) -> bool:
    """Return whether a hidden effect changes any channel by more than a small multiple of its noise."""
    shown = truth["information"]
    return shown is None or any(value > VISIBLE[name.split("_")[0]] for name, value in shown.items())


def read_findings(folder: Path) -> list[Finding] | None:
    """Return the causes in order of evidence, or `None` if the program failed."""
    file = folder / "findings.json"
    if not file.exists():
        return None
    found = json.loads(file.read_text())["findings"]
    return sorted(found, key=lambda entry: -entry["score_nats"])


def _names(finding: Finding, effect: dict[str, Any]) -> bool:
    """Return whether a cause has the name of a hidden effect and shares a joint or body with it."""
    shared = scope_joints(finding["scope"]) & scope_joints(effect["scope"])
    return finding["effect"] == effect["effect"] and bool(shared)


def _size(effect: dict[str, Any], finding: Finding) -> tuple[float | None, bool | None]:
    """Return the relative error of the size, and whether its intervals contain the truth."""
    truth = effect["parameters"]
    origins = SIZE_ORIGIN.get(effect["effect"], dict.fromkeys(truth, 0.0))
    names = [name for name in origins if name in finding["parameters"]]
    if not names:
        return None, None

    def stack(key: str) -> Array:
        return np.concatenate([np.atleast_1d(finding["parameters"][n][key]).astype(float) for n in names])

    true = np.concatenate([np.atleast_1d(truth[n]).astype(float) for n in names])
    origin = np.concatenate([np.full(np.size(truth[n]), origins[n]) for n in names])
    error = float(np.linalg.norm(stack("value") - true) / np.linalg.norm(true - origin))
    return error, bool(np.all((stack("low") <= true) & (true <= stack("high"))))


def compare(truth: dict[str, Any], findings: list[Finding]) -> dict[str, Any]:
    """Return the score of one case: names, scopes, size and wrong names."""
    hidden = truth["effects"] if truth["suite"] != "outside" else []
    right = [next((e for e in hidden if _names(f, e)), None) for f in findings]
    among = [any(_names(f, e) for f in findings) for e in hidden]
    score: dict[str, Any] = {"found": [f"{f['effect']}@{f['scope']} {f['score_nats']:.0f}" for f in findings]}
    score["wrong_names"] = sum(e is None for e in right)
    if not hidden:
        return score
    score["first_right"] = bool(right) and right[0] is not None
    score["among"] = all(among)
    score["any_among"] = any(among)
    scopes, errors, covers = [], [], []
    for effect in hidden:
        of_name = [f for f in findings if _names(f, effect)]
        joints = frozenset().union(*(scope_joints(f["scope"]) for f in of_name))
        scopes.append(joints == scope_joints(effect["scope"]))
        if of_name:
            error, covered = _size(effect, of_name[0])
            errors += [] if error is None else [error]
            covers += [] if covered is None else [covered]
    score["scope_right"] = all(scopes)
    score |= {"size_error": max(errors) if errors else None, "covers": all(covers) if covers else None}
    score["all_right"] = score["among"] and score["scope_right"] and score["wrong_names"] == 0
    return score


def trivial_baseline(log: Path, cache: Path) -> dict[str, Any]:
    """Return the joint whose measured torque differs most from the ideal PD law (root mean square [N·m])."""
    if cache.exists():
        return json.loads(cache.read_text())
    table = np.genfromtxt(log / "data.csv.gz", delimiter=",", names=True)
    residual = []
    for joint, limit in zip(JOINTS, TORQUE_LIMIT, strict=True):
        ideal = table["kp"] * (table[f"q_cmd_{joint}"] - table[f"q_{joint}"]) - table["kd"] * table[f"dq_{joint}"]
        residual.append(float(np.std(table[f"tau_measured_{joint}"] - np.clip(ideal, -limit, limit))))
    result = {"joint": JOINTS[int(np.argmax(residual))], "rms_nm": max(residual)}
    cache.write_text(json.dumps(result))
    return result
