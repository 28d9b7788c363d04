r"""Functions of Taylor models: `|g|`, `1 / g` and powers, by expansion about the constant term of `g` where `g` is smooth."""

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.certificate.proof.taylor import ROUNDING, TaylorModel, upward

# `power` expands where the lower bound of g is above this part of the upper one. Nearer to a zero of g, which a power may
# not be smooth at, the range is as good as an expansion.
SMOOTH = 0.25
# Error of a computed g^e relative to itself, in units of ROUNDING: so much, and so much times e. As |log g| <= 745 in
# float64, an exponent off by 2^-53 e changes g^e by less than 2 e ROUNDING.
POWER_ERROR = (16.0, 8.0)


def compose(g: TaylorModel, series: Sequence[Tensor], error: Tensor | float, top: Tensor) -> TaylorModel:
    r"""`s(g)`, from the Taylor coefficients ``series`` of `s` at the constant term of ``g``.

    Each of ``series`` ``(N, ...)`` is known up to ``error`` relative to itself; ``top`` bounds `|s^{(m+1)}| / (m+1)!` over
    the range of ``g``, with `m` the degree.
    """
    moving = g.coefficients.clone()
    moving[0] = 0.0
    delta = TaylorModel(moving, g.radius, g.basis)
    reach = upward(delta.size + delta.radius)
    result = TaylorModel.constant(series[-1], error * series[-1].abs(), g.basis)
    for coefficient in reversed(series[:-1]):
        result = result * delta + TaylorModel.constant(coefficient, error * coefficient.abs(), g.basis)
    return TaylorModel(result.coefficients, upward(result.radius + top * reach ** (g.basis.degree + 1)), g.basis)


def absolute(g: TaylorModel) -> TaylorModel:
    """`|g|`. Where the sign of `g` is not known: the chord over its range, which is exact at both ends and too high by at
    most its height at 0, less half of that height."""
    low, high = g.bounds()
    crosses = (low < 0.0) & (high > 0.0)
    width = torch.where(crosses, high - low, 1.0)
    height = -2.0 * low * high / width
    line = g * ((high + low) / width) + 0.5 * height
    radius = upward(line.radius + 0.5 * height.abs() + ROUNDING * width)
    signed = g * torch.where(low >= 0.0, 1.0, -1.0).to(low)
    return TaylorModel(line.coefficients, radius, g.basis).where(crosses, signed)


def reciprocal(g: TaylorModel) -> TaylorModel:
    """`1 / g` where `g > 0` on the whole cell; an infinite radius elsewhere."""
    centre, (low, _), degree = g.coefficients[0], g.bounds(), g.basis.degree
    usable = low > 0.0
    centre, safe = torch.where(usable, centre, 1.0), torch.where(usable, low, 1.0)
    series = [(-1.0) ** k * centre ** -(k + 1.0) for k in range(degree + 1)]
    found = compose(g, series, ROUNDING, upward(safe ** -(degree + 2.0)))
    return TaylorModel(found.coefficients, torch.where(usable, found.radius, math.inf), g.basis)


def power(g: TaylorModel, exponent: float) -> TaylorModel:
    """`g^exponent`, ``exponent > 0``, of a `g >= 0`; near the zeros of `g` only the range is kept (see `SMOOTH`)."""
    if exponent == 1.0:
        return g
    degree = g.basis.degree
    low, high = g.bounds()
    low, high = low.clamp_min(0.0), high.clamp_min(0.0)
    smooth = low > SMOOTH * high
    centre = torch.where(smooth, g.coefficients[0], 1.0)
    binomials = list(itertools.accumulate(range(degree + 1), lambda b, k: b * (exponent - k) / (k + 1), initial=1.0))
    series = [binomials[k] * centre ** (exponent - k) for k in range(degree + 1)]
    ends = [torch.where(smooth, end, 1.0) ** (exponent - degree - 1) for end in (low, high)]
    top = upward(abs(binomials[-1]) * torch.maximum(*ends))
    relative = ROUNDING * (POWER_ERROR[0] + POWER_ERROR[1] * exponent)
    found = compose(g, series, relative, top)
    least, most = low**exponent * (1.0 - relative), high**exponent * (1.0 + relative)
    hull = TaylorModel.constant(0.5 * (least + most), upward(0.5 * (most - least) + ROUNDING * most), g.basis)
    return found.where(smooth, hull)
