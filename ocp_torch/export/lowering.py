"""From the graph of a PyTorch function of a batch of states to the `Program` of one state.

The operations of the graph are few, as PyTorch has decomposed the others. Operations that only move entries are applied to
the places of a view instead.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, fx

from ocp_torch.errors import InputError
from ocp_torch.export.program import Operand, Program, View
from ocp_torch.export.tracing import traced

# Operations that move entries.
MOVES = """view _unsafe_view reshape permute transpose t expand unsqueeze squeeze slice select flip repeat diagonal index
    index_select split split_with_sizes unbind gather""".split()
# Operations that copy; conversions are copies too: numbers have the precision of the format, and truth values are numbers.
COPIES = ("alias", "detach", "clone", "lift_fresh", "contiguous", "_to")
WHOLE = (torch.int8, torch.int16, torch.int32, torch.int64, torch.uint8)
# Operations on each entry, or on the entries of operands broadcast to one shape.
ENTRYWISE = """neg sin cos exp log tanh erf sqrt abs floor atan2 add sub mul div maximum minimum eq ne lt le gt ge where
    tan atan asin acos sinh cosh""".split()
REDUCTIONS = {"sum": "sum", "amax": "max", "amin": "min"}
SAME = {"bitwise_and": "mul", "logical_and": "mul", "bitwise_or": "maximum", "logical_or": "maximum"}


def lowered(function: Callable[[Tensor], dict[str, Tensor]], examples: Tensor) -> Program:
    """The `Program` of ``function`` from states to a result for each name, by way of its graph (`traced`, on ``examples``
    ``(K, d)``). Raises `InputError` for a function that cannot be traced, and for an operation that no format knows."""
    graph, names = traced(function, examples)
    lowering = Lowering(graph, Program(examples.shape[1]))
    outputs = lowering.run()
    lowering.program.outputs = dict(zip(names, outputs, strict=True))
    return lowering.program.pruned()


class Lowering:
    """Translates a graph node by node: each node becomes a view, or a plain value."""

    def __init__(self, graph: fx.GraphModule, program: Program) -> None:
        self.graph, self.program = graph, program
        self.known: dict[fx.Node, Any] = {}

    def run(self) -> list[View]:
        for node in self.graph.graph.nodes:
            if node.op == "placeholder":
                self.known[node] = self.program.state
            elif node.op == "get_attr":
                self.known[node] = getattr(self.graph, node.target)
            elif node.op == "output":
                return [self.view(value) for value in self._resolved(node.args[0])]
            else:
                self.known[node] = self._result(node)
        raise InputError("this controller cannot be exported: it has no result.")

    def _resolved(self, value: Any) -> Any:
        return fx.node.map_arg(value, lambda node: self.known[node])

    def view(self, value: Any) -> View:
        """``value`` as a view; a tensor that does not depend on the state becomes a constant of the program."""
        return value if isinstance(value, View) else self.program.constant(torch.as_tensor(value))

    def _result(self, node: fx.Node) -> Any:
        args, options = self._resolved(node.args), self._resolved(node.kwargs)
        if node.target is operator.getitem:
            return args[0][args[1]]
        name = node.target._schema.name.removeprefix("aten::").removesuffix("_copy")  # type: ignore[union-attr]
        views = [a for a in torch.utils._pytree.tree_leaves((args, options)) if isinstance(a, View)]
        fills = name.endswith("_like") or name.startswith("new_")
        if not views or fills:  # the same for every state
            example = lambda v: torch.empty(v.places.shape, dtype=torch.float64)
            filled = torch.utils._pytree.tree_map_only(View, example, (args, options))
            return node.target(*filled[0], **filled[1])  # type: ignore[operator]
        if name in COPIES and options.get("dtype") not in WHOLE:
            return args[0]
        if name in MOVES and len(views) == 1:
            return self._moved(node, args, options)
        if name in REDUCTIONS:
            return self._reduced(REDUCTIONS[name], *args, **options)
        lower = getattr(self, f"_{name}", None)
        if lower is not None:
            return lower(*args, **options)
        if SAME.get(name, name) in ENTRYWISE and set(options) <= {"alpha"}:
            return self._entrywise(SAME.get(name, name), args, options.get("alpha", 1))
        raise InputError(f"this controller cannot be exported: nothing is known of the operation {name}.")

    def _moved(self, node: fx.Node, args: tuple, options: dict) -> Any:
        source = self.view(args[0])
        # Where PyTorch made a contiguous copy, the places may still be in another order.
        moved = node.target(source.places.contiguous(), *args[1:], **options)  # type: ignore[operator]
        part = lambda places: View(source.buffer, places)
        return part(moved) if isinstance(moved, Tensor) else [part(places) for places in moved]

    def _entrywise(self, name: str, args: tuple, alpha: float = 1) -> View:
        if alpha != 1:
            args = (args[0], self._entrywise("mul", (args[1], alpha)))
        operands: list[Operand] = [float(a) if isinstance(a, bool | int | float) else self.view(a) for a in args]
        operands = [self._number(o) for o in operands]
        views = [o for o in operands if isinstance(o, View)]
        places = iter(torch.broadcast_tensors(*(v.places for v in views)))
        same = tuple(View(o.buffer, next(places)) if isinstance(o, View) else o for o in operands)
        shape = torch.broadcast_shapes(*(v.places.shape for v in views))
        return self.program.add(name, same, shape)

    def _number(self, operand: Operand) -> Operand:
        """``operand``, or the number itself if it is a constant of one entry."""
        single = isinstance(operand, View) and operand.buffer in self.program.constants and operand.places.dim() == 0
        return float(self.program.constants[operand.buffer][int(operand.places)]) if single else operand  # type: ignore

    def _reduced(self, name: str, of: View, axes: Any = None, keepdim: bool = False, **_: Any) -> View:
        rank = of.places.dim()
        axes = range(rank) if axes is None or axes == [] else [axes] if isinstance(axes, int) else axes
        last = sorted(axis % rank for axis in axes)
        first = [axis for axis in range(rank) if axis not in last]
        shape = [of.places.shape[axis] for axis in first]
        rows = of.places.permute(*first, *last).reshape(int(torch.Size(shape).numel()), -1)
        kept = [1 if axis in last else of.places.shape[axis] for axis in range(rank)]
        return self.program.add(name, (View(of.buffer, rows),), kept if keepdim else shape)

    def _mean(self, of: View, axes: Any = None, keepdim: bool = False, **_: Any) -> View:
        total = self._reduced("sum", of, axes, keepdim)
        return self._entrywise("div", (total, of.places.numel() / total.places.numel()))

    def _prod(self, of: View, axis: int | None = None, keepdim: bool = False, **_: Any) -> View:
        factors = of.places.flatten() if axis is None else of.places.movedim(axis, -1)
        first, *rest = (View(of.buffer, places) for places in factors.unbind(-1))
        for factor in rest:
            first = self._entrywise("mul", (first, factor))
        return View(first.buffer, first.places.unsqueeze(axis)) if keepdim and axis is not None else first

    def _cumsum(self, of: View, axis: int, **_: Any) -> View:
        sums = list[View]()
        for term in (View(of.buffer, places) for places in of.places.unbind(axis)):
            sums.append(self._entrywise("add", (sums[-1], term)) if sums else term)
        return self._cat([View(v.buffer, v.places.unsqueeze(axis)) for v in sums], axis)

    def _cat(self, parts: list, dim: int = 0) -> View:
        views = [v for v in map(self.view, parts) if v.places.numel()]
        shape = torch.cat([v.places for v in views], dim).shape
        outer = int(shape[: dim % len(shape)].numel())
        # Row by row: the evenly spaced rows of a result in row-major order become loops.
        flat = [(v.buffer, v.places.reshape(outer, -1)) for v in views]
        rows = [View(buffer, places[row]) for row in range(outer) for buffer, places in flat]
        return self.program.add("cat", tuple(rows), shape)

    def _mm(self, left: Any, right: Any) -> View:
        left, right = self.view(left), self.view(right)
        return self.program.add("matmul", (left, right), (left.places.shape[0], right.places.shape[1]))

    def _addmm(self, bias: Any, left: Any, right: Any) -> View:
        return self._entrywise("add", (bias, self._mm(left, right)))

    def _mv(self, left: Any, right: Any) -> View:
        left, right = self.view(left), self.view(right)
        product = self._mm(left, View(right.buffer, right.places.unsqueeze(1)))
        return View(product.buffer, product.places.squeeze(1))

    def _bmm(self, left: Any, right: Any) -> View:
        left, right = self.view(left), self.view(right)
        wide, tall = left.places.unsqueeze(3), right.places.unsqueeze(1)
        return self._reduced("sum", self._entrywise("mul", (View(left.buffer, wide), View(right.buffer, tall))), [2])

    def _clamp(self, x: View, low: Any = None, high: Any = None, min: Any = None, max: Any = None) -> View:
        for name, end in (("maximum", low if min is None else min), ("minimum", high if max is None else max)):
            x = x if end is None else self._entrywise(name, (x, end))
        return x

    def _clamp_min(self, x: View, low: Any) -> View:
        return self._clamp(x, low)

    def _clamp_max(self, x: View, high: Any) -> View:
        return self._clamp(x, None, high)

    def _relu(self, x: View) -> View:
        return self._clamp(x, 0.0)

    def _remainder(self, x: Any, divisor: Any) -> View:
        turns = self._entrywise("floor", (self._entrywise("div", (x, divisor)),))
        return self._entrywise("sub", (x, self._entrywise("mul", (turns, divisor))))

    def _pow(self, x: Any, exponent: Any) -> View:
        if exponent == 2:
            return self._entrywise("mul", (x, x))
        return self._entrywise("pow", (x, exponent))

    def _reciprocal(self, x: View) -> View:
        return self._entrywise("div", (1.0, x))

    def _rsqrt(self, x: View) -> View:
        return self._reciprocal(self._entrywise("sqrt", (x,)))

    def _rsub(self, x: View, other: Any, alpha: float = 1) -> View:
        return self._entrywise("sub", (other, x), alpha)

    def _gelu(self, x: View, approximate: str = "none") -> View:
        half = self._entrywise("mul", (x, 0.5))
        return self._entrywise("mul", (half, self._entrywise("add", (1.0, self._scaled_erf(x)))))

    def _scaled_erf(self, x: View) -> View:
        return self._entrywise("erf", (self._entrywise("mul", (x, math.sqrt(0.5))),))

    def _special_ndtr(self, x: View) -> View:
        return self._entrywise("mul", (0.5, self._entrywise("add", (1.0, self._scaled_erf(x)))))

    def _silu(self, x: View) -> View:
        return self._entrywise("mul", (x, self._sigmoid(x)))

    def _sigmoid(self, x: View) -> View:
        return self._reciprocal(self._entrywise("add", (1.0, self._entrywise("exp", (self._entrywise("neg", (x,)),)))))

    def _sign(self, x: View) -> View:
        return self._entrywise("sub", (self._entrywise("gt", (x, 0.0)), self._entrywise("lt", (x, 0.0))))

    def _exp2(self, x: View) -> View:
        return self._entrywise("exp", (self._entrywise("mul", (x, math.log(2.0))),))

    def _log1p(self, x: View) -> View:
        return self._entrywise("log", (self._entrywise("add", (1.0, x)),))

    def _logical_not(self, x: View) -> View:
        return self._entrywise("eq", (x, 0.0))

    _bitwise_not = _logical_not

    def _masked_fill(self, x: View, mask: View, value: Any) -> View:
        return self._entrywise("where", (mask, value, x))

    def _linalg_vector_norm(self, x: View, ord: float = 2, dim: Any = None, keepdim: bool = False, **_: Any) -> View:
        if ord != 2:
            raise InputError(f"this controller cannot be exported: nothing is known of norms of order {ord}.")
        return self._entrywise("sqrt", (self._reduced("sum", self._entrywise("mul", (x, x)), dim, keepdim),))
