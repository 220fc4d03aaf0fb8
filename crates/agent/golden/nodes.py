"""Writes the tests of the operators in the ONNX package as files for the example `onnx_outputs`. Usage: nodes.py DIR.

Needs onnx. Left out: operators that no network of a policy has, and tests whose inputs or outputs are not numbers.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper
from onnx.backend.test.case.node import collect_testcases

OPERATORS = {
    "Identity",
    "Dropout",
    "Clip",
    "Cast",
    "CastLike",
    "Where",
    "PRelu",
    "Abs",
    "Neg",
    "Exp",
    "Log",
    "Sqrt",
    "Reciprocal",
    "Sin",
    "Cos",
    "Tan",
    "Asin",
    "Acos",
    "Atan",
    "Sinh",
    "Cosh",
    "Tanh",
    "Asinh",
    "Acosh",
    "Atanh",
    "Floor",
    "Ceil",
    "Round",
    "Sign",
    "Erf",
    "Relu",
    "Sigmoid",
    "Softplus",
    "Softsign",
    "Mish",
    "HardSwish",
    "Gelu",
    "HardSigmoid",
    "LeakyRelu",
    "Elu",
    "Celu",
    "Selu",
    "ThresholdedRelu",
    "Add",
    "Sum",
    "Sub",
    "Mul",
    "Div",
    "Mod",
    "Pow",
    "Max",
    "Min",
    "Equal",
    "Less",
    "LessOrEqual",
    "Greater",
    "GreaterOrEqual",
    "And",
    "Or",
    "Xor",
    "Not",
    "IsNaN",
    "Mean",
    "Constant",
    "ConstantOfShape",
    "Shape",
    "Size",
    "Range",
    "Reshape",
    "Flatten",
    "Squeeze",
    "Unsqueeze",
    "Expand",
    "Tile",
    "Transpose",
    "Concat",
    "Slice",
    "Gather",
    "GatherElements",
    "Pad",
    "Split",
    "ReduceSum",
    "ReduceMean",
    "ReduceMax",
    "ReduceMin",
    "ReduceProd",
    "ReduceL1",
    "ReduceL2",
    "ReduceSumSquare",
    "ReduceLogSum",
    "ReduceLogSumExp",
    "ArgMax",
    "ArgMin",
    "Softmax",
    "LogSoftmax",
    "LpNormalization",
    "LayerNormalization",
    "BatchNormalization",
    "Gemm",
    "MatMul",
    "Conv",
    "LSTM",
    "GRU",
    "RNN",
}
KINDS = (np.float32, np.float64, np.int32, np.int64, np.bool_)


def write(case, folder: Path) -> bool:
    model = case.model
    if any(node.op_type not in OPERATORS for node in model.graph.node) or not case.data_sets:
        return False
    values, results = ([np.asarray(array) for array in side] for side in case.data_sets[0])
    if any(array.dtype not in KINDS for array in values + results):
        return False
    # Inputs that are not floats become constants.
    inputs, kept = {}, []
    for port, array in zip(list(model.graph.input), values, strict=False):
        if array.dtype == np.float32 and array.size and array.ndim:
            inputs[port.name] = array.ravel().tolist()
            kept.append(port)
        else:
            model.graph.initializer.append(numpy_helper.from_array(array, port.name))
    outputs = {
        port.name: array.astype(float).ravel().tolist()
        for port, array in zip(model.graph.output, results, strict=False)
    }
    numbers = [number for side in (inputs, outputs) for array in side.values() for number in array]
    if not kept or not np.isfinite(numbers).all():
        return False
    del model.graph.input[:]
    model.graph.input.extend(kept)
    onnx.save(model, folder / f"{case.name}.onnx")
    (folder / f"{case.name}.json").write_text(json.dumps([{"inputs": inputs, "outputs": outputs}]))
    return True


if __name__ == "__main__":
    target = Path(sys.argv[1])
    target.mkdir(parents=True, exist_ok=True)
    print(sum(write(case, target) for case in collect_testcases(None)), "tests")
