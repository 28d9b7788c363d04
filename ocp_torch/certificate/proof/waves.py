"""Taylor models of trigonometric polynomials and matrices of waves, which manufactured problems are made of."""

import math

import torch

from ocp_torch.certificate.proof.models import Box
from ocp_torch.certificate.proof.taylor import TaylorModel
from ocp_torch.problems.exact.trigonometric import DEPTH, TrigonometricPolynomial, WavyMatrix


def polynomial_model(p: TrigonometricPolynomial, box: Box) -> TaylorModel:
    """`p` over ``box``, ``(N,)``."""
    if len(p.waves) == 0:
        return box.constant(p.constant)
    waved = box.cosine(p.waves.to(box.centre), p.phases.to(box.centre))
    return (waved * p.amplitudes.to(box.centre)).sum() + p.constant


def gradient_model(p: TrigonometricPolynomial, box: Box) -> TaylorModel:
    """`grad p` over ``box``, ``(N, d)``; the derivative of a cosine is the cosine a quarter turn on."""
    turned = box.cosine(p.waves.to(box.centre), p.phases.to(box.centre) + 0.5 * math.pi)
    slopes = 2.0 * math.pi * p.amplitudes.unsqueeze(-1) * p.waves
    return (turned[..., None] * slopes.to(box.centre)).sum(dim=-2)


def hessian_model(p: TrigonometricPolynomial, box: Box) -> TaylorModel:
    """`hess p` over ``box``, ``(N, d, d)``."""
    waved = box.cosine(p.waves.to(box.centre), p.phases.to(box.centre))
    bent = -((2.0 * math.pi) ** 2) * torch.einsum("j,ji,jk->jik", p.amplitudes, p.waves, p.waves)
    return (waved[..., None, None] * bent.to(box.centre)).sum(dim=-3)


def matrix_model(B: WavyMatrix, box: Box) -> TaylorModel:
    """`B` over ``box``, ``(N, d, m)``."""
    mean = B.mean.to(box.centre)
    if not B.varies:
        return box.constant(mean.expand(len(box), -1, -1))
    return (_entry_waves(B, box, 0.0) * DEPTH + 1.0) * mean


def square_divergence_model(B: WavyMatrix, box: Box) -> TaylorModel:
    r"""`div D` ``(N, d)`` of `D = B B^T / 2` with as many columns as rows, by the product rule: `B_ik` varies with coordinate
    `c(i, k)`, so `2 (div D)_i = sum_k (d B_ik B_{c(i, k) k} + B_ik sum_j d B_jk [c(j, k) = j])`."""
    mean = B.mean.to(box.centre)
    matrix, slopes = matrix_model(B, box), _entry_waves(B, box, 0.5 * math.pi) * (2.0 * math.pi * DEPTH * mean)
    own = B.coordinate == torch.arange(len(mean)).unsqueeze(-1)
    columns = (slopes * own.to(mean)).sum(dim=-2)
    moved = matrix[B.coordinate, torch.arange(mean.shape[1])]
    return (slopes * moved + matrix * columns[None]).sum() * 0.5


def _entry_waves(B: WavyMatrix, box: Box, turned: float) -> TaylorModel:
    """The cosine in each entry of `B`, its phase ``turned`` on: ``(N, d, m)``."""
    waves = torch.nn.functional.one_hot(B.coordinate, len(B.mean)).to(box.centre).flatten(0, 1)
    return box.cosine(waves, 2.0 * torch.pi * B.phase.to(box.centre).flatten() + turned).reshape(*B.mean.shape)
