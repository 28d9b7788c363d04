"""Manufactured problems: trigonometric polynomials, and what is derived from them."""

from __future__ import annotations

import math

import torch

from ocp_torch.certificate.proof.box import Box
from ocp_torch.certificate.proof.enclosures.enclosure import Enclosure, enclosure
from ocp_torch.certificate.proof.functions import power, reciprocal
from ocp_torch.certificate.proof.taylor import TaylorModel
from ocp_torch.problems.exact.manufactured import Manufactured
from ocp_torch.problems.exact.trigonometric import DEPTH, TrigonometricPolynomial, WavyMatrix


@enclosure.register(Manufactured)
def manufactured_enclosure(problem: Manufactured, box: Box) -> Enclosure | None:
    """The formulas of `state_cost` and `drift` in models; the optimal control near its zeros by its size alone.

    `None` where `u*` is clipped: there are no models of its kinks yet.
    """
    if problem.limited:
        return None
    rho, q, conjugate = problem.discount, problem.exponent, problem.control_cost.conjugate_exponent
    V0, slope = polynomial_model(problem.V0, box), gradient_model(problem.V0, box)
    mu, mu0 = polynomial_model(problem.mu, box), polynomial_model(problem.mu0, box)
    stream = TaylorModel.stack([polynomial_model(h, box) for h in problem.stream])
    closed_loop = (gradient_model(problem.phi, box) * rho + stream) * reciprocal(mu)[..., None]
    B = matrix_model(problem.B, box)
    pull = (B * slope[..., None]).sum(dim=-2) * (-1.0 / rho)
    squares = (pull * pull).sum()
    u = pull if q == 2.0 else pull * power(squares, 0.5 * conjugate - 1.0)[..., None]
    cost = power(squares, 0.5 * conjugate) * (1.0 / q)
    f = V0 - (slope * closed_loop).sum() * (1.0 / rho) - cost + problem.c
    return Enclosure(f, closed_loop - (B * u[None]).sum(), B, mu0)


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


def matrix_model(B: WavyMatrix, box: Box) -> TaylorModel:
    """`B` over ``box``, ``(N, d, m)``."""
    mean = B.mean.to(box.centre).expand(len(box), -1, -1)
    if not B.varies:
        return box.constant(mean)
    waves = torch.nn.functional.one_hot(B.coordinate, len(B.mean)).to(box.centre).flatten(0, 1)
    waved = box.cosine(waves, 2.0 * torch.pi * B.phase.to(box.centre).flatten())
    return (waved * DEPTH + 1.0).reshape(*B.mean.shape) * mean
