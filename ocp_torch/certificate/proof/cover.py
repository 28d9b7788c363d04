"""Cells that cover the torus, and what is proved on each of the HJB slack `Q` and of `W mu0`, for `W = theta V`."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ocp_torch.certificate.proof.enclosures import conjugate_model, enclosure
from ocp_torch.certificate.proof.models import Box
from ocp_torch.certificate.proof.network_model import Known, network_model
from ocp_torch.certificate.proof.taylor import ROUNDING, TaylorModel, upward
from ocp_torch.problems.generator import Generator, hjb_slack
from ocp_torch.problems.problem import Problem

# Degree of the models, by dimension: with a higher one fewer cells are needed, and each takes longer.
DEGREE = {1: 4, 2: 5}
# A cell whose longest side is above so many times the shortest is bisected along it, lest it become a sliver.
LARGEST_ASPECT = 4.5


def degree(problem: Problem) -> int:
    """Degree of the models for ``problem``: one more with noise, as second derivatives lose an order; in two dimensions that
    takes half of the cells, and 0.7 to 0.85 of the time."""
    return DEGREE[problem.dim] + problem.noisy


@torch.no_grad()
def cell_models(problem: Problem, value: Known, theta: float, box: Box) -> tuple[TaylorModel, TaylorModel]:
    """`Q` and `W mu0` for `W = theta V`, both ``(N,)``, over ``box``."""
    data = enclosure(problem, box)
    if data.noise is None and problem.noisy:
        raise TypeError(f"the enclosure of {type(problem).__name__} leaves out its noise")
    V = network_model(value, box, data.noise).map(lambda part: part * theta)
    generator = Generator(data, problem.discount)
    conjugate = conjugate_model(problem.control_cost, generator.push(V))
    return hjb_slack(V.value, data.f, generator.transport(V), conjugate), V.value * data.mu0


@dataclass
class Cover:
    """`N` cells with ``centre`` and half-widths ``half``, both ``(N, d)``, and what is proved on each.

    ``upper`` ``(N,)`` is at least `sup Q`, and ``reached`` at most; ``mean`` and ``radius`` ``(N,)`` enclose the integral of
    `W mu0` over the cell; ``axis`` ``(N,)`` is the coordinate to bisect it along.
    """

    centre: Tensor
    half: Tensor
    upper: Tensor
    reached: Tensor
    mean: Tensor
    radius: Tensor
    axis: Tensor

    @classmethod
    def of(cls, problem: Problem, value: Known, theta: float, centre: Tensor, half: Tensor) -> "Cover":
        """The cells with ``centre`` and ``half``, evaluated."""
        box = Box(centre, half, degree(problem))
        Q, initial = cell_models(problem, value, theta, box)
        mean, radius = initial.mean()
        volume = (2.0 * half).prod(dim=-1)
        upper = Q.bounds()[1].nan_to_num(nan=math.inf, posinf=math.inf)
        reached = (Q.coefficients[0] - Q.radius).nan_to_num(nan=-math.inf)
        return cls(centre, half, upper, reached, mean * volume, radius * volume, _loosest(Q, box))

    @classmethod
    def join(cls, parts: list["Cover"]) -> "Cover":
        return cls(*(torch.cat(columns) for columns in zip(*(vars(p).values() for p in parts), strict=True)))

    def __len__(self) -> int:
        return len(self.upper)

    def take(self, index: Tensor) -> "Cover":
        """The cells at ``index``, rows or flags."""
        return Cover(*(column[index] for column in vars(self).values()))

    def halves(self) -> tuple[Tensor, Tensor]:
        """``centre`` and ``half`` of both halves of each cell along its ``axis``: all first ones, then all second ones."""
        hot = nn.functional.one_hot(self.axis, self.half.shape[1]).to(self.half)
        half = self.half * (1.0 - 0.5 * hot)
        shift = half * hot
        return torch.cat([self.centre - shift, self.centre + shift]), half.repeat(2, 1)

    def integral(self) -> tuple[float, float]:
        """Lower and upper bound of the integral of `W mu0` over all cells; `fsum` rounds once."""
        means = self.mean.tolist()
        middle = math.fsum(means)
        rounded = math.fsum(self.radius.tolist()) + ROUNDING * math.fsum(map(abs, means))
        radius = float(upward(torch.tensor(rounded, dtype=torch.float64)))
        return math.nextafter(middle - radius, -math.inf), math.nextafter(middle + radius, math.inf)


def _loosest(Q: TaylorModel, box: Box) -> Tensor:
    """The coordinate ``(N,)`` along which the bound of `Q` is loosest. Nonlinear terms count by their power of it, the radius
    by the length of the side."""
    half = box.half
    exponents = half.new_tensor(box.basis.exponents)
    exponents[box.basis.ends[1] : box.basis.ends[2]] = 0.0
    bent = torch.einsum("kn,ki->ni", Q.coefficients.abs(), exponents)
    loose = bent + Q.radius.unsqueeze(-1) * half / half.sum(dim=-1, keepdim=True)
    axis = loose.nan_to_num(nan=math.inf, posinf=math.inf).argmax(dim=-1)
    return torch.where(half.amax(dim=-1) > LARGEST_ASPECT * half.amin(dim=-1), half.argmax(dim=-1), axis)
