"""How fast a problem moves: for how long a control is held, whatever the unit of time."""

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

# A step is at most this part of `1 / rho`, and in it half of all states move by no more than this part of a turn: the control
# is held that long. With a quarter of the way a pendubot took 160 s to a cost that it now has after 50.
DISCOUNTED, MOVED = 0.04, 0.08
# Nor longer than this part of the time in which the system answers, at nine starts in ten: `1 / |lambda|` of the largest
# eigenvalue of its linearisation. With 0.3 a limited pendulum lost at upright what it had won, from round to round; with 0.17
# a cart-pole, with 0.2 a pendubot and with 0.26 an acrobot stood.
ANSWERED = 0.2
# A Runge-Kutta step is at most this part of the time in which neighbours part `e`-fold, at nine states in ten (the error is
# then 0.4 % of that, `e` less its Taylor polynomial; the certificate takes finer steps where that shows); so many at most.
PARTED, NEARLY_ALL, MOST_SUBSTEPS = 1.0, 0.9, 8
# States, and starts, at which that is looked at, and how far apart neighbours are, in turns.
PROBED, STARTS, APART = 2**11, 2**8, 1e-3


@dataclass(frozen=True)
class Pace:
    """A control is held for ``step`` units of time, which Runge-Kutta takes in ``substeps``."""

    step: float
    substeps: int

    @classmethod
    def of(cls, problem: Problem) -> "Pace":
        """That of ``problem``, measured when it is first asked for: that takes thousands of evaluations."""
        if problem not in _found:
            _found[problem] = cls._measured(problem)
        return _found[problem]

    @classmethod
    @torch.no_grad()
    def _measured(cls, problem: Problem) -> "Pace":
        """Under controls of its typical size, and within its limits, at states spread over the torus and at starts."""
        generator = fixed_generator()
        draw = lambda n, by=torch.randn: by(PROBED, n, dtype=torch.float64, generator=generator)
        x = draw(problem.dim, torch.rand)
        away, u = (torch.nn.functional.normalize(draw(n), dim=-1) for n in (problem.dim, problem.control_dim))
        u = problem.control_cost.within(typical_sizes(problem)[1] * u, torch.ones_like(x[:, 0]))
        velocity = problem.velocity(x, u)
        parting = (problem.velocity(x + APART * away, u) - velocity).norm(dim=-1) / APART
        speed, rate = float(velocity.norm(dim=-1).median()), float(parting.quantile(NEARLY_ALL))
        answers = _largest_eigenvalues(problem, drawn_starts(problem, STARTS, 0), u[:STARTS]).quantile(NEARLY_ALL)
        most = MOVED / max(speed, 1e-300), ANSWERED / max(float(answers), 1e-300)
        step = min(DISCOUNTED / problem.discount, *most)
        return cls(step, min(max(1, math.ceil(step * rate / PARTED)), MOST_SUBSTEPS))

    def with_step(self, step: float) -> "Pace":
        """Steps of another length, in substeps as short as these."""
        return Pace(step, min(math.ceil(self.substeps * max(1.0, step / self.step)), MOST_SUBSTEPS))

    def move(self, problem: Problem, x: Tensor, u: Tensor) -> Tensor:
        """How far states ``(N, d)`` move in a step under held controls ``u`` ``(N, m)``, without noise: moves, not states,
        as the difference of two moves has more digits."""
        return self._moved(x, lambda y: problem.velocity(y, u))

    def drift(self, problem: Problem, x: Tensor) -> Tensor:
        """The same without control."""
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
    """The largest modulus ``(N,)`` of the eigenvalues of the linearisation at states ``(N, d)`` under controls ``(N, m)``:
    the same in whatever units coordinates are."""
    moved = lambda e: problem.velocity(x + APART * e, u) - problem.velocity(x - APART * e, u)
    columns = [moved(e) / (2.0 * APART) for e in torch.eye(problem.dim, dtype=x.dtype)]
    return torch.linalg.eigvals(torch.stack(columns, dim=-1)).abs().amax(dim=-1)


_found: WeakKeyDictionary[Problem, Pace] = WeakKeyDictionary()
