"""The paths of one simulation, followed to their ends: along smooth trajectories, with noise, and where a control is held."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, cast

import torch
from torch import Tensor

from ocp_torch.certificate.simulated.between import jumped_over
from ocp_torch.certificate.simulated.held import held_integrals
from ocp_torch.certificate.simulated.loops import FeedbackLoop, HeldLoop, Loop, Sliding
from ocp_torch.certificate.simulated.steps import Steps
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.compute.threads import in_pieces
from ocp_torch.maths.brownian import Grid, Multilevel, at_random_times, discounted
from ocp_torch.maths.jets import Field
from ocp_torch.maths.runge_kutta import (
    AUDITED,
    MAX_DOUBLINGS,
    Integrate,
    discounted_integral,
    in_finer_steps,
    rate_at,
    refined,
)
from ocp_torch.maths.seeds import Branch, derive_seed

FINER = 8  # factor on the steps where the usual ones jump over a wall: one a hundredth of a turn thick is then met
FINER_DOUBLINGS = MAX_DOUBLINGS - 3  # the finest are then as fine as elsewhere


class Followed(NamedTuple):
    """``results`` ``(N,)`` and ``ends`` ``(N, k)`` of paths; the ``refinement`` ``(replicates,)`` that finer steps add to the
    mean of each replicate; a bound on the ``error`` of the mean; and the ``wall`` that steps jumped over, in words."""

    results: Tensor
    ends: Tensor
    refinement: Tensor
    error: float
    wall: str


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths of ``loop`` from ``state`` ``(N, k)``, ``replicates`` sets one after the other, each of which stands for some
    ``mass`` ``(N,)``. A path ends at its own of ``times`` ``(N,)``, or where the ``steps`` do.

    ``quick`` is the loop in single precision, or ``loop`` itself. Steps are halved until a trajectory changes by less than
    ``allowed``, without noise ``doublings`` times at most. Paths are followed ``together`` on all cores where the loop is
    pure. ``rounding`` is the error of single precision, added where paths are not ``audited``. ``value`` is the control
    variate at both ends of pieces where a control is held.
    """

    loop: Loop
    quick: Loop
    steps: Steps
    state: Tensor
    mass: Tensor
    replicates: int
    times: Tensor | None
    allowed: float
    seed: int
    together: bool
    doublings: int
    audited: bool
    rounding: float
    value: Field | None

    def followed(self) -> Followed:
        """Follow all paths to their ends."""
        if self.loop.problem.noisy:
            return self._with_noise()
        if isinstance(self.loop, HeldLoop) and isinstance(self.quick, HeldLoop):
            return self._held(self.loop, self.quick)
        return self._smooth()

    def from_states(self, x: Tensor, allowed: float) -> Tensor:
        """The results ``(N,)`` of trajectories from an even number of other states ``x`` ``(N, d)``, without an audit; steps
        are halved until they change by less than ``allowed``."""
        state = self.loop.start(x)
        steps = Steps.of(self.loop, self.steps.horizon, self.loop(state)[0][:, : x.shape[1]])
        mass, allowed = torch.ones_like(x[:, 0]), max(allowed, self.allowed)
        alike = replace(self, steps=steps, state=state, mass=mass, replicates=2, allowed=allowed, audited=False)
        return alike.followed().results

    @cached_property
    def sliding(self) -> Sliding | None:
        """Which paths slide; `None` where the loop has no coordinate that shows it."""
        shown = isinstance(self.loop, FeedbackLoop) and self.loop.summed
        return Sliding(len(self.mass), self.allowed) if shown else None

    def means(self, results: Tensor) -> Tensor:
        """The means ``(replicates,)`` by mass of ``results`` ``(N,)``, one for each replicate."""
        return (self.mass * results).unflatten(0, (self.replicates, -1)).mean(dim=1)

    def rates(self, ends: Tensor) -> Tensor:
        """The rates of the loop at ``ends`` ``(N, k)``, corrected as results are where paths slide."""
        rates = self.loop(ends)[1]
        return rates if self.sliding is None else self.sliding.corrected(rates, torch.arange(len(rates)))

    @property
    def _no_refinement(self) -> Tensor:
        """0 for each replicate: without noise the results themselves are on the finest steps."""
        return torch.zeros(self.replicates, dtype=self.mass.dtype)

    @property
    def _is_rounded(self) -> bool:
        return self.quick is not self.loop

    @cached_property
    def _generator(self) -> torch.Generator:
        return torch.Generator().manual_seed(derive_seed(self.seed, Branch.AUDIT))

    def _wall(self, taken: Tensor | int) -> str:
        """What paths jumped over that have ``taken`` so many steps, in words."""
        taken = torch.as_tensor(taken).expand(len(self.mass))
        return jumped_over(self.quick, self.steps, self.state, taken, self.seed) if self.audited else ""

    def _with_noise(self) -> Followed:
        rho, steps, times = self.loop.problem.discount, self.steps, self.times
        if times is None:
            grid, weight = Grid(torch.full_like(self.mass, steps.horizon), steps.count, steps.grading), discounted(rho)
        else:
            grid, weight = Grid(times, steps.count, 1.0), at_random_times(rho)
        paths = Multilevel(
            dynamics=steps.taken_by(self.quick),
            noise=self.loop.noise,
            x0=self.state,
            weights=self.mass,
            replicates=self.replicates,
            grid=grid,
            weight=weight,
            seed=self.seed,
            together=self.together,
        )
        exact = steps.taken_by(self.loop) if self._is_rounded else None
        results, refinement, ends, error, finest = paths.mean(self.allowed, exact)
        worth = 0.0 if self.value is None else self.value(self.state[:, : self.loop.problem.dim])
        return Followed(results - worth, ends, refinement, error, self._wall(finest))

    def _held(self, loop: HeldLoop, quick: HeldLoop) -> Followed:
        results, ends, error = held_integrals(
            loop,
            quick,
            self.value,
            self.state,
            self.mass,
            replicates=self.replicates,
            horizon=self.steps.horizon,
            tolerance=self.allowed,
            generator=self._generator,
            together=self.together,
        )
        return Followed(results, ends, self._no_refinement, error, self._wall(self.steps.count))

    def _smooth(self) -> Followed:
        """Follow smooth trajectories; once more, on finer steps, where the usual ones jump over a wall."""
        followed = self._refined(self.steps.count, self.doublings)
        if followed.wall and self.doublings == MAX_DOUBLINGS:
            followed = self._refined(FINER * self.steps.count, FINER_DOUBLINGS)
        # Rounding alone must not look like a contradiction.
        return followed._replace(
            error=followed.error + (self.rounding if self._is_rounded and not self.audited else 0.0)
        )

    def _refined(self, steps: int, doublings: int) -> Followed:
        error = lambda results: Estimate.of(self.means(results).tolist()).se
        audit = self._integrated(self.loop) if self._is_rounded else None
        how = self.allowed, self._generator, error, audit, doublings, AUDITED if self.audited else 0
        results, ends, off, taken = refined(self._integrated(self.quick), self.mass, steps, *how)
        return Followed(results, ends, self._no_refinement, off, self._wall(taken))

    def _integrated(self, by: Loop) -> Integrate:
        """The integration of some of the paths of the loop ``by``, in a number of steps."""
        rho, steps, state, times = by.problem.discount, self.steps, self.state, self.times

        def some(rows: Tensor, count: int) -> tuple[Tensor, Tensor]:
            if times is not None:
                return rate_at(by, state[rows], rho, times[rows], count, wrap=False)
            return discounted_integral(by, state[rows], rho, steps.horizon, count, wrap=False, grading=steps.grading)

        finer = in_finer_steps(some, steps.multiples)
        pieces = lambda rows, count: in_pieces(lambda n: finer(n, count), rows, self.together, long=True)
        all_rows = lambda rows, count: cast(tuple[Tensor, Tensor], pieces(rows, count))
        return all_rows if self.sliding is None else self.sliding.by(all_rows)
