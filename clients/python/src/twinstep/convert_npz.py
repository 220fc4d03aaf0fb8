"""Converts arrays of NumPy (`.npz`) to a log that `twinstep diagnose` reads.

``python -m twinstep.convert_npz walk.npz --out walk`` writes ``walk/data.csv`` and ``walk/meta.json``.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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
may be numbers (--kp, --kd).
"""


class ConversionError(ValueError):
    """An array is not a quantity of a log."""


def columns(arrays: Mapping[str, npt.NDArray[Any]], joints: Sequence[str] = JOINTS) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of a log, by name.

    Parameters
    ----------
    arrays
        Arrays of shape (rows,) or (rows, columns), see the module's ``--help``.
    joints
        Order of the joints in two-dimensional arrays.

    Raises
    ------
    ConversionError
        If an array has another shape than its quantity.
    """
    if "t" not in arrays or arrays["t"].ndim != 1:
        raise ConversionError("array `t` is missing or not one-dimensional: it is the time of each row [s]")
    rows = len(arrays["t"])
    result: dict[str, npt.NDArray[Any]] = {}
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub":
            raise ConversionError(f"array `{name}` has type {array.dtype}, not numbers")
        if array.ndim not in (1, 2) or len(array) != rows:
            raise ConversionError(f"array `{name}` has shape {array.shape}, but `t` has {rows} rows")
        if array.ndim == 1:
            result[name] = array
            continue
        parts = joints if name in JOINT_QUANTITIES else AXES.get(name)
        if parts is None:
            known = ", ".join((*JOINT_QUANTITIES, *AXES))
            raise ConversionError(f"array `{name}` has two dimensions; quantities with several columns are {known}")
        if array.shape[1] != len(parts):
            raise ConversionError(
                f"array `{name}` has {array.shape[1]} columns; it needs {len(parts)}: {', '.join(parts)}"
            )
        result |= {f"{name}_{part}": array[:, index] for index, part in enumerate(parts)}
    return result


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
    parser.add_argument("--joints", nargs="+", default=list(JOINTS), help="order of the joints (FL_hip FL_thigh ...)")
    parser.add_argument("--base", choices=("fixed", "floating"), required=True, help="mounting of the base")
    parser.add_argument(
        "--tau-sensor", choices=("current", "output", "none"), default="none", help="where tau_measured is measured"
    )
    parser.add_argument("--kp", type=float, help="position gain, if not in the file [N·m/rad]")
    parser.add_argument("--kd", type=float, help="velocity gain, if not in the file [N·m·s/rad]")
    options = parser.parse_args(arguments)
    try:
        with np.load(options.file, allow_pickle=False) as arrays:
            table = columns(dict(arrays), options.joints)
    except (OSError, ValueError) as error:
        print(f"{options.file}: {error}", file=sys.stderr)
        return 1
    if options.out.exists():
        print(f"{options.out} exists; choose another folder for --out", file=sys.stderr)
        return 1
    period = float(np.median(np.diff(table["t"])))
    gains = {name: value for name, value in (("kp", options.kp), ("kd", options.kd)) if value is not None}
    meta = {
        "rate_hz": round(1.0 / period, 3),
        "tau_sensor": options.tau_sensor,
        "segments": [{"name": options.file.stem, "base": options.base}],
        **gains,
    }
    options.out.mkdir(parents=True)
    header = ",".join(table)
    np.savetxt(options.out / "data.csv", np.column_stack(list(table.values())), "%.9g", ",", header=header, comments="")
    (options.out / "meta.json").write_text(json.dumps(meta, indent=1) + "\n")
    print(f"{len(table['t'])} rows, {len(table)} columns -> {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
