"""The data of a problem that losses see: evaluations at a batch of states, and nothing that could be differentiated."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ocp_torch.compute.decisions import decided
from ocp_torch.errors import InputError

if TYPE_CHECKING:
    from ocp_torch.problems.problem import Problem


def driven(a: Tensor, B: Tensor, u: Tensor) -> Tensor:
    """The velocity `a + B u`, ``(N, d)``."""
    return a + torch.einsum("ndm,nm->nd", B, u)


@dataclass(frozen=True)
class Samples:
    """A problem's data at `N` states.

    `weight` is one over the density the states were drawn from, so that a weighted mean estimates an integral over the
    torus. `penalty_weight` is what a violated inequality weighs at each state, `None` for as much as `weight`; it may be
    above 0 where `weight` is 0. The divergences are `None` where the problem cannot give them, `noise` where there is none.
    """

    x: Tensor  # (N, d) states
    f: Tensor  # (N,) running state cost
    a: Tensor  # (N, d) drift
    B: Tensor  # (N, d, m) control matrix
    mu0: Tensor  # (N,) initial density
    weight: Tensor  # (N,) importance weight
    div_a: Tensor | None = None  # (N,) divergence of the drift
    div_B: Tensor | None = None  # (N, m) divergence of each column of B
    penalty_weight: Tensor | None = None  # (N,)
    noise: Tensor | None = None  # (N, d, k) sigma
    div_D: Tensor | None = None  # (N, d) divergence of the rows of D = sigma sigma^T / 2
    div_div_D: Tensor | None = None  # (N,) the divergence of that

    @classmethod
    @torch.no_grad()
    def of(cls, problem: "Problem", x: Tensor, divergences: bool = True, weight: Tensor | None = None) -> "Samples":
        """Evaluate ``problem`` at the states ``x`` of shape ``(N, d)``."""
        noise = problem.noise(x)
        spread = problem.noise_divergences(x) if divergences and noise is not None else None
        div_D, div_div_D = spread or (None, None)
        f, (a, B, div_a, div_B) = problem.cost_and_fields(x, divergences)
        return cls(
            x=x,
            f=f,
            a=a,
            B=B,
            mu0=problem.initial_density(x),
            weight=torch.ones_like(x[:, 0]) if weight is None else weight,
            div_a=div_a,
            div_B=div_B,
            noise=noise,
            div_D=div_D,
            div_div_D=div_div_D,
        )

    @classmethod
    def live(cls, problem: "Problem", x: Tensor) -> "Samples":
        """``problem`` at states ``x`` for functions that are differentiated in `x`: with a graph where ``x`` requires
        gradients, with `mu0` and weights of 1, and without divergences."""
        one = torch.ones_like(x[:, 0])
        with torch.set_grad_enabled(x.requires_grad and torch.is_grad_enabled()):
            f, (a, B, _, _) = problem.cost_and_fields(x, divergences=False)
            noise = problem.noise(x)
        return cls(x, f, a, B, one, one, noise=noise)

    @property
    def columns(self) -> list[Tensor | None]:
        """All columns, in the order in which `Samples` takes them."""
        return [getattr(self, f.name) for f in fields(self)]

    def __len__(self) -> int:
        return self.x.shape[0]

    def velocity(self, u: Tensor) -> Tensor:
        """`a + B u`, ``(N, d)``, under controls ``(N, m)``."""
        return driven(self.a, self.B, u)

    def mean(self, integrand: Tensor) -> Tensor:
        """The weighted mean of ``integrand`` ``(N,)``: an estimate of its integral over the torus."""
        return (self.weight * integrand).mean()

    def penalty(self, violation: Tensor) -> Tensor:
        """The mean of ``violation`` ``(N,)``, weighed by `penalty_weight`."""
        return ((self.weight if self.penalty_weight is None else self.penalty_weight) * violation).mean()

    def require_divergences(self, who: str) -> tuple[Tensor, Tensor]:
        """`div a` ``(N,)`` and `div B` ``(N, m)``; raises `InputError` that ``who`` needs them where they are missing."""
        if self.div_a is None or self.div_B is None:
            raise InputError(f"{who} needs the divergences of a and B, which this problem does not give.")
        return self.div_a, self.div_B

    @property
    def noise_divergences(self) -> tuple[Tensor, Tensor]:
        """`div D` ``(N, d)`` and `div div D` ``(N,)``; raises `InputError` where they are missing."""
        if self.div_D is None or self.div_div_D is None:
            raise InputError("the residual with noise needs the divergences of D, which this problem does not give.")
        return self.div_D, self.div_div_D

    def take(self, index: Tensor | slice) -> "Samples":
        """The samples at the rows ``index``."""
        return self._map(lambda column: column[index])

    def take_weighted(self, most: int | None = None) -> "tuple[Samples, Tensor]":
        """The first ``most`` samples with a weight above 0, and their rows; `mean` estimates the same integrals."""
        none = self.weight == 0.0
        count = len(self) - decided(none.sum())
        rows = none.sort(stable=True)[1][: count if most is None else min(count, most)]
        chosen = self.take(rows)
        return replace(chosen, weight=count / len(self) * chosen.weight, penalty_weight=None), rows

    def copied(self) -> "Samples":
        """The samples in memory of their own."""
        return self._map(torch.clone)

    def to(self, like: Tensor) -> "Samples":
        """The samples in the precision and on the device of ``like``."""
        return self._map(lambda column: column.to(like))

    def split(self, chunk: int) -> "list[Samples]":
        """The samples in pieces of at most ``chunk`` states."""
        rows = torch.arange(len(self), device=self.x.device).split(chunk)
        return [self.take(slice(int(part[0]), int(part[-1]) + 1)) for part in rows]

    @staticmethod
    def concatenate(pieces: "list[Samples]") -> "Samples":
        """All ``pieces`` as one batch."""
        columns: dict[str, Any] = {f.name: [getattr(p, f.name) for p in pieces] for f in fields(Samples)}
        columns |= {name: None if parts[0] is None else torch.cat(parts) for name, parts in columns.items()}
        return Samples(**columns)

    def _map(self, change: Callable[[Tensor], Tensor]) -> "Samples":
        """The samples with every column ``change``d."""
        columns: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        columns |= {name: change(column) for name, column in columns.items() if column is not None}
        return Samples(**columns)
