"""The circle and the torus: squares of distances to integers, with kinks halfway between."""

from __future__ import annotations

import torch

from ocp_torch.certificate.proof.box import Box
from ocp_torch.certificate.proof.enclosures.enclosure import Enclosure, enclosure
from ocp_torch.certificate.proof.functions import absolute
from ocp_torch.certificate.proof.taylor import TaylorModel
from ocp_torch.problems.exact.torus import Torus


@enclosure.register(Torus)
def torus_enclosure(problem: Torus, box: Box) -> Enclosure:
    """With `s = y - n` and `n` the nearest integer, `(y_i - 1/2)^2 = s^2 - |s| + 1/4`: only `|s|` has a kink in the cell."""
    d = problem.dim
    y = TaylorModel.stack([(box.coordinates() * row).sum() for row in problem.A.to(box.centre)])
    s = y - y.coefficients[0].round()
    square = s * s - absolute(s) + 0.25
    # Beyond |s| = 1 the identity fails: of a cell that large only the range [0, 1/4] is known.
    far = s.size >= 1.0
    parts = square.where(~far, box.constant(torch.full_like(s.radius, 0.125), 0.125))
    B = box.constant(problem.A_inverse.to(box.centre).expand(len(box), d, d))
    return Enclosure(parts.sum() * (1.0 / d), None, B, box.constant(1.0))
