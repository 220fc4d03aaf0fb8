"""Export one step of an ensemble of actuator networks to ONNX: ``python -m twinstep.onnx``. Requires ``[onnx]``.

The graph evaluates all members. The caller passes their LSTM state from row to row, beginning with zeros. It has

- inputs ``xi`` (batch, 2 + one-hot inputs): position error [rad] and velocity error [rad/s], command minus
  measurement, or the torque that was asked for [N·m] and the velocity [rad/s] if the ensemble has that input, and the
  one-hot encoding of the joint, if any; ``h`` and ``c`` (members, batch, hidden);
- outputs ``mean`` [N·m] and ``variance`` [N²·m²], scaled as calibrated, (members, batch); ``next_h`` and ``next_c``;
- the metadata ``dt`` [s], ``joints``, ``joint_input``, ``inputs`` (names of the columns of ``xi``), ``gains`` (kp and
  kd of each joint) and ``tau_sensor``, all but the last as JSON.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from .errors import Error

try:
    from onnx import ModelProto, TensorProto, checker, helper, numpy_helper
except ImportError as error:
    raise ImportError('ONNX is not installed here\n  pip install "twinstep[onnx]"') from error

OPSET = 17
# The oldest format with this opset, because older runtimes reject newer formats.
IR_VERSION = 8
VARIANCE_FLOOR = 1e-6
KINDS = ["hip", "thigh", "calf"]
# Names of the first two columns, by the input of the networks.
INPUTS = {"errors": ("position_error", "velocity_error"), "torque": ("asked_torque", "velocity")}

Array = NDArray[np.float32]


class EnsembleFileError(Error, ValueError):
    """The file is not a valid ensemble; the message contains the reason."""


@dataclass(frozen=True)
class EnsembleFile:
    """Ensemble file of ``twinstep fit``."""

    description: dict[str, Any]
    arrays: dict[str, Array]

    @classmethod
    def read(cls, path: Path) -> "EnsembleFile":
        """Read a safetensors file: the length of the header, the header as JSON, the arrays.

        Raises
        ------
        EnsembleFileError
            The file is not a safetensors file of an ensemble.
        """
        content = path.read_bytes()
        try:
            start = 8 + int.from_bytes(content[:8], "little")
            header = json.loads(content[8:start])
            description = json.loads(header.pop("__metadata__")["ensemble"])
            arrays = {name: array(content[start:], entry) for name, entry in header.items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise EnsembleFileError(f"{path} is not an ensemble of `twinstep fit`: {error!r}") from error
        return cls(description, arrays)

    def stacked(self, name: str) -> Array:
        """Return the array ``name`` of all members. Vectors become rows, so that they can be added to products."""
        members = range(self.description["members"])
        try:
            stack = np.stack([self.arrays[f"{member}.{name}"] for member in members])
        except KeyError as error:
            raise EnsembleFileError(f"the ensemble has no array {error}") from error
        return stack[:, None] if stack.ndim == 2 else stack

    def columns(self) -> list[str]:
        """Return the names of the columns of ``xi``."""
        one_hot = {"pooled": list[str](), "kind": KINDS, "identity": self.description["joints"]}
        first = INPUTS[self.description.get("input", "errors")]
        return [*first, *one_hot[self.description["joint_input"]]]


def array(content: bytes, entry: dict[str, Any]) -> Array:
    """Return an array of 32-bit floats from the bytes after the header."""
    if entry["dtype"] != "F32":
        raise ValueError(f"dtype {entry['dtype']} instead of F32")
    first, end = entry["data_offsets"]
    return np.frombuffer(content[first:end], "<f4").reshape(entry["shape"])


class Graph:
    """Nodes and constants of an ONNX graph."""

    def __init__(self) -> None:
        self.nodes = list[Any]()
        self.constants = list[Any]()

    def constant(self, value: object, dtype: type[np.generic] = np.float32) -> str:
        """Add a constant and return its name."""
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, operation: str, inputs: Sequence[str], output: str, **attributes: int) -> str:
        """Add an operation and return the name of its output."""
        self.nodes.append(helper.make_node(operation, list(inputs), [output], **cast(Any, attributes)))
        return output

    def affine(self, source: str, weight: Array, bias: Array, output: str) -> str:
        """Add ``source @ weight + bias`` of every member."""
        product = self.add("MatMul", [source, self.constant(weight)], f"{output}_product")
        return self.add("Add", [product, self.constant(bias)], output)


def step_graph(ensemble: EnsembleFile) -> Graph:
    """Return the graph from ``xi``, ``h`` and ``c`` to ``mean``, ``variance``, ``next_h`` and ``next_c``."""
    graph, scales = Graph(), ensemble.description["scales"]
    encode(graph, ensemble, normalised(graph, ensemble))
    std = graph.constant(scales["torque"]["deviation"])
    mean = graph.add("Mul", [head(graph, ensemble, "mean"), std], "mean_deviation")
    graph.add("Add", [mean, graph.constant(scales["torque"]["mean"])], "mean")
    positive = graph.add("Softplus", [head(graph, ensemble, "variance")], "variance_positive")
    floored = graph.add("Add", [positive, graph.constant(VARIANCE_FLOOR)], "variance_floored")
    scale = ensemble.description["variance_scale"] * scales["torque"]["deviation"] ** 2
    graph.add("Mul", [floored, graph.constant(scale)], "variance")
    return graph


def normalised(graph: Graph, ensemble: EnsembleFile) -> str:
    """Add the normalisation of ξ; the one-hot inputs do not change."""
    scales, one_hot = ensemble.description["scales"]["errors"], len(ensemble.columns()) - 2
    means = [scale["mean"] for scale in scales] + [0.0] * one_hot
    stds = [scale["deviation"] for scale in scales] + [1.0] * one_hot
    centred = graph.add("Sub", ["xi", graph.constant(means)], "xi_centred")
    return graph.add("Div", [centred, graph.constant(stds)], "xi_normalised")


def encode(graph: Graph, ensemble: EnsembleFile, inputs: str) -> None:
    """Add one step of the LSTM: ``next_h`` and ``next_c``, (members, batch, hidden)."""
    hidden = ensemble.description["hidden"]
    by_input = graph.affine(inputs, ensemble.stacked("lstm.input_weight"), ensemble.stacked("lstm.bias"), "by_input")
    weight = graph.constant(ensemble.stacked("lstm.hidden_weight"))
    gates = graph.add("Add", [by_input, graph.add("MatMul", ["h", weight], "by_state")], "gates")
    names = ["input", "forget", "cell", "output"]
    sizes = graph.constant([hidden] * 4, np.int64)
    graph.nodes.append(helper.make_node("Split", [gates, sizes], [f"{name}_heard" for name in names], axis=2))
    for name in names:
        graph.add("Tanh" if name == "cell" else "Sigmoid", [f"{name}_heard"], name)
    kept = graph.add("Mul", ["forget", "c"], "kept")
    graph.add("Add", [kept, graph.add("Mul", ["input", "cell"], "new")], "next_c")
    graph.add("Mul", ["output", graph.add("Tanh", ["next_c"], "squashed")], "next_h")


def head(graph: Graph, ensemble: EnsembleFile, name: str) -> str:
    """Add a head: its normalised output for ``next_h``, (members, batch)."""

    def layer(source: str, part: str, output: str) -> str:
        weight, bias = ensemble.stacked(f"{name}.{part}weight"), ensemble.stacked(f"{name}.{part}bias")
        return graph.affine(source, weight, bias, output)

    hidden = graph.add("Relu", [layer("next_h", "hidden.", f"{name}_hidden")], f"{name}_relu")
    last = graph.constant([2], np.int64)
    return graph.add("Squeeze", [layer(hidden, "", f"{name}_row"), last], f"{name}_normalised")


def step_model(ensemble: EnsembleFile) -> ModelProto:
    """Return the checked ONNX model of one step."""
    description = ensemble.description
    members, hidden = description["members"], description["hidden"]

    def value(name: str, *shape: int | str) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    state, output, columns = (members, "batch", hidden), (members, "batch"), ensemble.columns()
    graph = step_graph(ensemble)
    inputs = [value("xi", "batch", len(columns)), value("h", *state), value("c", *state)]
    outputs = [value("mean", *output), value("variance", *output), value("next_h", *state), value("next_c", *state)]
    made = helper.make_graph(graph.nodes, "twinstep_ensemble_step", inputs, outputs, graph.constants)
    model = helper.make_model(
        made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="twinstep"
    )
    properties = {name: json.dumps(description[name]) for name in ("dt", "joints", "joint_input", "gains")}
    properties |= {name: description[name] for name in ("input", "target") if name in description}
    properties |= {"inputs": json.dumps(columns), "tau_sensor": description["tau_sensor"]}
    helper.set_model_props(model, properties)
    checker.check_model(model, full_check=True)
    return model


def main() -> None:
    """Convert a file."""
    parser = argparse.ArgumentParser(
        prog="python -m twinstep.onnx", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ensemble", type=Path, metavar="ENSEMBLE.safetensors", help="ensemble of `twinstep fit`")
    parser.add_argument("out", type=Path, metavar="OUT.onnx", help="output file")
    arguments = parser.parse_args()
    try:
        arguments.out.write_bytes(step_model(EnsembleFile.read(arguments.ensemble)).SerializeToString())
    except (EnsembleFileError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
