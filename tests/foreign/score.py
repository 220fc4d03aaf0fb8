"""Command line: run `diagnose` on every case of a folder and compare its findings with the ground truths."""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from compare import compare, is_visible, read_findings, scope_joints, trivial_baseline

TIMEOUT = 900.0  # [s] per log
Case = dict[str, Any]
RATES: dict[str, Callable[[Case], bool | None]] = {
    "first name right": lambda c: c.get("first_right"),
    "true name among the causes": lambda c: c.get("among"),
    "one of the true names among the causes": lambda c: c.get("any_among") if c["suite"] == "pairs" else None,
    "scope right": lambda c: c.get("scope_right"),
    "name and scope right, nothing else reported": lambda c: c.get("all_right"),
    "size within 20 %, of named effects": lambda c: None if c.get("size_error") is None else c["size_error"] <= 0.2,
    "95 % intervals contain the truth, of named effects": lambda c: c.get("covers"),
    "90 % interval of the predicted gain contains the found one": lambda c: c.get("promise_kept"),
    "at least one wrong name": lambda c: None if "wrong_names" not in c else c["wrong_names"] > 0,
    "program failed or timed out": lambda c: c["failed"],
    "trivial: joint of largest torque residual is in the scope": lambda c: c.get("trivial_right"),
}


def wilson(right: int, count: int) -> tuple[float, float]:
    """Return the Wilson 95 % interval of a proportion."""
    z = 1.96
    share = right / count
    centre = (share + z * z / (2.0 * count)) / (1.0 + z * z / count)
    half = z * math.sqrt(share * (1.0 - share) / count + z * z / (4.0 * count * count)) / (1.0 + z * z / count)
    return max(centre - half, 0.0), min(centre + half, 1.0)


def run_program(program: Path, case: Path, label: str) -> dict[str, Any]:
    """Run `diagnose` once, unless it has run under this label; return its wall time [s] and exit status."""
    out = case / f"diagnosis_{label}"
    record = out / "run.json"
    if record.exists():
        return json.loads(record.read_text())
    out.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    command = [program, "diagnose", case / "log", "--out", out]
    with (out / "stdout.txt").open("w") as stdout, (out / "stderr.txt").open("w") as stderr:
        try:
            status = subprocess.run(command, stdout=stdout, stderr=stderr, timeout=TIMEOUT, check=False).returncode
        except subprocess.TimeoutExpired:
            status = -1
    result = {"seconds": round(time.monotonic() - start, 1), "status": status}
    record.write_text(json.dumps(result))
    return result


def promise_kept(findings: Path) -> bool | None:
    """Return whether the found reduction of the joint error is in the predicted interval; None without a prediction."""
    promise = json.loads(findings.read_text()).get("promise")
    if promise is None:
        return None
    low, high = promise["all"]["interval"]
    return bool(low <= promise["all"]["found"] <= high)


def score_case(case: Path, label: str, run: dict[str, Any]) -> Case:
    """Return the score of one case whose program has run."""
    truth = json.loads((case / "truth.json").read_text())
    hidden = truth["effects"]
    result: Case = {"case": case.name, "suite": truth["suite"], "family": truth["family"], **run}
    result["truth"] = [f"{e['effect']}@{e['scope']}" for e in hidden]
    result["severity"] = [round(e["severity"], 2) for e in hidden]
    result["visible"] = is_visible(truth)
    findings = read_findings(case / f"diagnosis_{label}") if run["status"] == 0 else None
    result["failed"] = findings is None
    result |= compare(truth, findings or [])
    if run["status"] == 0:
        result["promise_kept"] = promise_kept(case / f"diagnosis_{label}" / "findings.json")
    scopes = [scope_joints(e["scope"]) for e in hidden]
    if len(scopes) == 1 and scopes[0] <= scope_joints("all") and len(scopes[0]) < 12:
        joint = trivial_baseline(case / "log", case / "trivial.json")["joint"]
        result["trivial_right"] = joint in scopes[0]
    return result


def _mark(value: bool | float | None) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{100.0 * value:.0f} %"


def case_table(cases: list[Case]) -> list[str]:
    """Return the lines of the table with one row per case."""
    columns = "case | hidden | severity | visible | causes by evidence [nat] | first | among | scope"
    lines = [f"| {columns} | size error | covered | s |", "|" + "---|" * 11]
    for c in cases:
        found = "failed" if c["failed"] else ", ".join(c["found"]) or "none"
        marks = [_mark(c.get(k)) for k in ("first_right", "among", "scope_right", "size_error", "covers")]
        severity = ", ".join(map(str, c["severity"]))
        cells = [
            c["case"],
            ", ".join(c["truth"]) or "nothing",
            severity,
            _mark(c["visible"]),
            found,
            *marks,
            c["seconds"],
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return lines


def rate_rows(cases: list[Case], title: str) -> list[str]:
    """Return the lines of a table of rates with Wilson 95 % intervals."""
    lines = ["", f"## {title}", "", "| criterion | cases | rate | 95 % interval |", "|---|---|---|---|"]
    for name, rate in RATES.items():
        values = [value for value in map(rate, cases) if value is not None]
        if values:
            low, high = wilson(sum(values), len(values))
            share = sum(values) / len(values)
            ends = f"{100 * low:.0f} to {100 * high:.0f} %"
            lines.append(f"| {name} | {sum(values)} of {len(values)} | {100 * share:.0f} % | {ends} |")
    return lines


def family_rows(cases: list[Case]) -> list[str]:
    """Return the lines of a table with one row per family."""
    lines = [
        "",
        "### By effect",
        "",
        "| family | cases | first | among | scope | wrong name |",
        "|---|---|---|---|---|---|",
    ]
    for family in sorted({c["family"] for c in cases}):
        own = [c for c in cases if c["family"] == family]
        counts = [str(sum(bool(c.get(k)) for c in own)) for k in ("first_right", "among", "scope_right", "wrong_names")]
        lines.append(f"| {family} | {len(own)} | " + " | ".join(counts) + " |")
    return lines


def report(cases: list[Case], label: str) -> str:
    """Return all tables as Markdown."""
    seconds = sorted(c["seconds"] for c in cases)
    middle = f"Wall time per log [s]: median {seconds[len(seconds) // 2]}, longest {seconds[-1]}."
    lines = [f"# Foreign logs, program `{label}`, {len(cases)} cases", "", middle, "", *case_table(cases)]
    lines += rate_rows(cases, "All cases")
    seen = [c for c in cases if c["visible"]]
    if len(seen) < len(cases):
        lines += rate_rows(seen, "Cases whose effect is visible in a channel")
    strong = [c for c in cases if c["severity"] and min(c["severity"]) >= 0.5]
    if strong:
        lines += rate_rows(strong, "Severities of at least 0.5")
    return "\n".join([*lines, *family_rows(cases), ""])


def main() -> None:
    """Run and score all cases of a folder; finished runs are not repeated."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--program", type=Path, required=True)
    parser.add_argument("--label", default="now")
    parser.add_argument("--only-finished", action="store_true", help="score finished runs and start none")
    args = parser.parse_args()
    cases: list[Case] = []
    for case in sorted(p.parent for p in args.folder.glob("case_*/truth.json")):
        if args.only_finished and not (case / f"diagnosis_{args.label}" / "run.json").exists():
            continue
        run = run_program(args.program.resolve(), case, args.label)
        cases.append(score_case(case, args.label, run))
        (args.folder / f"score_{args.label}.json").write_text(json.dumps(cases, indent=1))
        (args.folder / f"score_{args.label}.md").write_text(report(cases, args.label))
        print(case_table(cases[-1:])[-1], flush=True)
    print(report(cases, args.label) if cases else f"no case in {args.folder}")


if __name__ == "__main__":
    main()
