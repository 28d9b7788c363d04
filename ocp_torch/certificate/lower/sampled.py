"""`V` at sampled states: what the lower bounds of one `V` share."""

import contextlib
from collections.abc import Generator, Iterator
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
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.ahead import Ahead
from ocp_torch.maths.jets import Field
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# Training for the bound is worth it where that part of it is to gain: without noise, where gaps are narrow, and with it. Of
# two arms .39 and .85 % were to gain, and it gave .51 and 1.0 %; two dubins and a unicycle with noise had 1.1 to 7.3 %, of
# which it gave 1.2 to 7.5 %, and .2 to .35 % after it.
WORTH, NOISY_WORTH = 0.0006, 0.005
# What is to gain is seen by the mean of the slack over its largest part of the torus, a hundredth, in place of its supremum.
LARGEST_PART = 0.01


class Found(NamedTuple):
    """The best ``shift``, and the ``subsolution`` that it is made of, unless that is `V`."""

    shift: Shift
    subsolution: Subsolution | None = None


@dataclass(frozen=True)
class SampledValue:
    """``value`` `V` on ``sets`` of samples of ``problem``; each part is computed when it is first asked for.

    Suprema of its slack are climbed from the ``ascents`` worst states, and sought at the states ``odd`` ``(K, d)`` too. With
    ``search`` the shifted bound is sought among functions made of `V`, which takes many times as long: `V` trained on for
    that bound (`tightened`, by ``steps`` on states of ``seed``; or one that was ``kept`` from before), and averages over
    neighbours of the better of the two (`mollified`).
    With noise kinks are rounded, and no averages are tried: on dubins they gave 0.1 to 0.3 % of OPT more, for a tenth of a
    run's time.
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

    @cached_property
    def own(self) -> Shift:
        """The shifted bound of the best multiple of `V` itself."""
        odd = self.odd
        beside = [] if odd is None or not len(odd) else [Samples.of(self.problem, odd, divergences=False)]
        return Shift(self.problem, self.value, self.sets, self.ascents, beside)

    @property
    def initial(self) -> list[float]:
        """`E[V mu0]`, per set."""
        return self.own.initial

    @property
    def best(self) -> Shift:
        """That of `V` itself, or of a function made of it where it is higher."""
        return self._best.answer().shift

    @property
    def subsolution(self) -> Subsolution | None:
        """What the `best` is of, or an average of, where that is not `V`."""
        return self._best.answer().subsolution

    @contextlib.contextmanager
    def ahead(self) -> Iterator[None]:
        """Within it a second core looks for the `best`, if there is one and the problem can be asked from two threads."""
        _ = self.initial  # which is asked for at once
        if self.search and self.problem.concurrent:
            self._best.begin()
        try:
            yield
        finally:
            self._best.stop()

    @cached_property
    def _best(self) -> Ahead[Found]:
        return Ahead(self._found())

    @property
    def tightened(self) -> Subsolution | None:
        """`V` trained on for its bound, where that is worth it."""
        return Ahead(self._trained_on()).answer()

    def _trained_on(self) -> Generator[None, None, Subsolution | None]:
        if not worth(self.own, NOISY_WORTH if self.problem.noisy else WORTH):
            return None
        batch = len(self.sets[0])  # a small certificate is a quick one
        return (yield from tightened(self.problem, self.value, self.seed, batch, self.steps))

    def _found(self) -> Generator[None, None, Found]:
        if not self.search:
            return Found(self.own)
        best, W = self.own, self.kept
        if W is None:
            W = yield from self._trained_on()
        if W is not None:
            beside = [*self.own.beside, *([self.problem.samples(W.worst, divergences=False)] if len(W.worst) else [])]
            best = highest([self.own, replace(self.own, value=W.network, name="V tightened", beside=beside)])
        used = None if best is self.own else W
        return Found(best if self.problem.noisy else mollified_shift(best), used)


def worth(shift: Shift, least: float) -> bool:
    """Whether more than the part ``least`` of the bound is to gain up to what is `attainable`."""
    most = attainable(shift)
    lacks = lambda scaling: most - scaling.bound > least * abs(scaling.bound)
    return lacks(shift.looked) or lacks(shift.found)  # what is found in steep places only adds to it


def attainable(shift: Shift) -> float:
    """The bound with the mean of the largest slacks for their supremum, which is like what training maximises: where the
    bound is as high, no spike is left to take off."""
    weights = torch.cat([samples.weight for samples in shift.sets])
    mean = sum(shift.initial) / len(shift.initial)
    return best_level(SlackParts.join(shift.parts), weights, mean, 1.0 / LARGEST_PART)[2]
