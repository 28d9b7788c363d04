r"""Integrals over the torus with less noise: plane waves integrate to 0 exactly, so what a fit to them explains may go.

`int g = E[g - sum_k c_k phi_k]` for every choice of `c`, with `phi_k` cosines and sines of `2 pi k . x`, `k != 0`. The
waves are those that stand out in `g`. Each half of the sets is averaged with the coefficients that fit the other half
best, so that the fit leaves no bias.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ocp_torch.fields.waves import STATES, standardised, waves_of
from ocp_torch.maths.sums import summed

# Waves in the fit, and states evaluated at once.
WAVES, CHUNK = 96, 8192


def integrals(states: list[Tensor], values: list[Tensor], weights: list[Tensor] | None = None) -> list[float]:
    """The mean of each of ``values`` ``(N,)`` over its set of ``states`` ``(N, d)``, with the noise of plane waves taken off
    where the states are uniform; else ``weights`` ``(N,)`` are one over their density, and no wave explains a narrow peak."""
    if weights is not None and any(bool((w != 1.0).any()) for w in weights):
        return [float((w * v).mean()) for w, v in zip(weights, values, strict=True)]
    plain = [float(v.mean()) for v in values]
    if len(states) < 2:
        return plain
    some = slice(0, max(1, STATES // len(states)))
    functions = standardised(torch.cat([v[some] for v in values]))
    waves = waves_of(torch.cat([x[some] for x in states]), functions, WAVES).to(states[0])
    if not len(waves):
        return plain
    moments = [_moments(x, v, waves) for x, v in zip(states, values, strict=True)]
    fits = [_fit(moments[1 - half :: 2]) for half in (0, 1)]
    explained = [float(fits[i % 2] @ sums[1:] / sums[0]) for i, (sums, *_) in enumerate(moments)]
    return [p - e for p, e in zip(plain, explained, strict=True)]


def _moments(x: Tensor, v: Tensor, waves: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums of `(1, phi)`, of `phi phi^T` with the constant, and of `(1, phi) v` over one set."""
    count = 1 + 2 * len(waves)
    gram, right = v.new_zeros(count, count), v.new_zeros(count)
    for part, value in zip(x.split(CHUNK), v.split(CHUNK), strict=True):
        angles = 2.0 * math.pi * (part @ waves.T)
        phi = torch.cat([torch.ones_like(part[:, :1]), angles.cos(), angles.sin()], dim=1)
        gram, right = gram + phi.T @ phi, right + phi.T @ value
    return gram[0], gram, right


def _fit(moments: list[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
    """Least-squares coefficients of the waves, beside a constant."""
    gram, right = summed(g for _, g, _ in moments), summed(r for *_, r in moments)
    ridge = 1e-10 * gram[0, 0] * torch.eye(len(gram), dtype=gram.dtype)
    return torch.linalg.solve(gram + ridge, right)[1:]
