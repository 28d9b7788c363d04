"""A `Program` as an ONNX model of a batch of states, by operators of the standard set alone.

States and results are in single precision, as most runtimes want them; the computation is in double, so that results are off
by no more than their own rounding.
"""

import json
from typing import Any

import numpy as np

from ocp_torch.errors import InputError
from ocp_torch.export.onnx_functions import COMPOSED
from ocp_torch.export.program import STATE, Operand, Operation, Program, View

# The operator set of ONNX 1.13, which runtimes have had since 2022.
OPSET = 18
# The version of the file format that goes with it.
FILE = 8
ENTRYWISE = dict(
    neg="Neg", sin="Sin", exp="Exp", log="Log", tanh="Tanh", sqrt="Sqrt", abs="Abs", floor="Floor", add="Add",
    sub="Sub", mul="Mul", div="Div", pow="Pow", maximum="Max", minimum="Min",
)  # fmt: skip
# Operators with truth values, which are cast to numbers.
COMPARED = dict(eq="Equal", lt="Less", le="LessOrEqual", gt="Greater", ge="GreaterOrEqual")
# Name of the input.
GIVEN = "state"
REDUCED = dict(sum="ReduceSum", max="ReduceMax", min="ReduceMin")


def require_onnx() -> Any:
    """The `onnx` module, or `InputError`."""
    try:
        import onnx
    except ImportError:
        raise InputError('format=onnx needs onnx: pip install -e ".[onnx]".') from None
    return onnx


def onnx_model(program: Program, name: str, about: str, metadata: dict) -> Any:
    """`onnx.ModelProto` with the input ``state`` ``(N, d)`` and the outputs of ``program``, batches each."""
    onnx = require_onnx()
    writer = Writer(onnx, program)
    helper, number = onnx.helper, onnx.TensorProto.FLOAT
    outputs = []
    for key, view in program.outputs.items():
        shape = list(view.places.shape[1:])
        result = writer.cast(writer.entries(view), "FLOAT")
        writer.node("Reshape", [result, writer.integers([0, *shape])], key)
        outputs.append(helper.make_tensor_value_info(key, number, ["N", *shape]))
    state = helper.make_tensor_value_info(GIVEN, number, ["N", program.dim])
    graph = helper.make_graph(writer.nodes, name, [state], outputs, writer.initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="ocp_torch")
    model.ir_version, model.doc_string = FILE, about
    helper.set_model_props(model, {"ocp_torch": json.dumps(metadata)})
    onnx.checker.check_model(model, full_check=True)
    return model


class Writer:
    """Writes the nodes of the graph; each buffer is a tensor ``(N, size)``, a constant ``(1, size)``."""

    def __init__(self, onnx: Any, program: Program) -> None:
        self.onnx, self.program = onnx, program
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []
        self._known: dict[tuple[str, bytes], str] = {}
        self.names = {STATE: self.cast(GIVEN, "DOUBLE")}
        for operation in program.operations:
            self.names[operation.buffer] = self._result(operation)

    def node(self, kind: str, inputs: list[str], output: str | None = None, **options: Any) -> str:
        """Add a node; the name of its output."""
        output = f"t{len(self.nodes)}" if output is None else output
        self.nodes.append(self.onnx.helper.make_node(kind, inputs, [output], **options))
        return output

    def cast(self, name: str, kind: str) -> str:
        """The tensor ``name`` cast to another ``kind`` of numbers, by ONNX's name of it."""
        return self.node("Cast", [name], to=getattr(self.onnx.TensorProto, kind))

    def number(self, value: float) -> str:
        """A constant for all entries of all states."""
        return self._constant(np.full((1, 1), value, dtype=np.float64))

    def table(self, values: np.ndarray) -> str:
        """Constants ``(k,)``."""
        return self._constant(values)

    def integers(self, values: list[int]) -> str:
        """A constant vector of integers."""
        return self._constant(np.array(values, dtype=np.int64))

    def entries(self, view: View) -> str:
        """The entries of ``view`` in row-major order, ``(N, ..)``."""
        if view.buffer in self.program.constants:
            return self._constant(self.program.constants[view.buffer][None, view.flat])
        name = self.names[view.buffer]
        if view.whole(self.program.sizes[view.buffer]):
            return name
        return self.node("Gather", [name, self.integers(view.flat)], axis=1)

    def _constant(self, value: np.ndarray) -> str:
        key = (str((value.dtype, value.shape)), value.tobytes())
        if key not in self._known:
            self._known[key] = f"c{len(self._known)}"
            self.initializers.append(self.onnx.numpy_helper.from_array(value, self._known[key]))
        return self._known[key]

    def _operand(self, operand: Operand) -> str:
        return self.entries(operand) if isinstance(operand, View) else self.number(operand)

    def _matrix(self, view: View) -> str:
        """A view ``(n, k)`` as ``(N, n, k)``, ready for a product; a constant without the batch."""
        if view.buffer in self.program.constants:
            return self._constant(self.program.constants[view.buffer][view.places.numpy()])
        return self.node("Reshape", [self.entries(view), self.integers([0, *view.places.shape])])

    def _result(self, operation: Operation) -> str:
        name, operands, buffer = operation.name, operation.operands, operation.buffer
        if name == "matmul":
            product = self.node("MatMul", [self._matrix(o) for o in operands])  # type: ignore[arg-type]
            return self.node("Reshape", [product, self.integers([0, self.program.sizes[buffer]])])
        if name in REDUCED:
            rows = self._matrix(operands[0])  # type: ignore[arg-type]
            return self.node(REDUCED[name], [rows, self.integers([2])], keepdims=0)
        inputs = [self._operand(o) for o in operands]
        if name == "cat":
            return self.node("Concat", self._batched(inputs, operands), axis=1)
        if name == "ne":
            return self.cast(self.node("Not", [self.node("Equal", inputs)]), "DOUBLE")
        if name in COMPARED:
            return self.cast(self.node(COMPARED[name], inputs), "DOUBLE")
        if name == "where":
            return self.node("Where", [self.cast(inputs[0], "BOOL"), *inputs[1:]])
        if name in COMPOSED:
            return COMPOSED[name](self, inputs[0])
        if name in ENTRYWISE:
            return self.node(ENTRYWISE[name], inputs)
        raise InputError(f"format=onnx has no operator for {name}; choose c or casadi.")

    def _batched(self, inputs: list[str], operands: tuple[Operand, ...]) -> list[str]:
        """``inputs`` with constants repeated for each state, as all parts of a concatenation must have one length."""
        constant = [isinstance(o, View) and o.buffer in self.program.constants for o in operands]
        if not any(constant):
            return inputs
        first = self.node("Gather", [self.names[STATE], self.integers([0])], axis=1)
        zeros = self.cast(self.node("Less", [first, first]), "DOUBLE")  # 0 also for a state that is not finite
        return [self.node("Add", [name, zeros]) if c else name for name, c in zip(inputs, constant, strict=True)]
