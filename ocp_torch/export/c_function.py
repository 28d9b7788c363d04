"""One C99 function: loops that carry out a `Program`, with all results in one array on the stack."""

import math
import textwrap
from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.export.program import STATE, Operation, Program, View

ENTRYWISE = {
    "neg": "-{0}", "sin": "sin({0})", "cos": "cos({0})", "exp": "exp({0})", "log": "log({0})", "tanh": "tanh({0})",
    "tan": "tan({0})", "erf": "erf({0})", "sqrt": "sqrt({0})", "abs": "fabs({0})", "floor": "floor({0})", "atan": "atan({0})",
    "asin": "asin({0})", "acos": "acos({0})", "sinh": "sinh({0})", "cosh": "cosh({0})", "atan2": "atan2({0}, {1})",
    "add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}", "pow": "pow({0}, {1})",
    "maximum": "MAX({0}, {1})", "minimum": "MIN({0}, {1})", "eq": "R({0} == {1})", "ne": "R({0} != {1})",
    "lt": "R({0} < {1})", "le": "R({0} <= {1})", "gt": "R({0} > {1})", "ge": "R({0} >= {1})",
    "where": "{0} != 0 ? {1} : {2}",
}  # fmt: skip
REDUCED = {"sum": "{0} + {1}", "max": "MAX({0}, {1})", "min": "MIN({0}, {1})"}
# Sums of products are split into so many partial sums, so that compilers can use vector instructions without reordering.
LANES = 8
# Number that stands for the array of all results.
WORK = -1

# Function from the C expression of an entry's number, and of the entries of some views there, to a statement.
Statement = Callable[[str, list[str]], str]


class Function:
    """`void name_function(const name_real state[d], name_real output[..], ..)`."""

    def __init__(self, program: Program, name: str, function: str) -> None:
        self.program = program
        outputs = "".join(f", {name}_real {key}[{view.places.numel()}]" for key, view in program.outputs.items())
        self.signature = f"void {name}_{function}(const {name}_real state[{program.dim}]{outputs})"
        self.offsets, self.space = layout(program)
        self.labels: dict[int, str] = {}  # of constants

    def definition(self, pool: dict[bytes, str]) -> str:
        """The C function; its constants are added to ``pool``, with their labels."""
        for buffer, numbers in self.program.constants.items():
            self.labels[buffer] = pool.setdefault(numbers.tobytes(), f"c{len(pool)}")
        lines = [f"real x[{self.program.dim}], w[{max(1, self.space)}];"]
        lines.append(f"for (int i = 0; i < {self.program.dim}; i++) x[i] = R(state[i]);")
        for operation in self.program.operations:
            lines += self._statements(operation)
        for key, view in self.program.outputs.items():
            lines += self._loops([view], lambda at, of, key=key: f"{key}[{at}] = OUT({of[0]});")  # type: ignore[misc]
        return f"{self.signature}\n{{\n{textwrap.indent(chr(10).join(lines), '    ')}\n}}\n"

    def _statements(self, operation: Operation) -> list[str]:
        name, operands, start = operation.name, operation.operands, self.offsets[operation.buffer]
        views = [o for o in operands if isinstance(o, View)]
        if name == "matmul":
            return self._product(views[0], views[1], start)
        if name in REDUCED:
            return self._reduced(REDUCED[name], views[0], start)
        if name == "cat":
            lines = []
            for view in views:
                lines += self._loops([view], lambda at, of, start=start: f"w[{at} + {start}] = {of[0]};")  # type: ignore[misc]
                start += view.places.numel()
            return lines

        def statement(at: str, of: list[str]) -> str:
            read = iter(of)
            terms = (next(read) if isinstance(o, View) else number(o) for o in operands)
            return f"w[{at} + {start}] = {ENTRYWISE[name].format(*terms)};"

        return self._loops(views, statement)

    def _reduced(self, template: str, rows: View, start: int) -> list[str]:
        count, length = rows.places.shape
        lines = self._loops([View(rows.buffer, rows.places[:, 0])], lambda at, of: f"w[{at} + {start}] = {of[0]};")
        if length == 1:
            return lines
        rest = View(rows.buffer, rows.places[:, 1:])
        target = View(WORK, torch.arange(start, start + count).unsqueeze(1).expand(-1, length - 1))
        return lines + self._loops([target, rest], lambda at, of: f"{of[0]} = {template.format(*of)};")

    def _product(self, left: View, right: View, start: int) -> list[str]:
        """`out[i, j] = sum_k left[i, k] right[k, j]`, with loops in the order in which the right matrix is stored."""
        (rows, inner), columns = left.places.shape, right.places.shape[1]
        lines = []
        for i in range(rows):
            row, out = left.places[i], torch.arange(start + i * columns, start + (i + 1) * columns)
            a, b, at = _linear(row, ["k"]), _linear(right.places.T, ["j", "k"]), _linear(out, ["j"])
            along_columns = columns > 1 and int(right.places[0, 1] - right.places[0, 0]) == 1
            if inner >= LANES and not along_columns and a is not None and b is not None and at is not None:
                lines += self._dot(self._entry(left.buffer, a), self._entry(right.buffer, b), at, inner, columns)
                continue
            lines += self._loops([View(WORK, out)], lambda at, of: f"{of[0]} = 0;")
            target = View(WORK, out.unsqueeze(0).expand(inner, -1))
            factor = View(left.buffer, row.unsqueeze(1).expand(-1, columns))
            lines += self._loops([target, factor, right], lambda at, of: f"{of[0]} += {of[1]} * {of[2]};")
        return lines

    def _dot(self, a: str, b: str, out: str, inner: int, columns: int) -> list[str]:
        """Loops for each entry as the sum of `LANES` partial sums of products."""
        whole = inner - inner % LANES
        return [
            f"for (int j = 0; j < {columns}; j++) {{",
            f"    real s[{LANES}] = {{0}};",
            f"    for (int k0 = 0; k0 < {whole}; k0 += {LANES})",
            f"        for (int l = 0; l < {LANES}; l++) {{",
            "            const int k = k0 + l;",
            f"            s[l] += {a} * {b};",
            "        }",
            f"    for (int k = {whole}; k < {inner}; k++) s[0] += {a} * {b};",
            f"    w[{out}] = {' + '.join(f's[{lane}]' for lane in range(LANES))};",
            "}",
        ]

    def _loops(self, views: list[View], statement: Statement) -> list[str]:
        """``statement`` for each entry of ``views``, which have one shape: in loops where all places are linear."""
        shape = views[0].places.shape
        axes = [axis for axis, size in enumerate(shape) if size > 1]
        index = [f"i{axis}" for axis in axes]
        numbered = torch.arange(views[0].places.numel()).view(shape)
        places = [p.squeeze() for p in (numbered, *(view.places for view in views))]
        read = lambda at: [self._entry(view.buffer, place) for view, place in zip(views, at, strict=True)]
        rules = [rule for rule in (_linear(p, index) for p in places) if rule is not None]
        if len(rules) < len(places):
            listed = zip(*(p.flatten().tolist() for p in places), strict=True)
            return [statement(str(first), read(map(str, rest))) for first, *rest in listed]
        lines = [f"for (int {i} = 0; {i} < {shape[axis]}; {i}++)" for i, axis in zip(index, axes, strict=True)]
        return [*lines, ("    " if lines else "") + statement(rules[0], read(rules[1:]))]

    def _entry(self, buffer: int, place: str) -> str:
        """A number of ``buffer`` as a C expression, in the precision of the computation."""
        if buffer in self.labels:
            return f"R({self.labels[buffer]}[{place}])"
        if buffer in (WORK, STATE):
            return f"{'w' if buffer == WORK else 'x'}[{place}]"
        return f"(w + {self.offsets[buffer]})[{place}]"


def layout(program: Program) -> tuple[dict[int, int], int]:
    """The start of each result in one array, and the array's size: results needed at different times share room."""
    last: dict[int, int] = {}
    for number, operation in enumerate(program.operations):
        last |= {o.buffer: number for o in operation.operands if isinstance(o, View)}
    last |= {view.buffer: len(program.operations) for view in program.outputs.values()}
    taken: list[tuple[int, int, int]] = []  # start, end, last use
    offsets, space = {}, 0
    for number, operation in enumerate(program.operations):
        taken = sorted(block for block in taken if block[2] >= number)
        size, start = program.sizes[operation.buffer], 0
        for begin, end, _ in taken:
            if begin - start >= size:
                break
            start = max(start, end)
        taken.append((start, start + size, last.get(operation.buffer, number)))
        offsets[operation.buffer], space = start, max(space, start + size)
    return offsets, space


def _linear(places: Tensor, index: list[str]) -> str | None:
    """``places`` as a linear function of the loops' ``index``, one for each axis; `None` where they are not linear."""
    start = int(places.flatten()[0])
    linear, terms = torch.full_like(places, start), []
    for axis, size in enumerate(places.shape):
        step = int(places.select(axis, 1).flatten()[0]) - start if size > 1 else 0
        shape = [-1 if a == axis else 1 for a in range(places.dim())]
        linear = linear + step * torch.arange(size).view(shape)
        terms += [] if step == 0 else [index[axis] if step == 1 else f"{step} * {index[axis]}"]
    if not torch.equal(linear, places):
        return None
    return " + ".join([*terms, *([str(start)] if start or not terms else [])])


def number(value: float) -> str:
    """``value`` as a C literal, in the precision of the compilation."""
    if math.isinf(value):
        return "R(INFINITY)" if value > 0 else "R(-INFINITY)"
    return f"R({value!r})"
