"""A `Program` as a CasADi function of one state, of which CasADi has exact derivatives of any order."""

from typing import Any

from ocp_torch.errors import InputError
from ocp_torch.export.program import STATE, Operand, Operation, Program, View


def require_casadi() -> Any:
    """The `casadi` module, or `InputError`."""
    try:
        import casadi
    except ImportError:
        raise InputError('format=casadi needs CasADi: pip install -e ".[mpc]".') from None
    return casadi


def casadi_function(program: Program, name: str) -> Any:
    """`casadi.Function` ``name`` from ``state`` ``(d,)`` to the outputs of ``program``, columns each."""
    casadi = require_casadi()
    state = casadi.MX.sym("state", program.dim)
    writer = Writer(casadi, program, state)
    outputs = [writer.entries(view) for view in program.outputs.values()]
    return casadi.Function(name, [state], outputs, ["state"], list(program.outputs))


class Writer:
    """The operations as expressions of ``state``; each buffer is a column."""

    def __init__(self, casadi: Any, program: Program, state: Any) -> None:
        self.casadi, self.program = casadi, program
        self.columns = {STATE: state} | {b: casadi.DM(c) for b, c in program.constants.items()}
        for operation in program.operations:
            self.columns[operation.buffer] = self._result(operation)

    def entries(self, view: View) -> Any:
        """The entries of ``view``, in row-major order, as a column."""
        column = self.columns[view.buffer]
        return column if view.whole(self.program.sizes[view.buffer]) else self.casadi.vec(column[view.flat])

    def _operand(self, operand: Operand) -> Any:
        return self.entries(operand) if isinstance(operand, View) else operand

    def _matrix(self, view: View) -> Any:
        rows, columns = view.places.shape
        # CasADi stores matrices by columns, a view by rows.
        return self.casadi.reshape(self.entries(View(view.buffer, view.places.T.contiguous())), rows, columns)

    def _result(self, operation: Operation) -> Any:
        casadi, name, operands = self.casadi, operation.name, operation.operands
        if name == "cat":
            return casadi.vertcat(*(self._operand(o) for o in operands))
        if name == "matmul":
            product = casadi.mtimes(self._matrix(operands[0]), self._matrix(operands[1]))  # type: ignore[arg-type]
            return casadi.reshape(product.T, -1, 1)
        if name in ("sum", "max", "min"):
            return self._reduced(name, operands[0])  # type: ignore[arg-type]
        return self._entrywise()[name](*(self._operand(o) for o in operands))

    def _reduced(self, name: str, rows: View) -> Any:
        casadi = self.casadi
        if name == "sum":
            return casadi.sum2(self._matrix(rows))
        pick = self._entrywise()["maximum" if name == "max" else "minimum"]
        first, *rest = (self.entries(View(rows.buffer, rows.places[:, k])) for k in range(rows.places.shape[1]))
        for column in rest:
            first = pick(first, column)
        return first

    def _picked(self, first: Any, second: Any, above: Any, below: Any) -> Any:
        """``first`` where ``above`` holds, ``second`` where ``below`` holds, NaN where neither does: one of them is then NaN.

        CasADi's own `fmax` and `fmin` drop NaN, and it simplifies `x != x` to 0."""
        casadi = self.casadi
        return casadi.if_else(above, first, casadi.if_else(below, second, first + second))

    def _entrywise(self) -> dict[str, Any]:
        casadi = self.casadi
        named = {
            n: getattr(casadi, n)
            for n in "sin cos tan exp log tanh erf sqrt floor atan asin acos sinh cosh atan2".split()
        }
        return named | {
            "abs": casadi.fabs,
            "neg": lambda a: -a,
            "add": lambda a, b: a + b,
            "sub": lambda a, b: a - b,
            "mul": lambda a, b: a * b,
            "div": lambda a, b: a / b,
            "pow": casadi.power,
            "maximum": lambda a, b: self._picked(a, b, a >= b, a < b),
            "minimum": lambda a, b: self._picked(a, b, a <= b, a > b),
            "eq": lambda a, b: a == b,
            "ne": lambda a, b: a != b,
            "lt": lambda a, b: a < b,
            "le": lambda a, b: a <= b,
            "gt": lambda a, b: a > b,
            "ge": lambda a, b: a >= b,
            "where": casadi.if_else,
        }
