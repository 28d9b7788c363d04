"""`V` and its slack at sampled states: what the lower bounds of one `V` share."""

from dataclasses import dataclass, replace
from functools import cached_property

from torch import Tensor

from ocp_torch.certificate.lower.mollified import mollified_shift
from ocp_torch.certificate.lower.recombined import recombined
from ocp_torch.certificate.lower.shifted import Shift, SlackParts, initials, slack_parts
from ocp_torch.maths.jets import Field
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


@dataclass(frozen=True)
class SampledValue:
    """``value`` `V` on ``sets`` of samples of ``problem``; each part is computed when it is first asked for.

    Suprema of its slack are climbed from the ``ascents`` worst states, and sought at the states ``odd`` ``(K, d)`` too. With
    ``search`` the shifted bound is sought among functions made of `V`, which takes many times as long: with its last layer
    chosen anew (`recombined`, on states of ``seed``), and averages over neighbours of the better of the two (`mollified`).
    """

    problem: Problem
    value: Field
    sets: list[Samples]
    ascents: int = 32
    search: bool = False
    seed: int = 0
    odd: Tensor | None = None

    @cached_property
    def parts(self) -> list[SlackParts]:
        """What the slack of every multiple of `V` is made of, per set."""
        return slack_parts(self.problem, self.value, self.sets)

    @cached_property
    def initial(self) -> list[float]:
        """`E[V mu0]`, per set."""
        return initials(self.sets, self.parts)

    @cached_property
    def own(self) -> Shift:
        """The shifted bound of the best multiple of `V` itself."""
        return self._shift(self.value, self.parts, self.initial)

    @cached_property
    def best(self) -> Shift:
        """That, or the one of a function made of `V` where it is higher."""
        if not self.search:
            return self.own
        value, parts, best = self.value, self.parts, self.own
        other = recombined(self.problem, value, self.seed)
        if other is not None:
            others = slack_parts(self.problem, other, self.sets)
            tried = replace(self._shift(other, others), name="V recombined")
            if tried.bound > best.bound:
                value, parts, best = other, others, tried
        return mollified_shift(self.problem, value, self.sets, parts, self.ascents, best, self._beside)

    def _shift(self, value: Field, parts: list[SlackParts], initial: list[float] | None = None) -> Shift:
        beside = slack_parts(self.problem, value, self._beside)
        return Shift.of(self.problem, value, self.sets, parts, self.ascents, beside=beside, initial=initial)

    @cached_property
    def _beside(self) -> list[Samples]:
        odd = self.odd
        return [] if odd is None or not len(odd) else [Samples.of(self.problem, odd, divergences=False)]
