"""Converts arrays of NumPy (`.npz`) to a log that `twinstep diagnose` reads.

``python -m twinstep.convert_npz walk.npz --out walk`` writes ``walk/data.csv`` and ``walk/meta.json``.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "calf"))
#: Names of the columns of a two-dimensional array; per joint for all other quantities.
AXES: Mapping[str, tuple[str, ...]] = {
    "gyro": ("x", "y", "z"),
    "acc": ("x", "y", "z"),
    "quat": ("w", "x", "y", "z"),
    "pos": ("x", "y", "z"),
    "vel": ("x", "y", "z"),
    "contact": LEGS,
    "foot_force": LEGS,
}
JOINT_QUANTITIES = ("q", "dq", "q_cmd", "dq_cmd", "tau_ff", "tau_measured", "temp", "kp", "kd")
ORDER = """\
Each array has one row per sample. A one-dimensional array is a column, with its name: `t`, `q_FL_hip`, `battery_V`. A
two-dimensional array has the name of a quantity: `q`, `dq`, `q_cmd`, `dq_cmd`, `tau_ff`, `tau_measured`, `temp`, `kp`
and `kd` with one column per joint, `gyro`, `acc`, `pos` and `vel` with x, y, z, `quat` with w, x, y, z, and `contact`
and `foot_force` with one column per leg FL, FR, RL, RR. Units are SI. `t`, `q` and `q_cmd` are required; `kp` and `kd`
may be numbers (--kp, --kd), in the file too: one, or one per joint. An array of text with twelve names, such as
`joint_names`, is the order of the joints. `t` may be replaced by a rate (--rate). Other scalars and texts are left
out, with a note.
"""


class ConversionError(ValueError):
    """An array is not a quantity of a log."""


class Converted(NamedTuple):
    """A log: columns with a cell per row, and what holds for all rows."""

    columns: dict[str, npt.NDArray[Any]]
    #: ``kp`` and ``kd``, if they are constant: one number, or one for each joint in `joints`.
    gains: dict[str, float | list[float]]
    joints: list[str]
    notes: list[str]


def columns(arrays: Mapping[str, npt.NDArray[Any]], joints: Sequence[str] = JOINTS) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of a log, by name: those of :func:`convert`."""
    return convert(arrays, joints).columns


def convert(
    arrays: Mapping[str, npt.NDArray[Any]], joints: Sequence[str] | None = None, rate: float | None = None
) -> Converted:
    """Return the columns of a log, by name, and its constants.

    Parameters
    ----------
    arrays
        Arrays of shape (rows,) or (rows, columns), scalars, gains per joint and names, see the module's ``--help``.
    joints
        Order of the joints in two-dimensional arrays. Default: that of an array of names, or that of the Go2.
    rate
        Rate of the rows [Hz]; then ``t`` is not needed.

    Raises
    ------
    ConversionError
        If an array has another shape than its quantity, or the time does not advance.
    """
    labels = {name: array for name, array in arrays.items() if array.dtype.kind in "US"}
    numbers = {name: array for name, array in arrays.items() if name not in labels}
    notes: list[str] = []
    order = [_joint(name) for name in joints] if joints is not None else _labelled_order(labels, notes)
    for name, array in numbers.items():
        if array.dtype.kind not in "fiub":
            raise ConversionError(f"array `{name}` has type {array.dtype}, not numbers")
    time = _time(numbers, rate)
    rows = len(time)
    result: dict[str, npt.NDArray[Any]] = {"t": time}
    gains: dict[str, float | list[float]] = {}
    for name, array in numbers.items():
        if name == "t":
            continue
        if name in ("kp", "kd") and array.ndim <= 1 and array.shape != (rows,):
            gains[name] = _constant_gains(name, array, order)
        elif array.ndim == 0:
            notes.append(f"scalar `{name}` is left out")
        elif array.ndim > 2 or len(array) != rows:
            raise ConversionError(f"array `{name}` has shape {array.shape}, but `t` has {rows} rows")
        elif array.ndim == 1:
            result[name] = array
        else:
            result |= _split(name, array, order)
    return Converted(result, gains, order, notes)


def _joint(name: str) -> str:
    """Return the name of a joint as in a log, without the ending that robot files add."""
    return name.removesuffix("_joint")


def _labelled_order(labels: Mapping[str, npt.NDArray[Any]], notes: list[str]) -> list[str]:
    """Return the joints that an array of names lists, or those of the Go2."""
    order = list(JOINTS)
    for name, array in labels.items():
        names = [_joint(str(one)) for one in np.atleast_1d(array).ravel()]
        if len(names) == len(JOINTS) and sorted(names) == sorted(JOINTS):
            order = names
            notes.append(f"the order of the joints is that of `{name}`")
        else:
            notes.append(f"text `{name}` is left out")
    return order


def _time(arrays: Mapping[str, npt.NDArray[Any]], rate: float | None) -> npt.NDArray[np.float64]:
    if rate is not None:
        rows = next((len(array) for name, array in arrays.items() if name in ("q", "q_cmd") and array.ndim == 2), None)
        if rows is None:
            raise ConversionError("with --rate the arrays `q` or `q_cmd` must have a row per sample")
        return np.arange(rows) / rate
    if "t" not in arrays or arrays["t"].ndim != 1:
        raise ConversionError(
            "array `t` is missing or not one-dimensional: it is the time of each row [s]; or state --rate"
        )
    time = arrays["t"].astype(np.float64)
    if len(time) < 2:
        raise ConversionError(f"array `t` has {len(time)} rows; a log needs two or more")
    steps = np.diff(time)
    if not np.isfinite(steps).all():
        raise ConversionError("array `t` has NaN or infinite times")
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        step = float(np.spacing(np.float32(time[row]))) if arrays["t"].dtype == np.float32 else 0.0
        if step > 1e-4:
            raise ConversionError(
                f"array `t` is float32 with values near {time[row]:.0f}: its times are {step:g} s apart at best, and "
                f"do not advance in row {row}; save it as float64, subtract its start before saving, or use --rate HZ"
            )
        raise ConversionError(f"array `t` does not advance in row {row}: {time[row - 1]} s, then {time[row]} s")
    return time


def _constant_gains(name: str, array: npt.NDArray[Any], joints: Sequence[str]) -> float | list[float]:
    if array.size == 1:
        return float(array.ravel()[0])
    if array.shape == (len(joints),):
        return [float(gain) for gain in array]
    raise ConversionError(
        f"array `{name}` has shape {array.shape}; one number, {len(joints)}, or one per row are expected"
    )


def _split(name: str, array: npt.NDArray[Any], joints: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    parts = joints if name in JOINT_QUANTITIES else AXES.get(name)
    if parts is None:
        known = ", ".join((*JOINT_QUANTITIES, *AXES))
        raise ConversionError(f"array `{name}` has two dimensions; quantities with several columns are {known}")
    if array.shape[1] != len(parts):
        raise ConversionError(f"array `{name}` has {array.shape[1]} columns; it needs {len(parts)}: {', '.join(parts)}")
    return {f"{name}_{part}": array[:, index] for index, part in enumerate(parts)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m twinstep.convert_npz",
        description="Convert a NumPy file to a log that `twinstep diagnose` reads.",
        epilog=ORDER,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, help="the .npz file")
    parser.add_argument("--out", type=Path, required=True, help="folder to create, with data.csv and meta.json")
    parser.add_argument(
        "--joints", nargs="+", help="order of the joints (FL_hip FL_thigh ...; FL_hip_joint is the same)"
    )
    parser.add_argument("--rate", type=float, help="rate of the rows, if the file has no usable time [Hz]")
    parser.add_argument("--base", choices=("fixed", "floating"), required=True, help="mounting of the base")
    parser.add_argument(
        "--tau-sensor", choices=("current", "output", "none"), default="none", help="where tau_measured is measured"
    )
    parser.add_argument("--kp", type=float, help="position gain, if not in the file [N·m/rad]")
    parser.add_argument("--kd", type=float, help="velocity gain, if not in the file [N·m·s/rad]")
    options = parser.parse_args(arguments)
    try:
        with np.load(options.file, allow_pickle=False) as arrays:
            converted = convert(dict(arrays), options.joints, options.rate)
    except (OSError, ValueError, TypeError) as error:
        print(f"{options.file}: {error}", file=sys.stderr)
        return 1
    if options.out.exists():
        print(f"{options.out} exists; choose another folder for --out", file=sys.stderr)
        return 1
    table = converted.columns
    period = float(np.median(np.diff(table["t"])))
    given = {name: value for name, value in (("kp", options.kp), ("kd", options.kd)) if value is not None}
    gains = {**converted.gains, **given}
    meta: dict[str, Any] = {
        "rate_hz": round(1.0 / period, 3),
        "tau_sensor": options.tau_sensor,
        "segments": [{"name": options.file.stem, "base": options.base}],
        **gains,
    }
    if any(isinstance(gain, list) for gain in gains.values()):
        meta["joints"] = converted.joints
    options.out.mkdir(parents=True)
    header = ",".join(table)
    np.savetxt(options.out / "data.csv", np.column_stack(list(table.values())), "%.9g", ",", header=header, comments="")
    (options.out / "meta.json").write_text(json.dumps(meta, indent=1) + "\n")
    for note in converted.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"{len(table['t'])} rows, {len(table)} columns -> {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
