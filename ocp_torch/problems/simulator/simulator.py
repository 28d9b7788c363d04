"""A problem given by one plain function, somebody's simulator: a black box that is asked, and never differentiated."""

from collections import abc

import torch
from torch import Tensor

from ocp_torch.errors import require_flag
from ocp_torch.maths.differences import STEPS, Differenced
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.simulator.oracle import Oracle

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
        self._step = STEPS[torch.float32 if self._oracle.in_float32 else torch.float64]

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

    def _part(self, name: str, x: Tensor) -> Tensor:
        """One part of the answers; without differences an ascent follows the networks alone."""
        answer = lambda at: self._oracle.answers(_unit_cell(at))[name].to(at)
        return Differenced.apply(x, answer, self._step, self.differences)

    def state_cost(self, x: Tensor) -> Tensor:
        return self._part("f", x)

    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x) if self._oracle.driftless else self._part("a", x)

    def control_matrix(self, x: Tensor) -> Tensor:
        return self._part("B", x)

    def initial_density(self, x: Tensor) -> Tensor:
        return self._part("mu0", x) if self._oracle.gives_mu0 else torch.ones_like(x[:, 0])

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


def _unit_cell(x: Tensor) -> Tensor:
    return x.detach().cpu().double().remainder(1.0)
