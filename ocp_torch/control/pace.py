"""The pace of a problem: how long a control is held, whatever the unit of time."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from ocp_torch.fields.fields import typical_sizes
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems import Problem
from ocp_torch.problems.starts import drawn_starts

# A control is held for the shortest of three times.
LARGEST_TIME_PART = 0.04  # of `1 / rho`
LARGEST_MOVE = 0.08  # in turns, by half of all states: with a quarter of it a pendubot took 160 s in place of 50
# Part of the response time `1 / |lambda|`, by the largest eigenvalue of the linearisation, at nine starts in ten: with 0.3 a
# limited pendulum lost at upright, from round to round, what it had won.
RESPONSE_PART = 0.2
# A Runge-Kutta step is at most this part of the time in which neighbours part `e`-fold, at nine states in ten: its error is
# then 0.4 % of that, `e` less its Taylor polynomial (the certificate takes finer steps where that shows).
DIVERGENCE_PART = 1.0
QUANTILE = 0.9  # the nine in ten
MOST_SUBSTEPS = 8
PROBED_STATES = 2**11
PROBED_STARTS = 2**8
OFFSET = 1e-3  # of neighbours, in turns


@dataclass(frozen=True)
class Pace:
    """A control is held for ``step`` units of time, which Runge-Kutta takes in ``substeps``."""

    step: float
    substeps: int

    @classmethod
    def of(cls, problem: Problem) -> "Pace":
        """The pace of ``problem``, measured by thousands of evaluations when it is first asked for."""
        if problem not in _found:
            _found[problem] = cls._measured(problem)
        return _found[problem]

    @classmethod
    @torch.no_grad()
    def _measured(cls, problem: Problem) -> "Pace":
        """The pace under controls of typical size within the limits, at states spread over the torus and at starts."""
        generator = fixed_generator()
        draw = lambda n, by=torch.randn: by(PROBED_STATES, n, dtype=torch.float64, generator=generator)
        x = draw(problem.dim, torch.rand)
        away, u = (torch.nn.functional.normalize(draw(n), dim=-1) for n in (problem.dim, problem.control_dim))
        u = problem.control_cost.within(typical_sizes(problem)[1] * u, torch.ones_like(x[:, 0]))
        velocity = problem.velocity(x, u)
        parting = (problem.velocity(x + OFFSET * away, u) - velocity).norm(dim=-1) / OFFSET
        speed, rate = float(velocity.norm(dim=-1).median()), float(parting.quantile(QUANTILE))
        answers = _largest_eigenvalues(problem, drawn_starts(problem, PROBED_STARTS, 0), u[:PROBED_STARTS]).quantile(
            QUANTILE
        )
        most = LARGEST_MOVE / max(speed, 1e-300), RESPONSE_PART / max(float(answers), 1e-300)
        step = min(LARGEST_TIME_PART / problem.discount, *most)
        return cls(step, min(max(1, math.ceil(step * rate / DIVERGENCE_PART)), MOST_SUBSTEPS))

    def with_step(self, step: float) -> "Pace":
        """Steps of another length, in substeps as short as these."""
        return Pace(step, min(math.ceil(self.substeps * max(1.0, step / self.step)), MOST_SUBSTEPS))

    def move(self, problem: Problem, x: Tensor, u: Tensor) -> Tensor:
        """The moves of states ``(N, d)`` in a step under held controls ``u`` ``(N, m)``, without noise: not their ends, since
        the difference of two moves has more digits."""
        return self._moved(x, lambda y: problem.velocity(y, u))

    def drift(self, problem: Problem, x: Tensor) -> Tensor:
        """The moves of states ``(N, d)`` in a step without control."""
        return torch.zeros_like(x) if problem.driftless else self._moved(x, problem.drift)

    def _moved(self, x: Tensor, velocity: Callable[[Tensor], Tensor]) -> Tensor:
        h, moved = self.step / self.substeps, torch.zeros_like(x)
        for _ in range(self.substeps):
            at = x + moved
            v1 = velocity(at)
            v2 = velocity(at + 0.5 * h * v1)
            v3 = velocity(at + 0.5 * h * v2)
            v4 = velocity(at + h * v3)
            moved = moved + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)
        return moved


def _largest_eigenvalues(problem: Problem, x: Tensor, u: Tensor) -> Tensor:
    """The largest modulus ``(N,)`` of the eigenvalues of the linearisation at states ``(N, d)`` under controls ``(N, m)``,
    which does not depend on the units of coordinates."""
    moved = lambda e: problem.velocity(x + OFFSET * e, u) - problem.velocity(x - OFFSET * e, u)
    columns = [moved(e) / (2.0 * OFFSET) for e in torch.eye(problem.dim, dtype=x.dtype)]
    return torch.linalg.eigvals(torch.stack(columns, dim=-1)).abs().amax(dim=-1)


_found: WeakKeyDictionary[Problem, Pace] = WeakKeyDictionary()
