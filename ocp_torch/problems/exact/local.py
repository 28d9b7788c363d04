r"""The optimal flow near a state it stays at: how fast it contracts there, which decides whether `mu*` can be bounded."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def discounted_riccati(A: Tensor, B: Tensor, Q: Tensor, rho: float) -> Tensor:
    r"""`P` with `V(x) = rho x'Px / 2` for `dx/dt = A x + B u` and the cost `rho int e^{-rho t} (x'Qx + |u|^2) / 2 dt`.

    The stabilising solution of `A'P + PA - PBB'P + Q = 0` with `A - rho/2` for `A`, from the stable subspace of the
    Hamiltonian matrix (Laub, 1979).
    """
    d = len(A)
    F = A - 0.5 * rho * torch.eye(d, dtype=A.dtype)
    hamiltonian = torch.cat([torch.cat([F, -B @ B.T], dim=1), torch.cat([-Q, -F.T], dim=1)])
    values, vectors = torch.linalg.eig(hamiltonian)
    stable = vectors[:, values.real.argsort()[:d]]
    return torch.linalg.solve(stable[:d].T, stable[d:].T).T.real


def occupation_bound_at_rest(A: Tensor, B: Tensor, Q: Tensor, rho: float, exponent: float) -> float | None:
    r"""`math.inf` if the optimal flow contracts volume at rate `rho` or more at a state of rest with `f = 0`, else `None`.

    There mass gathers as fast as the discount forgets it, and `mu*` is unbounded; otherwise nothing is known. ``A`` and
    ``B`` are the linear dynamics, ``Q`` the Hessian of `f`. For `q < 2` the control vanishes faster than linearly. A limit on
    the control changes nothing: near the state of rest the control is small.
    """
    flow = A
    if exponent == 2.0:
        flow = A - B @ B.T @ discounted_riccati(A, B, Q, rho)
    return math.inf if -float(flow.trace()) >= rho * (1.0 - 1e-9) else None
