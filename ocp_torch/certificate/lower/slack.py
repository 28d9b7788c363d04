"""The HJB slack `Q` of a value function and of its multiples, at sampled states and anywhere."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.maths.jets import Field, Jet, jet
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.generator import Generator, hjb_slack
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

MAX_THETA = 1.5  # the largest `theta` for which the multiple `theta V` is tried


@dataclass(frozen=True)
class SlackParts:
    """The terms at sampled states of which the slack of every `theta V` is made."""

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
