r"""A lower bound that needs no `M`: `E[W mu0] - sup Q_W <= OPT` for any smooth `W`, here for `W = theta V`.

A constant `c` added to `W` adds `c` to its slack, so `W - sup Q_W` is a subsolution of the HJB equation. For `V` scaled by
`theta` the slack `Q_{theta V} = theta (V - grad V . a / rho) - f + R*(-theta B^T grad V / rho)` is convex in `theta` at
every state, so the bound is concave in `theta`: its maximum is found by a search on a line. (Scaling `V - c` instead of `V`
changes nothing.) Where `V` has large slack, at kinks for instance, a `theta` below 1 trades a little of `E[V mu0]` for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ocp_torch.certificate.bound import LOWER, Bound, sentence_on
from ocp_torch.certificate.checks.assumptions import Assumptions, found_by_search
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.simulated.control_variate import integrals
from ocp_torch.maths.jets import Field, Jet, chunked_jet, jet
from ocp_torch.maths.supremum import Extremum, minimiser, supremum
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.generator import Generator, hjb_slack
from ocp_torch.problems.needs import Need
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

if TYPE_CHECKING:
    from ocp_torch.certificate.context import Context

# The largest theta that is tried.
TOP = 1.5


@dataclass(frozen=True)
class SlackParts:
    """What the slack of every `theta V` at sampled states is made of."""

    cost: PowerCost
    x: Tensor  # (N, d)
    initial: Tensor  # (N,) V mu0
    value: Tensor  # (N,) V - L^0 V / rho
    f: Tensor  # (N,)
    push: Tensor  # (N, m) -B^T grad V / rho

    @classmethod
    def of(cls, generator: Generator, V: Jet) -> "SlackParts":
        samples, value = generator.data, V.value - generator.transport(V)
        return cls(generator.cost, samples.x, V.value * samples.mu0, value, samples.f, generator.push(V))

    @staticmethod
    def join(parts: "list[SlackParts]") -> "SlackParts":
        names = ("x", "initial", "value", "f", "push")
        return SlackParts(parts[0].cost, *(torch.cat([getattr(p, name) for p in parts]) for name in names))

    def slack(self, theta: float) -> Tensor:
        """`Q_{theta V}`, ``(N,)``."""
        return hjb_slack(theta * self.value, self.f, None, self.cost.conjugate(theta * self.push))


def slack_parts(problem: Problem, value: Field, sets: list[Samples]) -> list[SlackParts]:
    """The parts on each of ``sets``."""
    return [SlackParts.of(Generator.of(problem, s), chunked_jet(value, s.x)) for s in sets]


def initials(sets: list[Samples], parts: list[SlackParts]) -> list[float]:
    """`E[V mu0]`, per set."""
    return integrals([s.x for s in sets], [p.initial for p in parts], [s.weight for s in sets])


@dataclass(frozen=True)
class Shift:
    """`E[theta W mu0] - sup Q_{theta W}`, for `W` the average of `V` at ``radius``, or `V` itself where that is 0."""

    theta: float
    largest: Extremum
    initial: list[float]  # E[W mu0] per set
    radius: float = 0.0
    name: str = "V"

    @classmethod
    def of(
        cls,
        problem: Problem,
        value: Field,
        sets: list[Samples],
        parts: list[SlackParts],
        ascents: int,
        radius: float = 0.0,
        beside: Sequence[SlackParts] = (),
        initial: list[float] | None = None,
    ) -> "Shift":
        r"""The best multiple of ``value``, whose ``parts`` on ``sets`` are known; the supremum is sought ``beside`` too.

        ``initial`` is `E[W mu0]` per set, if that is known. `theta` is 1, or the maximiser of the bound over the sampled
        states. The supremum there is searched for anew, and 1 stays where that shows no gain. Where `f < 0` is met the
        problem breaks its promise, `0` is no subsolution to scale towards, and `theta` is 1.
        """
        initial = initial or initials(sets, parts)
        everywhere = SlackParts.join([*parts, *beside])
        tried = lambda theta: cls(theta, climbed(problem, value, everywhere, theta, ascents), initial, radius)
        plain = tried(1.0)
        if bool((everywhere.f < 0.0).any()):
            return plain
        scaled = tried(scaled_by(everywhere, sum(initial) / len(initial)))
        return scaled if scaled.bound > plain.bound else plain

    @property
    def estimate(self) -> Estimate:
        """The bound; a negative supremum shifts `W` up."""
        return Estimate.of([self.theta * e - self.largest.value for e in self.initial])

    @property
    def bound(self) -> float:
        return self.theta * sum(self.initial) / len(self.initial) - self.largest.value

    @property
    def sentence(self) -> str:
        """What the slack is of."""
        averaged = f", averaged {self.radius:.2g} around," if self.radius else ""
        return f"sup Q of {self.theta:.4g} {self.name}{averaged}"


def slack_function(problem: Problem, value: Field):
    """`x -> Q(x)` for the whole torus, differentiable in `x` where the problem is."""

    def slack(x: Tensor) -> Tensor:
        samples = Samples.of(problem, x, divergences=False) if not x.requires_grad else _live(problem, x)
        return Generator.of(problem, samples).hjb_slack(jet(value, x))

    return slack


def _live(problem: Problem, x: Tensor) -> Samples:
    """Samples whose data carry derivatives in `x`; only suprema over `x` want that."""
    one = torch.ones_like(x[:, 0])
    return Samples(x, problem.state_cost(x), problem.drift(x), problem.control_matrix(x), one, one)


def climbed_from(function: Field, values: Tensor, states: Tensor, ascents: int) -> Extremum:
    """The supremum of a ``function`` whose ``values`` ``(N,)`` at ``states`` are known: the largest of those, then local
    ascents from the largest; an estimate from below."""
    start = states[values.topk(min(ascents, len(values))).indices]
    return replace(supremum(function, start, ascents=ascents), points=len(states))


def climbed(problem: Problem, value: Field, parts: SlackParts, theta: float, ascents: int) -> Extremum:
    """`sup Q_{theta V}`."""
    scaled = value if theta == 1.0 else lambda x: theta * value(x)
    return climbed_from(slack_function(problem, scaled), parts.slack(theta), parts.x, ascents)


def scaled_by(parts: SlackParts, initial: float) -> float:
    """The `theta` in `[0, TOP]` that maximises the sampled bound, concave in `theta`."""
    return minimiser(lambda theta: float(parts.slack(theta).max()) - theta * initial, 0.0, TOP)


class Shifted(Bound):
    """The best shifted bound that was found of functions made of `V` (`SampledValue.best`)."""

    name, side, label = "shifted", LOWER, "shifted"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return (found_by_search("sup Q"),)

    def evaluate(self, context: "Context") -> Estimate | None:
        return None if context.sampled_value is None else context.sampled_value.best.estimate

    def searches(self, context: "Context") -> list[str]:
        if context.sampled_value is None:
            return []
        best = context.sampled_value.best
        return [sentence_on(best.sentence, best.largest)]
