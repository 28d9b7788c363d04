r"""Finite differences for the Hamilton-Jacobi-Bellman equation with noise, on one grid, solved by Howard's policy iteration.

    V = min_u  f + |u|^q / q + (sum_i g_i d_i V + sum_ij D_ij d_ij V) / rho ,      g = a + B u

Central differences, and seven points for each mixed derivative; where the noise along a coordinate is too weak for weights
of one sign, `D_ii - sum_j |D_ij| < |g_i| h / 2`, as much viscosity as is missing. That makes the scheme monotone wherever
`D` is diagonally dominant (Kushner and Dupuis, *Numerical Methods for Stochastic Control Problems*, 2001), and without
dominance stable in the mean square. What viscosity changes is taken back up to `CLIP osc(V) h^{1/2}`: where `V` is smooth
all of it, so that the error is `O(h^2)`; at kinks, which weak noise leaves, what is taken back vanishes with `h`, and the
limit is the same.

The transposed matrix of the last policy gives `mu*`: of mean 1, with `int V mu0 = int (f + |u|^q / q) mu` up to what is
clipped.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from ocp_torch.maths.supremum import batched
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import driven
from ocp_torch.studies.reference.grid import PIECE, Grid
from ocp_torch.studies.reference.semi_lagrangian import minimiser, running_cost

# Limit of what is taken back of the viscosity, relative to osc(V) h^{1/2} per 1 / rho; as in the semi-Lagrangian scheme.
CLIP = 4.0
# Dimensions in which the matrix is factored: at 40 nodes a side in three the factors fill gigabytes.
FACTORED = 2
# Iterations of the Krylov method beyond; the matrix is well conditioned on grids as coarse as those of three dimensions.
KRYLOV_ITERATIONS = 2000


class FiniteDifferences:
    """The scheme for ``problem`` on ``grid``; ``rise`` is `osc V`, to which clipping is relative: at 0 all viscosity
    stays."""

    gain = 1.0

    def __init__(self, problem: Problem, grid: Grid, rise: float = 0.0) -> None:
        self.problem, self.grid, self.rise = problem, grid, rise
        self.rho, self.q, self.limit = problem.discount, problem.exponent, problem.control_limit
        self.pieces = torch.arange(grid.count).split(PIECE)
        x = grid.nodes()
        functions = problem.state_cost, problem.drift, problem.control_matrix
        self.f, self.a, self.B = (batched(function, x, PIECE) for function in functions)
        self.scale = float(self.f.max() - self.f.min())
        self.clip = CLIP * rise * self.rho * math.sqrt(grid.spacing)
        self.monotone = rise == 0.0
        D = batched(lambda x: diffusion(problem, x), x, PIECE) / grid.spacing**2
        self.mixed = {(i, j): D[:, i, j] for i, j in itertools.combinations(range(grid.dim), 2)}
        own = torch.diagonal(D, dim1=1, dim2=2)
        self.straight = 2.0 * own - D.abs().sum(dim=-1)  # what mixed derivatives leave of the weight along a coordinate

    def pull(self, slope: Tensor, nodes: slice | Tensor, u: Tensor) -> Tensor:
        """`-B^T grad V / rho`, ``(N, m)``, which in this scheme does not depend on ``u``."""
        return -torch.einsum("ndm,nd->nm", self.B[nodes], slope[nodes]) / self.rho

    def velocity(self, u: Tensor) -> Tensor:
        """`g` in cells per unit time, ``(n, d)``."""
        return driven(self.a, self.B, u) / self.grid.spacing

    def viscosity(self, g: Tensor) -> Tensor:
        """The viscosity that is missing along each coordinate for weights of one sign, ``(n, d)``."""
        return (0.5 * g.abs() - self.straight.clamp_min(0.0)).clamp_min(0.0)

    def needs_viscosity(self, control: Tensor) -> bool:
        """Whether noise alone leaves weights of both signs anywhere."""
        return bool((self.viscosity(self.velocity(control)) > 0.0).any())

    def improve(self, value: Tensor, control: Tensor) -> tuple[Tensor, Tensor]:
        """The best control at each node among the one held and those of central and all one-sided differences, and the right
        side of the equation under it."""
        grid, everything = self.grid, slice(0, self.grid.count)
        ahead = torch.stack([grid.shifted(value, k, 1) - value for k in range(grid.dim)], dim=-1)
        behind = torch.stack([value - grid.shifted(value, k, -1) for k in range(grid.dim)], dim=-1)
        across, bend = 0.5 * (ahead + behind), ahead - behind
        spread = (self.straight * bend).sum(dim=-1)
        for corner, weight in self._corners():
            spread = spread + weight * (self._at(value, corner) - value)
        best, right = control, torch.full_like(value, torch.inf)
        one_sided = self.needs_viscosity(control)
        sides = itertools.product((ahead, behind), repeat=grid.dim) if one_sided else ()
        slopes = [across, *(torch.stack([s[:, k] for k, s in enumerate(side)], dim=-1) for side in sides)]
        for slope in (None, *slopes):
            u = (
                control
                if slope is None
                else minimiser(self.pull(slope / grid.spacing, everything, control), self.q, self.limit)
            )
            g = self.velocity(u)
            thick = self.viscosity(g) * bend
            kept = thick - thick.clamp(-self.clip, self.clip)
            reached = self.f + running_cost(u, self.q) + (spread + (g * across + kept).sum(dim=-1)) / self.rho
            better = reached < right
            best, right = torch.where(better.unsqueeze(-1), u, best), torch.where(better, reached, right)
        return best, right

    def system(self, value: Tensor, control: Tensor):
        """`A` (sparse) and `c` ``(n,)`` of the equation `A V = c` of the policy ``control``, with the clipping that
        ``value`` has."""
        from scipy.sparse import csr_array

        grid, g = self.grid, self.velocity(control)
        viscosity, constant = self.viscosity(g), self.f + running_cost(control, self.q)
        index, weights = [], []
        for k in range(grid.dim):
            step = tuple(int(i == k) for i in range(grid.dim))
            bend = self._at(value, step) + self._at(value, tuple(-s for s in step)) - 2.0 * value
            thick = viscosity[:, k] * bend
            clipped = thick.abs() > self.clip
            constant = constant - torch.where(clipped, self.clip * thick.sign(), 0.0) / self.rho
            straight = self.straight[:, k] + torch.where(clipped, viscosity[:, k], 0.0)
            for sign in (1, -1):
                index.append(self._neighbours(tuple(sign * s for s in step)))
                weights.append(straight + sign * 0.5 * g[:, k])
        for corner, weight in self._corners():
            index.append(self._neighbours(corner))
            weights.append(weight)
        off = torch.stack(weights, dim=1) / self.rho
        entries = torch.cat([1.0 + off.sum(dim=1, keepdim=True), -off], dim=1)
        columns = torch.cat([torch.arange(grid.count).unsqueeze(1), torch.stack(index, dim=1)], dim=1)
        rows = np.arange(0, columns.numel() + 1, columns.shape[1], dtype=np.int32)
        A = csr_array(
            (entries.flatten().numpy(), columns.flatten().int().numpy(), rows), shape=(grid.count, grid.count)
        )
        return A, constant

    def evaluate(self, value: Tensor, control: Tensor, tolerance: float) -> Tensor:
        """`V` of the policy ``control``."""
        A, constant = self.system(value, control)
        return self._solved(A, constant, value, tolerance)

    def occupation(self, value: Tensor, control: Tensor, tolerance: float) -> Tensor:
        """The discounted occupation density of the policy ``control`` at the nodes, ``(n,)``."""
        density = batched(self.problem.initial_density, self.grid.nodes(), PIECE)
        return self._solved(self.system(value, control)[0].T, density, density, tolerance)

    def _solved(self, A, right: Tensor, start: Tensor, tolerance: float) -> Tensor:
        from scipy.sparse import diags_array
        from scipy.sparse.linalg import bicgstab, spsolve

        c = right.numpy()
        if self.grid.dim > FACTORED:
            inverse = diags_array(1.0 / A.diagonal())
            found, info = bicgstab(
                A.tocsr(), c, x0=start.numpy(), rtol=0.0, atol=tolerance, maxiter=KRYLOV_ITERATIONS, M=inverse
            )
            if info == 0:
                return torch.from_numpy(found)
        return torch.from_numpy(spsolve(A.tocsc(), c))

    def _corners(self) -> Iterator[tuple[tuple[int, ...], Tensor]]:
        """Offsets in cells and weights of the diagonal neighbours that mixed derivatives take."""
        for (i, j), D in self.mixed.items():
            for sign in (1, -1):
                for along in (1, -1):
                    offset = [0] * self.grid.dim
                    offset[i], offset[j] = along, sign * along
                    yield tuple(offset), (sign * D).clamp_min(0.0)

    def _at(self, field: Tensor, offset: tuple[int, ...]) -> Tensor:
        """``field`` at the neighbours of all nodes at ``offset``, in cells."""
        for k, cells in enumerate(offset):
            field = self.grid.shifted(field, k, cells) if cells else field
        return field

    def _neighbours(self, offset: tuple[int, ...]) -> Tensor:
        return self._at(torch.arange(self.grid.count), offset)


def diffusion(problem: Problem, x: Tensor) -> Tensor:
    """`D = sigma sigma^T / 2`, ``(N, d, d)``; 0 where there is no noise."""
    sigma = problem.noise(x)
    if sigma is None:
        return x.new_zeros(len(x), problem.dim, problem.dim)
    return 0.5 * sigma @ sigma.transpose(1, 2)
