r"""A smooth activation of a layer, over a batch of cells.

The activation is expanded about the layer's value at the centre of each cell, as `S(p) = sum_k s_k p^k` of the polynomial `p`
there; what that leaves out of the value and its derivatives is bounded degree by degree.
"""

import math
from functools import cached_property

import torch
from torch import Tensor, nn

from ocp_torch.certificate.proof.activations import SERIES, horner
from ocp_torch.certificate.proof.smooth import SmoothModel
from ocp_torch.certificate.proof.taylor import ROUNDING, Monomials, upward
from ocp_torch.maths.sums import summed


class Expansion:
    """An ``activation`` about the centre of each cell, for a layer ``model``; every tensor is ``(N, width)``."""

    def __init__(self, model: SmoothModel, activation: nn.Module) -> None:
        m = self.degree = model.basis.degree
        self.sigma = SERIES[type(activation)](m + 2)
        z = model.P[0]
        self.series = self.sigma.series(z, m + 1)
        self.errors = [self.sigma.error(k) for k in range(m + 2)]
        self.sizes = [c.abs() + e for c, e in zip(self.series, self.errors, strict=True)]
        self.sizes[0] = self.sizes[0] + self.errors[0] * z.abs()
        self.levels, self.radius = model.sizes()[1:], model.radii[0]
        self.reach = upward(summed(self.levels))
        self.wide = upward(self.reach + self.radius)

    def supremum(self, j: int) -> Tensor:
        """An upper bound of `|sigma^{(j)}|`, `1 <= j <= 3`, over the range of the layer."""
        m, beyond = self.degree, self.sigma.ceiling(self.degree + 2)
        terms = [math.perm(k, j) * self.sizes[k] for k in range(j, m + 2)] or [torch.zeros_like(self.wide)]
        local = horner(terms, self.wide) + math.perm(m + 2, j) * beyond * self.wide ** (m + 2 - j)
        return local.clamp_max(math.factorial(j) * self.sigma.ceiling(j))

    @cached_property
    def top(self) -> Tensor:
        """An upper bound of `|sigma^{(m+1)}| / (m+1)!` over that range."""
        m = self.degree
        local = self.sizes[m + 1] + (m + 2) * self.sigma.ceiling(m + 2) * self.wide
        return local.clamp_max(self.sigma.ceiling(m + 1))

    def moved(self, j: int, supremum: Tensor) -> Tensor:
        """A bound of `|sigma^{(j)}(h) - S^{(j)}(p)|`, from the ``supremum`` of `|sigma^{(j+1)}|`."""
        m = self.degree
        return supremum * self.radius + math.perm(m + 1, j) * self.top * self.reach ** (m + 1 - j)

    def majorant(self, j: int) -> list[Tensor]:
        """Sizes of `S^{(j)}(p)` by degree, in absolute values, with all degrees above `m - j` in the last entry."""
        m = self.degree
        return _majorant([math.perm(k + j, j) * self.sizes[k + j] for k in range(m + 1 - j)], self.levels, m + 1 - j)


def activate(model: SmoothModel, activation: nn.Module) -> SmoothModel:
    r"""`sigma(h)`, with `d sigma(h)/dt_i = sigma'(h) dh/dt_i`; second derivatives need a basis of degree 2 at least."""
    m, basis = model.basis.degree, model.basis
    of = Expansion(model, activation)
    s, z, sizes, errors, reach = of.series, model.P[0], of.sizes, of.errors, of.reach
    first, second = of.supremum(1), of.supremum(2)
    P = _composed(model.P, s[: m + 1], basis)
    derivative, moved = of.majorant(1), of.moved(1, second)
    known = horner(sizes[: m + 1], reach)
    varying = known - sizes[0]
    wrong = reach * horner([torch.full_like(z, e) for e in errors[1 : m + 1]], reach)
    # Slopes of a monomial of degree m are at most m times as large.
    inexact = m * (ROUNDING * (varying + ROUNDING * known) + wrong)
    slopes, cut_total = [], torch.zeros_like(z)
    for i in range(basis.dim):
        own = model.sizes(i)
        cut = _beyond(derivative, own, m)
        cut_total = cut_total + cut
        slopes.append(moved * summed(own) + cut + first * model.radii[1 + i] + inexact)
    # Terms of degree j > m of sigma(P) have slopes that add up to j times as much.
    value = of.moved(0, first) + cut_total / (m + 1) + ROUNDING * known
    value = value + errors[0] * (1.0 + z.abs()) + wrong
    bent = _bent(model, of, (first, second), derivative, (m - 1) * inexact)
    return SmoothModel(P, upward(torch.stack([value, *slopes, *bent])), basis)


def _bent(
    model: SmoothModel, of: Expansion, suprema: tuple[Tensor, Tensor], derivative: list[Tensor], inexact: Tensor
) -> list[Tensor]:
    r"""The radii of `sigma'(h) h_ij + sigma''(h) h_i h_j` for each second derivative that ``model`` carries."""
    m, places = of.degree, model.derivatives
    if len(places[-1]) < 2:
        return []
    (first, second), third = suprema, of.supremum(3)
    turned, curved, moved = of.moved(1, second), of.majorant(2), of.moved(2, third)
    radii = []
    sizes = {at: model.sizes(*at) for at in places[1:]}
    for i, j in places[1 + model.basis.dim :]:
        left, right, own = sizes[i,], sizes[j,], sizes[i, j]
        ri, rj, rij = (model.radii[places.index(at)] for at in ((i,), (j,), (i, j)))
        left_total, right_total = summed(left), summed(right)
        pairs = [summed(left[a] * right[k - a] for a in range(max(k - m, 0), min(k, m) + 1)) for k in range(2 * m + 1)]
        straight = first * rij + turned * summed(own) + _beyond(derivative, own, m - 1)
        spread = second * (left_total * rj + right_total * ri + ri * rj)
        radii.append(straight + spread + moved * left_total * right_total + _beyond(curved, pairs, m - 1) + inexact)
    return radii


def _beyond(left: list[Tensor], right: list[Tensor], start: int) -> Tensor:
    """The terms of degree ``start`` and more of a product, from the sizes of its factors by degree; the last entry of
    ``left`` is of all degrees from its own on, which is at least ``start``."""
    total = left[-1] * summed(right)
    return summed([total, *(left[a] * summed(right[start - a :]) for a in range(len(left) - 1))])


def _composed(P: Tensor, series: list[Tensor], basis: Monomials) -> Tensor:
    """`sum_k s_k (P - P_0)^k` up to the degree of the basis, by Horner's rule: each stage needs one degree more."""
    m, ends = basis.degree, basis.ends
    result = series[m].unsqueeze(0)
    for stage in range(1, m + 1):
        grown = P.new_zeros(ends[stage + 1], *P.shape[1:])
        for i, j, k in basis.products:
            if i < len(result) and j > 0 and k < len(grown):
                grown[k].addcmul_(result[i], P[j])
        grown[0] = series[m - stage]
        result = grown
    return result


def _majorant(coefficients: list[Tensor], levels: list[Tensor], m: int) -> list[Tensor]:
    """The terms of `sum_k c_k (sum_j levels_j tau^j)^k`, everything >= 0: degrees `0 ... m - 1`, then the sum of the rest."""
    total = summed(levels)
    result = [coefficients[-1]]  # by degree; the tail starts empty
    tail = torch.zeros_like(total)
    for c in reversed(coefficients[:-1]):
        grown: list = [c] + [0.0] * (m - 1)
        grown_tail = tail * total
        for a, left in enumerate(result):
            for j, right in enumerate(levels, start=1):
                if a + j < m:
                    grown[a + j] = grown[a + j] + left * right
                else:
                    grown_tail = grown_tail + left * right
        result, tail = grown, grown_tail
    return [*result, tail]
