"""Command line: write results/diagnosis.md from the scores of the suites in a folder."""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path

from score import RATES, Case, case_table, family_rows, wilson

SUITES = {
    "single": ("One effect of the catalogue", "Each of the 27 effects equally often, at 20 to 100 % of its range."),
    "healthy": ("Nothing hidden", "Robots with the errors that every robot of the generator has."),
    "pairs": (
        "Two effects of the catalogue",
        "Half of them are hard to tell apart, the other half any two.",
    ),
    "outside": ("An effect outside the catalogue", "A wrong name is any name."),
}


def rates(cases: list[Case]) -> list[str]:
    """Return the lines of the table of rates."""
    lines = ["| criterion | cases | rate | 95 % interval |", "|---|---|---|---|"]
    for name, rate in RATES.items():
        values = [value for value in map(rate, cases) if value is not None]
        if values:
            low, high = wilson(sum(values), len(values))
            ends = f"{100 * low:.0f} to {100 * high:.0f} %"
            share = f"{100 * sum(values) / len(values):.0f} %"
            lines.append(f"| {name} | {sum(values)} of {len(values)} | {share} | {ends} |")
    return lines


def widths(folder: Path, cases: list[Case]) -> list[float]:
    """Return the widths of the 90 % intervals of the predicted gains, as shares of the error."""
    found: list[float] = []
    for case in cases:
        findings = folder / case["case"] / "diagnosis_now" / "findings.json"
        promise = json.loads(findings.read_text()).get("promise") if findings.exists() else None
        if promise:
            low, high = promise["all"]["interval"]
            found.append(high - low)
    return found


def section(folder: Path, suite: str) -> list[str]:
    """Return the lines of a suite."""
    cases: list[Case] = json.loads((folder / suite / "score_now.json").read_text())
    title, text = SUITES[suite]
    drawn = len(list((folder / suite).glob("case_*/truth.json")))
    seconds = [case["seconds"] for case in cases]
    some = "" if drawn == len(cases) else f" The time allowed for the first {len(cases)} of the {drawn} cases."
    width = widths(folder / suite, cases)
    share = f"{100 * statistics.median(width):.0f} % of the error" if width else "–"
    return [
        "",
        f"## {title}",
        text + some,
        "",
        f"Seconds per log: median {statistics.median(seconds):.1f}, longest {max(seconds):.1f}.",
        f"Predicted gain, 90 % interval: median width {share}.",
        "",
        *rates(cases),
        *(family_rows(cases) if suite == "single" else []),
        "",
        *case_table(cases),
    ]


def main() -> None:
    """Print the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="with a folder for each suite, as score.py leaves it")
    parser.add_argument("--seed", type=int, required=True, help="of the first suite; the next ones have the next seeds")
    parser.add_argument("--commit", required=True, help="of the program")
    parser.add_argument("--note", default="", help="paragraph before the tables")
    args = parser.parse_args()
    suites = [suite for suite in SUITES if (args.folder / suite / "score_now.json").exists()]
    drawn = {suite: len(list((args.folder / suite).glob("case_*/truth.json"))) for suite in suites}
    order = ["single", "healthy", "outside", "pairs"]
    draw = "python tests/foreign/draw.py --seed {} --cases {} --suite {} --out DIR/{} --program target/release/twinstep"
    commands = [draw.format(args.seed + order.index(suite), drawn[suite], suite, suite) for suite in suites]
    lines = [
        "# Diagnosis on robots of an independent generator",
        "",
        "Robots in MuJoCo with laws, errors, motions and noise of their own (`tests/foreign`). All logs have motor",
        f"currents. The program (commit {args.commit}) was frozen before the seed was drawn. Every case is listed. Two",
        "cores with no other work.",
        "",
        "```sh",
        *commands,
        f"for suite in {' '.join(suites)}; do",
        "    python tests/foreign/score.py DIR/$suite --program target/release/twinstep",
        "done",
        f"python tests/foreign/page.py DIR --seed {args.seed} --commit {args.commit}",
        "```",
        "",
        "The number after a cause is its evidence [nat]. The predicted gain is the reduction of the joint error on the",
        "held-out blocks (`promise` in `findings.json`). Not measured: logs without motor currents.",
        *(["", args.note] if args.note else []),
        *(line for suite in suites for line in section(args.folder, suite)),
    ]
    print("\n".join(lines))


if __name__ == "__main__":
    main()
