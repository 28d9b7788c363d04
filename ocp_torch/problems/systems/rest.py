"""The linear system and the quadratic cost around a state of rest: the optimum there, and whether mass gathers."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.problems.physical.system import System

# A contraction rate within this part of rho counts as rho, so that rounding decides nothing.
ROUNDING = 1e-9


def riccati(A: Tensor, B: Tensor, Q: Tensor, rho: float = 0.0) -> Tensor:
    r"""The stabilising `P` ``(d, d)`` of `F'P + PF - PBB'P + Q = 0`, `F = A - rho/2`: from `x` the least of
    `int e^{-rho t} (x'Qx + |u|^2) / 2 dt` is `x'Px / 2`, by `u = -B'Px`. ``A`` and ``Q`` are ``(d, d)``, ``B`` ``(d, m)``."""
    from scipy.linalg import solve_continuous_are  # takes a while to import, and few problems need it

    F = A - 0.5 * rho * torch.eye(len(A), dtype=A.dtype)
    P = solve_continuous_are(F.numpy(), B.numpy(), Q.numpy(), torch.eye(B.shape[1]).numpy())
    return torch.from_numpy(P).to(A)


def optimal_contraction(A: Tensor, B: Tensor, Q: Tensor, rho: float) -> float:
    r"""How fast the optimal flow of `dx/dt = A x + B u` for `rho int e^{-rho t} (x'Qx + |u|^2) / 2 dt` loses volume.

    ``A`` and ``Q`` are ``(d, d)``, ``B`` ``(d, m)``. The closed loop is `F - BB'P + rho/2` with `F = A - rho/2` and `P` the
    stabilising solution of `F'P + PF - PBB'P + Q = 0`, and the eigenvalues of `F - BB'P` are the stable half of those of the
    Hamiltonian matrix, which come in pairs `+-lambda` (Laub, 1979). So its trace needs no `P`.
    """
    d = len(A)
    F = A - 0.5 * rho * torch.eye(d, dtype=A.dtype)
    hamiltonian = torch.cat([torch.cat([F, -B @ B.T], dim=1), torch.cat([-Q, -F.T], dim=1)])
    return 0.5 * float(torch.linalg.eigvals(hamiltonian).real.abs().sum()) - 0.5 * rho * d


def occupation_bound_at_rest(A: Tensor, B: Tensor, Q: Tensor, rho: float, exponent: float) -> float | None:
    r"""`math.inf` if the optimal flow contracts volume at rate `rho` or more at a state of rest with `f = 0`, else `None`.

    There mass gathers as fast as the discount forgets it, and `mu*` is unbounded; otherwise nothing is known. ``A`` and
    ``B`` are the linear dynamics, ``Q`` the Hessian of `f`. For `q < 2` the control vanishes faster than linearly. A limit on
    the control changes nothing: near the state of rest the control is small.
    """
    contraction = optimal_contraction(A, B, Q, rho) if exponent == 2.0 else -float(A.trace())
    return math.inf if contraction >= rho * (1.0 - ROUNDING) else None


def bound_at_rest(system: System, state: Sequence[float]) -> float | None:
    """`occupation_bound_at_rest` at a ``state`` of rest of ``system``; `None` with noise, which shakes it there too."""
    if system.noisy:
        return None
    return occupation_bound_at_rest(*linearised(system, state), system.discount, system.exponent)


def linearised(system: System, state: Sequence[float]) -> tuple[Tensor, Tensor, Tensor]:
    """`A` ``(d, d)``, `B` ``(d, m)`` and `Q` ``(d, d)``, the Hessian of the cost, at a ``state`` of rest: of physical states,
    and of controls whose price is `|v|^2 / 2`."""
    at = torch.tensor(state, dtype=torch.float64)
    A = torch.autograd.functional.jacobian(lambda s: system.dynamics(s[None])[0][0], at)
    B = system.from_controls(system.dynamics(at[None])[1][0].detach())
    return A, B, torch.autograd.functional.hessian(lambda s: system.cost(s[None])[0], at)
