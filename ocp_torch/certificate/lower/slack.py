"""The HJB slack `Q` of a value function and of its multiples: at sampled states, anywhere, and where it peaks."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ocp_torch.maths.jets import Field, Jet, jet
from ocp_torch.maths.supremum import Extremum, batched, climb, supremum
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.generator import Generator, hjb_slack
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

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


@dataclass(frozen=True)
class Scaled:
    """`theta V`."""

    value: Field
    theta: float

    def __call__(self, x: Tensor) -> Tensor:
        return self.theta * self.value(x)

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        return jet(self.value, x, sigma).map(lambda part: self.theta * part)


def slack_function(problem: Problem, value: Field):
    """`x -> Q(x)` for the whole torus, differentiable in `x` where the problem is."""

    def slack(x: Tensor) -> Tensor:
        generator = Generator.of(problem, Samples.live(problem, x))
        return generator.hjb_slack(generator.jet(value))

    return slack


@torch.no_grad()
def slack_peaks(problem: Problem, value: Field, x: Tensor, count: int, steps: int) -> tuple[Tensor, float]:
    """Where so many ``steps`` of ascents from the ``count`` states of ``x`` ``(N, d)`` with the largest slack of ``value``
    end, and from those with the smallest, ``(2 count, d)``; and the largest slack there, whatever its sign."""
    slack = slack_function(problem, value)
    met, ends, largest = batched(slack, x), [], 0.0
    for function, found in ((slack, met), (lambda at: -slack(at), -met)):
        start, index = found.topk(min(count, len(found)))
        at, reached = climb(function, x[index], start, steps)
        ends.append(at.remainder(1.0))
        largest = max(largest, float(reached.max()))
    return torch.cat(ends), largest


def climbed_from(function: Field, values: Tensor, states: Tensor, ascents: int) -> Extremum:
    """The supremum of a ``function`` whose ``values`` ``(N,)`` at ``states`` are known: the largest of those, then local
    ascents from the largest; an estimate from below."""
    start = states[values.topk(min(ascents, len(values))).indices]
    return replace(supremum(function, start, ascents=ascents), points=len(states))
