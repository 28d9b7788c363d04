"""A problem given by one plain function, somebody's simulator: a black box that is asked, and never differentiated."""

from collections import abc

import torch
from torch import Tensor

from ocp_torch.errors import require_flag
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.simulator.oracle import Oracle

# Half the distance of the two states of a difference quotient, where the oracle computes in double or in single precision:
# near the cube root of its rounding, which balances what rounding and what curvature cost.
STEP, COARSE_STEP = 1e-5, 2e-3
# States scanned for narrow features for each at which a bound is evaluated, where the oracle takes batches.
SCAN_FACTOR = 8


class Simulator(Problem):
    """``target`` maps states, arrays ``(N, d)`` in `[0, 1)`, to `f` ``(N,)``, `a` ``(N, d)`` (or `None` for no drift) and `B`
    ``(N, d, m)``, as NumPy arrays, and, if it likes, to the initial density `mu0` ``(N,)`` as well; or one state ``(d,)`` to
    a number, ``(d,)`` and ``(d, m)``: which of the two is found out by asking.

    ``target`` is module:function, FILE.py:function or the function itself. Without ``differences`` there are no divergences
    of `a` and `B`, and what needs them is left out; with them they come from central differences, which takes `2 d` more
    calls a state wherever they are wanted. ``workers`` processes share each batch (the target must then be named, not
    given). Raises `InputError`, with the state, where the function fails, gives another shape or a number that is not
    finite, is not a function of the state alone, or jumps where a coordinate passes from 1 to 0.
    """

    incidental = ("target", "differences", "workers")

    def __init__(
        self,
        target: str | abc.Callable,
        dim: int,
        control_dim: int | None = None,
        discount: float = 2.0,
        exponent: float = 2.0,
        control_limit: float | None = None,
        differences: bool = False,
        workers: int = 1,
    ) -> None:
        super().__init__(dim, control_dim, discount, exponent, control_limit)
        self.target = target
        self.differences = require_flag("problem.differences", differences)
        self.workers = workers
        self._oracle = Oracle(target, self.dim, self.control_dim, workers)
        self._step = COARSE_STEP if self._oracle.in_float32 else STEP

    @property
    def scan_factor(self) -> int:
        """None where each state is a call of its own."""
        return 0 if self._oracle.one_by_one or self.workers > 1 else SCAN_FACTOR

    @property
    def driftless(self) -> bool:
        return self._oracle.driftless

    @property
    def gives_divergences(self) -> bool:
        return self.differences

    def state_cost(self, x: Tensor) -> Tensor:
        return _Ask.apply(x, self, "f")

    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x) if self._oracle.driftless else _Ask.apply(x, self, "a")

    def control_matrix(self, x: Tensor) -> Tensor:
        return _Ask.apply(x, self, "B")

    def initial_density(self, x: Tensor) -> Tensor:
        return _Ask.apply(x, self, "mu0") if self._oracle.gives_mu0 else torch.ones_like(x[:, 0])

    def drift_divergence(self, x: Tensor) -> Tensor | None:
        return self._divergences(x)[0] if self.differences else None

    def control_divergence(self, x: Tensor) -> Tensor | None:
        return self._divergences(x)[1] if self.differences else None

    @torch.no_grad()
    def _divergences(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`div a` and `div B` by central differences, all `2 d` shifted batches in one call."""
        at = _unit_cell(x)
        if "divergences" not in (kept := self._oracle.answers(at)):
            moves = self._step * torch.eye(self.dim, dtype=torch.float64)
            shifted = torch.cat([at + s * e for e in moves for s in (1.0, -1.0)]).remainder(1.0)
            found = self._oracle.checked(shifted)
            slopes = lambda v: (v[:, 0] - v[:, 1]) / (2.0 * self._step)  # (d, N, ...)
            a = slopes(found["a"].unflatten(0, (self.dim, 2, len(at))))
            B = slopes(found["B"].unflatten(0, (self.dim, 2, len(at))))
            kept["divergences"] = torch.einsum("ini->n", a), torch.einsum("inik->nk", B)
        return tuple(part.to(x) for part in kept["divergences"])


class _Ask(torch.autograd.Function):
    """One part of the oracle's answer: values by calling, derivatives by central differences; stacks flattened."""

    @staticmethod
    def forward(x: Tensor, problem: Simulator, name: str) -> Tensor:
        return problem._oracle.answers(_unit_cell(x))[name].to(x)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        x, ctx.problem, ctx.name = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def jvp(ctx, tangent: Tensor, *_) -> Tensor:
        (x,) = ctx.saved_tensors
        return _difference(ctx.problem, ctx.name, x, tangent)

    @staticmethod
    def backward(ctx, outward: Tensor):
        (x,) = ctx.saved_tensors
        if not ctx.problem.differences:
            return torch.zeros_like(x), None, None  # an ascent then follows the networks alone
        basis = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        slopes = [outward * _difference(ctx.problem, ctx.name, x, e.expand_as(x)) for e in basis]
        return torch.stack([s.reshape(len(x), -1).sum(dim=-1) for s in slopes], dim=-1), None, None

    @staticmethod
    def vmap(info, in_dims, x: Tensor, problem: Simulator, name: str):
        if in_dims[0] is None:
            return _Ask.apply(x, problem, name), None
        x = x.movedim(in_dims[0], 0)
        return _Ask.apply(x.flatten(0, 1), problem, name).unflatten(0, x.shape[:2]), 0


def _unit_cell(x: Tensor) -> Tensor:
    return x.detach().cpu().double().remainder(1.0)


def _difference(problem: Simulator, name: str, x: Tensor, direction: Tensor) -> Tensor:
    step, x64, along = problem._step, x.double(), direction.double()
    ahead, behind = (_Ask.apply(x64 + s * step * along, problem, name) for s in (1.0, -1.0))
    return ((ahead - behind) / (2.0 * step)).to(direction)
