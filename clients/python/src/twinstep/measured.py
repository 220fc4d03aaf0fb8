"""What measured logs say about a robot model and a policy: ``evaluate``, ``identify``, ``diagnose`` and ``adapt``.

Each runs the program ``twinstep`` in a process, as the command of the same name, and returns what it found. So a result
in Python is that of the command line, and a long search is ended by Ctrl-C or by the end of this process.
"""

import json
import math
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias, cast

from .errors import Error, InvalidOptionError
from .server import find_program

File: TypeAlias = str | PathLike[str]
Value: TypeAlias = float | tuple[float, ...]
"""Value of a parameter: a number, or a vector."""

_BAD_INPUT = 2
_SHUTDOWN_S = 2.0


class CommandError(Error):
    """The program could not finish; the message is that of the program."""


@dataclass(frozen=True)
class ModelErrors:
    """Root mean square errors of a model on a log. ``None`` for what was not measured."""

    torque_nm: float | None
    """Torque error at the torque sensor, on measured states [N·m]."""
    q_rad: float | None
    """Position error of the joints in closed loop [rad]."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of a parameter, with its 95 % interval."""

    value: Value
    low: Value | None
    high: Value | None


@dataclass(frozen=True)
class Effect:
    """An effect with its scope, such as ``coulomb_friction`` at ``calf``; ``twinstep effects`` explains each."""

    name: str
    scope: str
    parameters: Mapping[str, Estimate]

    def __str__(self) -> str:
        values = ", ".join(f"{name} = {_text(one)}" for name, one in self.parameters.items())
        return f"{self.name}@{self.scope}: {values}"


@dataclass(frozen=True)
class Identification:
    """Result of :func:`identify`."""

    effects: tuple[Effect, ...]
    """Effects of the model, with the estimates."""
    model: Path
    """Model file, for ``twinstep serve --model`` and ``twinstep.make(model=...)``."""


@dataclass(frozen=True)
class Diagnosis:
    """Result of :func:`diagnose`. Errors are on blocks of the log that no selection and no fit used."""

    causes: tuple[Effect, ...]
    """Effects that the model lacks, the most evident first."""
    baseline: ModelErrors
    """Errors of the given model."""
    extended: ModelErrors
    """Errors of the model with the causes."""
    unexplained: str
    """What the causes leave, as text."""
    folder: Path
    """Folder with report.html, findings.json and extended.toml."""
    findings: Mapping[str, Any]
    """All of findings.json."""

    @property
    def model(self) -> Path:
        """The corrected model."""
        return self.folder / "extended.toml"

    def _repr_html_(self) -> str:
        """Show the report in a notebook."""
        report = self.folder / "report.html"
        if not report.exists():
            return "<pre>" + "\n".join(map(str, self.causes)) + "</pre>"
        page = report.read_text(encoding="utf-8").replace("&", "&amp;").replace('"', "&quot;")
        return f'<iframe srcdoc="{page}" width="100%" height="700" style="border: 0"></iframe>'


@dataclass(frozen=True)
class Comparison:
    """Task errors of the same robots under the policy before and after."""

    before: float
    """Mean error before, in the unit of the :class:`Adaptation`."""
    after: float
    """Mean error after."""
    reduction: float
    """Share of the mean error that is gone."""
    interval: tuple[float, float]
    """Interval that holds 90 % of the reductions of single robots."""
    falls: tuple[int, int]
    """Number of robots that fell, before and after."""


@dataclass(frozen=True)
class Adaptation:
    """Result of :func:`adapt`."""

    causes: tuple[str, ...]
    """Causes of the difference between model and robot, with their scopes."""
    error: str
    """What the task error is."""
    unit: str
    """Its unit."""
    predicted: Comparison
    """Both policies on robots of the corrected model."""
    found: Comparison | None
    """Both policies on the robot at the endpoint."""
    is_adapted: bool
    """True if the fine-tuned policy is kept."""
    policy: Path
    """File of the policy that is kept."""


def evaluate(
    log: File, *, model: File | None = None, from_s: float | None = None, until_s: float | None = None
) -> ModelErrors:
    """Return the errors of a model on a log.

    Parameters
    ----------
    log
        A data file, or a folder that contains one.
    model
        Model file, robot file (URDF, MJCF), or the name of a robot of the program. Default: the ideal Go2.
    from_s, until_s
        First and last time of the rows that are compared [s]. Default: all rows.

    Raises
    ------
    InvalidOptionError
        The log or the model cannot be used; the message says why.

    Examples
    --------
    >>> twinstep.evaluate("data/go2_air_chirp").q_rad  # doctest: +SKIP
    0.0359
    """
    rows = _rows(from_s, until_s)
    found = json.loads(_run(["evaluate", fspath(log), "--json", *rows, *_option("--model", model)]))
    return _errors(found)


def identify(
    logs: File | Sequence[File],
    *,
    out: File,
    effects: Sequence[str] | None = None,
    model: File | None = None,
    from_s: float | None = None,
    until_s: float | None = None,
) -> Identification:
    """Estimate parameters of effects from logs of one robot, and write the model file ``out``.

    Parameters
    ----------
    logs
        One log or several.
    out
        Model file to write (TOML).
    effects
        Effects with scopes, as in ``["coulomb_friction@calf", "payload@base"]``. Default: those of the command.
    model, from_s, until_s
        As of :func:`evaluate`.

    Raises
    ------
    InvalidOptionError
        A log, an effect or the model cannot be used; the message says why.
    """
    listed = ["--effects", ",".join(effects)] if effects else []
    rows = _rows(from_s, until_s)
    _run(["identify", *_paths(logs), "--out", fspath(out), *listed, *rows, *_option("--model", model)])
    with open(out, "rb") as file:
        entries = tomllib.load(file).get("effect", [])
    return Identification(effects=tuple(_entry(entry) for entry in entries), model=Path(out))


def diagnose(logs: File | Sequence[File], *, out: File | None = None, model: File | None = None) -> Diagnosis:
    """Find the effects that a model lacks, from logs of one robot.

    In a notebook the result shows the report.

    Parameters
    ----------
    logs
        One log or several.
    out
        Folder to write. Default: a new folder for temporary files, which is kept.
    model
        As of :func:`evaluate`.

    Raises
    ------
    InvalidOptionError
        A log or the model cannot be used; the message says why.
    """
    folder = Path(tempfile.mkdtemp(prefix="twinstep-diagnosis-")) if out is None else Path(out)
    arguments = ["diagnose", *_paths(logs), "--out", fspath(folder), "--json", *_option("--model", model)]
    findings = cast("dict[str, Any]", json.loads(_run(arguments)))
    return Diagnosis(
        causes=tuple(_cause(cause) for cause in findings["findings"]),
        baseline=_errors(findings["baseline"]),
        extended=_errors(findings["extended"]),
        unexplained=findings["unexplained"]["text"],
        folder=folder,
        findings=findings,
    )


def adapt(
    policy: File,
    logs: File | Sequence[File],
    *,
    out: File,
    endpoint: str | None = None,
    model: File | None = None,
    steps: int | None = None,
) -> Adaptation:
    """Fine-tune a policy for the robot of the logs, and predict or measure the gain in its task.

    A repeated call continues an interrupted one.

    Parameters
    ----------
    policy
        Policy file (safetensors).
    logs
        One log or several.
    out
        Folder to write.
    endpoint
        Zenoh endpoint of the robot. Default: the gain is predicted only.
    model
        Model on which the policy was trained, as of :func:`evaluate`.
    steps
        Environment steps of the fine-tuning. Default: that of the command.

    Raises
    ------
    InvalidOptionError
        The policy, a log or the model cannot be used; the message says why.
    """
    options = [*_option("--endpoint", endpoint), *_option("--model", model)]
    options += _option("--steps", None if steps is None else str(steps))
    arguments = ["adapt", fspath(policy), *_paths(logs), "--out", fspath(out), "--json", *options]
    found = cast("dict[str, Any]", json.loads(_run(arguments)))
    return Adaptation(
        causes=tuple(found["causes"]),
        error=found["error"],
        unit=found["unit"],
        predicted=_comparison(found["predicted"]),
        found=None if found["found"] is None else _comparison(found["found"]),
        is_adapted=found["is_adapted"],
        policy=Path(out) / "policy.safetensors",
    )


def _comparison(found: Mapping[str, Any]) -> Comparison:
    before, after = found["mean"]
    low, high = found["interval"]
    fell_before, fell_after = found["falls"]
    return Comparison(before, after, found["reduction"], (low, high), (fell_before, fell_after))


def _run(arguments: list[str]) -> str:
    """Run the program, with its progress on stderr, and return its stdout."""
    command = [find_program(), *arguments]
    said: list[str] = []
    # A file, because a full pipe would stop the program.
    with tempfile.TemporaryFile("w+") as printed:
        process = subprocess.Popen(command, stdout=printed, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        try:
            for line in process.stderr:
                said.append(line)
                print(line, end="", file=sys.stderr)
            code = process.wait()
        except BaseException:
            process.terminate()
            try:
                process.wait(_SHUTDOWN_S)
            except subprocess.TimeoutExpired:
                process.kill()
            raise
        finally:
            process.stderr.close()
        if code == 0:
            printed.seek(0)
            return printed.read()
    message = "".join(said[-20:]).strip().rpartition("error: ")[2]
    raise (InvalidOptionError if code == _BAD_INPUT else CommandError)(message)


def _paths(logs: File | Sequence[File]) -> list[str]:
    return [fspath(logs)] if isinstance(logs, str | PathLike) else [fspath(log) for log in logs]


def _option(flag: str, value: File | None) -> list[str]:
    return [] if value is None else [flag, fspath(value)]


def _rows(from_s: float | None, until_s: float | None) -> list[str]:
    limits = {"--from": from_s, "--until": until_s}
    return [word for flag, time in limits.items() if time is not None for word in (flag, str(time))]


def _errors(found: Mapping[str, Any]) -> ModelErrors:
    return ModelErrors(torque_nm=found["torque_rmse_nm"], q_rad=found["q_rmse_rad"])


def _value(value: Any) -> Value:
    """Return a value of JSON, in which what is not finite is null."""
    if isinstance(value, list):
        return tuple(math.nan if part is None else float(part) for part in cast("list[float | None]", value))
    return math.nan if value is None else float(value)


def _cause(cause: Mapping[str, Any]) -> Effect:
    def parameter(found: Mapping[str, Any]) -> Estimate:
        return Estimate(*(_value(found[key]) for key in ("value", "low", "high")))

    parameters = {name: parameter(found) for name, found in cause["parameters"].items()}
    return Effect(name=cause["effect"], scope=cause["scope"], parameters=parameters)


def _entry(entry: Mapping[str, Any]) -> Effect:
    intervals = entry.get("interval", {})

    def parameter(name: str) -> Estimate:
        low, high = intervals.get(name, (None, None))
        return Estimate(_value(entry[name]), low, high)

    names = [name for name in entry if name not in ("name", "scope", "interval")]
    scope = entry["scope"]
    return Effect(name=entry["name"], scope=str(scope), parameters={name: parameter(name) for name in names})


def _text(parameter: Estimate) -> str:
    if isinstance(parameter.value, tuple):
        return "(" + ", ".join(f"{part:.4g}" for part in parameter.value) + ")"
    interval = f" ({parameter.low:.4g} to {parameter.high:.4g})" if isinstance(parameter.low, float) else ""
    return f"{parameter.value:.4g}{interval}"
