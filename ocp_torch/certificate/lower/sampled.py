"""`V` at sampled states, which the lower bounds of one `V` share."""

import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.lower.levels import best_level
from ocp_torch.certificate.lower.mollified import mollified_shift
from ocp_torch.certificate.lower.shifted import Shift, highest
from ocp_torch.certificate.lower.slack import SlackParts
from ocp_torch.certificate.lower.tightened import tightened
from ocp_torch.compute.background import BackgroundResult
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.jets import Field
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# Part of the bound that training for it must promise: .39 and .85 % were promised of two arms, .51 and 1.0 % came.
LEAST_PROMISE = 0.0006
# That part with noise: 1.1 to 7.3 % were promised of two dubins and a unicycle, and 1.2 to 7.5 % came.
NOISY_LEAST_PROMISE = 0.005
LARGEST_PART = 0.01  # of the torus, with the largest slacks: their mean stands for the supremum in that promise


class BestShift(NamedTuple):
    """The best ``shift``, and the ``subsolution`` that it is made of, `None` where that is `V`."""

    shift: Shift
    subsolution: Subsolution | None = None


@dataclass(frozen=True)
class SampledValue:
    """``value`` `V` on ``sets`` of samples of ``problem``; each part is computed when it is first asked for.

    Suprema of its slack are climbed from the ``ascents`` worst states, those ``odd`` ``(K, d)`` included, and where they are
    ``sought`` in steep places too. With ``search`` the shifted bound is sought among functions made of `V`, which takes many
    times as long: `V` trained on for that bound (`tightened`, by ``steps`` on states of ``seed``; or one that was ``kept``
    from before), and averages over neighbours of the better of the two (`mollified`). With noise, which rounds kinks, no
    averages are tried: on dubins they gave 0.1 to 0.3 % of OPT more, for a tenth of a run's time.
    """

    problem: Problem
    value: Field
    sets: list[Samples]
    ascents: int = 32
    search: bool = False
    seed: int = 0
    odd: Tensor | None = None
    kept: Subsolution | None = None
    steps: int | None = None
    sought: bool = True

    @cached_property
    def own(self) -> Shift:
        """The shifted bound of the best multiple of `V` itself."""
        odd = self.odd
        beside = [] if odd is None or not len(odd) else [Samples.of(self.problem, odd, divergences=False)]
        return Shift(self.problem, self.value, self.sets, self.ascents, beside, sought=self.sought)

    @property
    def initial(self) -> list[float]:
        """`E[V mu0]`, per set."""
        return self.own.initial

    @property
    def best(self) -> Shift:
        """The shifted bound of `V` itself, or of a function made of it where that is higher."""
        return self._best.answer().shift

    @property
    def subsolution(self) -> Subsolution | None:
        """`V` trained on for its bound, where the `best` is of it or of an average of it; else `None`."""
        return self._best.answer().subsolution

    def ahead(self, job: BackgroundResult | None = None) -> contextlib.AbstractContextManager[None]:
        """A context in which another core does ``job``, by default the search for the `best`, if there is one."""
        job = job or (self._best if self.search else None)
        if job is None:
            return contextlib.nullcontext()
        _ = self.initial  # needed at once, beside that job
        return job.ahead(self.problem.copyable)

    @cached_property
    def _best(self) -> BackgroundResult[BestShift]:
        return BackgroundResult(self._found, self.problem, self.value, *self.sets)

    @cached_property
    def tightened(self) -> BackgroundResult[Subsolution | None]:
        """`V` trained on for its bound; `None` where that promises too little."""
        return BackgroundResult(self._trained_on, self.problem)

    def _trained_on(self) -> Subsolution | None:
        if not worth(self.own, NOISY_LEAST_PROMISE if self.problem.noisy else LEAST_PROMISE):
            return None
        batch = len(self.sets[0])  # states a step: a small certificate trains on few
        return tightened(self.problem, self.value, self.seed, batch, self.steps)

    def _found(self) -> BestShift:
        if not self.search:
            return BestShift(self.own)
        best, W = self.own, self.kept
        if W is None:
            W = self._trained_on()
        if W is not None:
            beside = [*self.own.beside, *([self.problem.samples(W.worst, divergences=False)] if len(W.worst) else [])]
            best = highest([self.own, replace(self.own, value=W.network, name="V tightened", beside=beside)])
        used = None if best is self.own else W
        return BestShift(best if self.problem.noisy else mollified_shift(best), used)


def worth(shift: Shift, least: float) -> bool:
    """Whether the bound may rise to what is `attainable` by more than its part ``least``."""
    most = attainable(shift)
    lacks = lambda scaling: most - scaling.bound > least * abs(scaling.bound)
    return lacks(shift.looked) or lacks(shift.found)  # what is found in steep places only adds to it


def attainable(shift: Shift) -> float:
    """The bound with the mean of the largest slacks in place of their supremum, nearly what training maximises: a bound that
    is as high has no spike left to remove."""
    weights = torch.cat([samples.weight for samples in shift.sets])
    mean = sum(shift.initial) / len(shift.initial)
    return best_level(SlackParts.join(shift.parts), weights, mean, 1.0 / LARGEST_PART)[2]
