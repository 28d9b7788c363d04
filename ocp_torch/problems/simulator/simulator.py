"""A problem given by one plain function, a simulator: a black box that is evaluated, and never differentiated."""

from collections import abc

import torch
from torch import Tensor

from ocp_torch.errors import require_flag
from ocp_torch.maths.differences import SECOND_STEPS, STEPS, Differenced, spread_divergences
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.simulator.oracle import Oracle

# Where the oracle takes batches: states scanned for narrow features for each state at which a bound is evaluated.
SCAN_FACTOR = 8


class Simulator(Problem):
    """``target`` maps states, arrays ``(N, d)`` in `[0, 1)`, to `f` ``(N,)``, `a` ``(N, d)`` (or `None` for no drift) and `B`
    ``(N, d, m)``, as NumPy arrays, and, if it likes, after these to the initial density `mu0` ``(N,)``, to the noise `sigma`
    ``(N, d, k)``, or to both in this order; or one state ``(d,)`` to a number, ``(d,)``, ``(d, m)``, a number and ``(d, k)``:
    which of the two is found out by asking.

    ``target`` is module:function, FILE.py:function or the function itself. Without ``differences`` there are no divergences
    of `a`, `B` and `D = sigma sigma^T / 2`, and what needs them is left out; with them they come from central differences,
    which takes `2 d` more calls a state wherever they are wanted, and with noise `2 d (d + 1)` more than that. ``noise`` is
    that of `Problem`, beside `sigma`. ``workers`` processes share each batch (the target must then be named, not given).
    Raises `InputError`, with the state, where the function fails, gives another shape or a number that is not finite, is
    not a function of the state alone, or jumps where a coordinate passes from 1 to 0.
    """

    incidental = ("target", "differences", "workers")

    def __init__(
        self,
        target: str | abc.Callable,
        dim: int,
        control_dim: int | None = None,
        discount: float = 2.0,
        exponent: float = 2.0,
        control_limit: Limit = None,
        differences: bool = False,
        workers: int = 1,
        noise: float | abc.Sequence[float] = 0.0,
    ) -> None:
        super().__init__(dim, control_dim, discount, exponent, control_limit, noise)
        self.target = target
        self.differences = require_flag("problem.differences", differences)
        self.workers = workers
        self._oracle = Oracle(target, self.dim, self.control_dim, workers)
        precision = torch.float32 if self._oracle.in_float32 else torch.float64
        self._step, self._wide_step = STEPS[precision], SECOND_STEPS[precision]

    @property
    def scan_factor(self) -> int:
        """0 where each state is a call of its own, or workers share the batch: such evaluations are dear."""
        return 0 if self._oracle.one_by_one or self.workers > 1 else SCAN_FACTOR

    @property
    def concurrent(self) -> bool:
        """False: the function may keep a state of its own."""
        return False

    @property
    def copyable(self) -> bool:
        """False: the function may use other processes, as its ``workers`` are."""
        return False

    @property
    def driftless(self) -> bool:
        return self._oracle.driftless

    @property
    def unknown_divergences(self) -> str:
        return "" if self.differences else "a and B and D" if self._oracle.motions else "a and B"

    @property
    def noisy(self) -> bool:
        return self.diffusion is not None or self._oracle.motions > 0

    def _part(self, name: str, x: Tensor) -> Tensor:
        """The part ``name`` of the answers; without differences it has derivative 0, so that ascents follow the networks."""
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

    def noise(self, x: Tensor) -> Tensor | None:
        even = super().noise(x)
        if not self._oracle.motions:
            return even
        own = self._part("sigma", x)
        return own if even is None else torch.cat([even, own], dim=-1)

    def drift_divergence(self, x: Tensor) -> Tensor | None:
        return self._divergences(x)[0] if self.differences else None

    def control_divergence(self, x: Tensor) -> Tensor | None:
        return self._divergences(x)[1] if self.differences else None

    @torch.no_grad()
    def noise_divergences(self, x: Tensor) -> tuple[Tensor, Tensor] | None:
        if not self._oracle.motions:
            return torch.zeros_like(x), torch.zeros_like(x[:, 0])
        if not self.differences:
            return None
        at = _unit_cell(x)
        if "spread" not in (kept := self._oracle.answers(at)):
            ask = lambda y: self._oracle.checked(y.remainder(1.0))["sigma"]
            kept["spread"] = spread_divergences(ask, at, kept["sigma"], self._wide_step)
        return tuple(part.to(x) for part in kept["spread"])

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
