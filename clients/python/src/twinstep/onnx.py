"""One row of an ensemble of learned drives as an ONNX graph: ``python -m twinstep.onnx``. Needs the extra ``[onnx]``.

All members answer side by side; who calls carries their state from row to row, beginning with zeros. The graph has

- inputs ``xi`` (batch, 2 + one-hot inputs): position error [rad] and velocity error [rad/s], command less measurement,
  and where the networks are told of the joint a one in its column; ``h`` and ``c`` (members, batch, hidden);
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
# The oldest format that has this opset: younger ones are refused by older runtimes.
IR_VERSION = 8
VARIANCE_FLOOR = 1e-6
KINDS = ["hip", "thigh", "calf"]

Array = NDArray[np.float32]


class EnsembleFileError(Error, ValueError):
    """The file is no ensemble; the message says what is missing."""


@dataclass(frozen=True)
class EnsembleFile:
    """What ``twinstep fit`` has written."""

    description: dict[str, Any]
    arrays: dict[str, Array]

    @classmethod
    def read(cls, path: Path) -> "EnsembleFile":
        """Read a safetensors file: the length of the header, the header as JSON, the arrays.

        Raises
        ------
        EnsembleFileError
            It is no safetensors file, or not one of an ensemble.
        """
        content = path.read_bytes()
        try:
            start = 8 + int.from_bytes(content[:8], "little")
            header = json.loads(content[8:start])
            description = json.loads(header.pop("__metadata__")["ensemble"])
            arrays = {name: array(content[start:], entry) for name, entry in header.items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise EnsembleFileError(f"{path} is no ensemble of `twinstep fit`: {error!r}") from error
        return cls(description, arrays)

    def stacked(self, name: str) -> Array:
        """The array ``name`` of every member; vectors become rows, so that products can be added to them."""
        members = range(self.description["members"])
        try:
            stack = np.stack([self.arrays[f"{member}.{name}"] for member in members])
        except KeyError as error:
            raise EnsembleFileError(f"the ensemble has no array {error}") from error
        return stack[:, None] if stack.ndim == 2 else stack

    def columns(self) -> list[str]:
        """Names of the columns of ``xi``."""
        one_hot = {"pooled": list[str](), "kind": KINDS, "identity": self.description["joints"]}
        return ["position_error", "velocity_error", *one_hot[self.description["joint_input"]]]


def array(content: bytes, entry: dict[str, Any]) -> Array:
    """An array of 32-bit floats among the bytes behind the header."""
    if entry["dtype"] != "F32":
        raise ValueError(f"numbers of the kind {entry['dtype']} instead of F32")
    first, end = entry["data_offsets"]
    return np.frombuffer(content[first:end], "<f4").reshape(entry["shape"])


class Graph:
    """Nodes one after the other, and the constants between them."""

    def __init__(self) -> None:
        self.nodes = list[Any]()
        self.constants = list[Any]()

    def constant(self, value: object, dtype: type[np.generic] = np.float32) -> str:
        """The name of a constant."""
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, operation: str, inputs: Sequence[str], output: str, **attributes: int) -> str:
        """One operation; gives the name of its output back."""
        self.nodes.append(helper.make_node(operation, list(inputs), [output], **cast(Any, attributes)))
        return output

    def affine(self, source: str, weight: Array, bias: Array, output: str) -> str:
        """``source @ weight + bias`` of every member."""
        product = self.add("MatMul", [source, self.constant(weight)], f"{output}_product")
        return self.add("Add", [product, self.constant(bias)], output)


def step_graph(ensemble: EnsembleFile) -> Graph:
    """From ``xi``, ``h`` and ``c`` to ``mean``, ``variance``, ``next_h`` and ``next_c``."""
    graph, scales = Graph(), ensemble.description["scales"]
    encode(graph, ensemble, normalised(graph, ensemble))
    deviation = graph.constant(scales["torque"]["deviation"])
    mean = graph.add("Mul", [head(graph, ensemble, "mean"), deviation], "mean_deviation")
    graph.add("Add", [mean, graph.constant(scales["torque"]["mean"])], "mean")
    positive = graph.add("Softplus", [head(graph, ensemble, "variance")], "variance_positive")
    floored = graph.add("Add", [positive, graph.constant(VARIANCE_FLOOR)], "variance_floored")
    scale = ensemble.description["variance_scale"] * scales["torque"]["deviation"] ** 2
    graph.add("Mul", [floored, graph.constant(scale)], "variance")
    return graph


def normalised(graph: Graph, ensemble: EnsembleFile) -> str:
    """ξ in the networks' units; what they are told of the joint as it is."""
    scales, told = ensemble.description["scales"]["errors"], len(ensemble.columns()) - 2
    means = [scale["mean"] for scale in scales] + [0.0] * told
    deviations = [scale["deviation"] for scale in scales] + [1.0] * told
    centred = graph.add("Sub", ["xi", graph.constant(means)], "xi_centred")
    return graph.add("Div", [centred, graph.constant(deviations)], "xi_normalised")


def encode(graph: Graph, ensemble: EnsembleFile, inputs: str) -> None:
    """One row of the LSTM: ``next_h`` and ``next_c``, (members, batch, hidden)."""
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
    """What a head says of ``next_h``, normalised, (members, batch)."""

    def layer(source: str, part: str, output: str) -> str:
        weight, bias = ensemble.stacked(f"{name}.{part}weight"), ensemble.stacked(f"{name}.{part}bias")
        return graph.affine(source, weight, bias, output)

    hidden = graph.add("Relu", [layer("next_h", "hidden.", f"{name}_hidden")], f"{name}_relu")
    last = graph.constant([2], np.int64)
    return graph.add("Squeeze", [layer(hidden, "", f"{name}_row"), last], f"{name}_normalised")


def step_model(ensemble: EnsembleFile) -> ModelProto:
    """The checked ONNX model of one row."""
    description = ensemble.description
    members, hidden = description["members"], description["hidden"]

    def value(name: str, *shape: int | str) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    state, answer, columns = (members, "batch", hidden), (members, "batch"), ensemble.columns()
    graph = step_graph(ensemble)
    inputs = [value("xi", "batch", len(columns)), value("h", *state), value("c", *state)]
    outputs = [value("mean", *answer), value("variance", *answer), value("next_h", *state), value("next_c", *state)]
    made = helper.make_graph(graph.nodes, "twinstep_ensemble_step", inputs, outputs, graph.constants)
    model = helper.make_model(
        made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="twinstep"
    )
    told = {name: json.dumps(description[name]) for name in ("dt", "joints", "joint_input", "gains")}
    told |= {"inputs": json.dumps(columns), "tau_sensor": description["tau_sensor"]}
    helper.set_model_props(model, told)
    checker.check_model(model, full_check=True)
    return model


def main() -> None:
    """Read, convert, write."""
    parser = argparse.ArgumentParser(
        prog="python -m twinstep.onnx", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ensemble", type=Path, metavar="ENSEMBLE.safetensors", help="what `twinstep fit` has written")
    parser.add_argument("out", type=Path, metavar="OUT.onnx", help="the file to write")
    arguments = parser.parse_args()
    try:
        arguments.out.write_bytes(step_model(EnsembleFile.read(arguments.ensemble)).SerializeToString())
    except (EnsembleFileError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
