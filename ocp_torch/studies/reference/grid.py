"""A periodic grid on the unit torus: nodes, stencils and differences; and checks that such grids can solve a problem."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_integer, require_number
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.problem import Problem

OFFSETS = 4  # nodes of the cubic stencil per coordinate
# Nodes worked on at a time: the stencils of a piece stay in the cache.
PIECE = 2**14
MOST_DIMENSIONS = 3
FEWEST_NODES = 8
# Ratio of the sides of successive grids, by dimension: in three dimensions a grid half as fine as an affordable one shows
# little.
RATIO = {1: 2.0, 2: 2.0, 3: 1.5}
# Default side of the finest grid, by dimension.
FINEST = {1: 1024, 2: 192, 3: 40}
# In one dimension with noise: V has layers as thin as the diffusion over the speed, and this takes a second.
FINEST_WITH_NOISE = 4096
# Bytes per entry of the interpolation matrix: index, weights and their copies.
BYTES_PER_ENTRY = 40
# A function that changes by more, relative to its size, over one period has not period 1.
TOLERANCE = 1e-6
PROBED = 256  # states at which functions are tried
CONTROLS = 64  # controls at which the control cost is tried


@dataclass(frozen=True)
class Stencil:
    """Nodes around ``N`` points, and their multilinear (zero outside the cell) and cubic weights; each ``(N, 4^d)``."""

    index: Tensor
    linear: Tensor
    cubic: Tensor


class Grid:
    """``side`` nodes per coordinate of the `dim`-dimensional unit torus, at multiples of `h = 1 / side`, all moved by
    ``offset`` cells along each coordinate; float64."""

    def __init__(self, dim: int, side: int, offset: float = 0.0) -> None:
        self.dim, self.side, self.offset = dim, side, offset
        self.count, self.spacing = side**dim, 1.0 / side
        self._strides = [side ** (dim - 1 - k) for k in range(dim)]

    def nodes(self) -> Tensor:
        """All nodes, ``(side^d, d)``, the last coordinate running fastest."""
        line = (torch.arange(self.side, dtype=torch.float64) + self.offset) / self.side
        return torch.cartesian_prod(*[line] * self.dim).reshape(-1, self.dim)

    def stencil(self, x: Tensor) -> Stencil:
        """The stencils at points ``(N, d)``, any reals."""
        position = x * self.side - self.offset
        base = position.floor()
        t = (position - base).unsqueeze(-1)
        s, r, p = t - 1.0, t - 2.0, t + 1.0
        cubic = torch.cat([-t * s * r / 6.0, p * s * r / 2.0, -p * t * r / 2.0, p * t * s / 6.0], dim=-1)
        zero = torch.zeros_like(t)
        linear = torch.cat([zero, -s, t, zero], dim=-1)
        near = torch.arange(-1, OFFSETS - 1)
        index = (base.long().unsqueeze(-1) + near).remainder(self.side)
        flat, low, high = index[:, 0] * self._strides[0], linear[:, 0], cubic[:, 0]
        outer = lambda left, right: (left.unsqueeze(-1) * right.unsqueeze(-2)).flatten(1)
        for k in range(1, self.dim):
            flat = (flat.unsqueeze(-1) + (index[:, k] * self._strides[k]).unsqueeze(-2)).flatten(1)
            low, high = outer(low, linear[:, k]), outer(high, cubic[:, k])
        return Stencil(flat, low, high)

    def interpolated(self, field: Tensor, x: Tensor) -> Tensor:
        """A vector field ``(side^d, k)``, multilinearly between the nodes, at points ``(N, d)``; ``(N, k)``."""
        stencil = self.stencil(x)
        return (stencil.linear.unsqueeze(-1) * field[stencil.index]).sum(dim=1)

    def shifted(self, field: Tensor, coordinate: int, cells: int) -> Tensor:
        """At each node the value of ``field`` ``(side^d, ...)`` that many ``cells`` further along ``coordinate``."""
        shape = [self.side] * self.dim
        return field.reshape(*shape, *field.shape[1:]).roll(-cells, dims=coordinate).reshape(field.shape)

    def gradient(self, values: Tensor) -> Tensor:
        """Central differences of fourth order, ``(side^d, d)``."""
        across = lambda k, cells: self.shifted(values, k, cells) - self.shifted(values, k, -cells)
        slope = lambda k: (8.0 * across(k, 1) - across(k, 2)) / (12.0 * self.spacing)
        return torch.stack([slope(k) for k in range(self.dim)], dim=-1)


def grid_sides(problem: Problem, side: int | None, memory: float) -> tuple[int, int, int]:
    """Nodes per coordinate of the three grids, the finest ``side`` (None: by dimension); ``memory`` in gigabytes."""
    dim = problem.dim
    if dim > MOST_DIMENSIONS:
        raise InputError(
            f"problem.dim is {dim}, but a grid needs at most {MOST_DIMENSIONS} coordinates; beyond, certificates remain."
        )
    ratio = RATIO[dim]
    usual = FINEST_WITH_NOISE if dim == 1 and problem.noisy else FINEST[dim]
    finest = usual if side is None else require_integer("side", side, 1)
    sides = round(finest / ratio**2), round(finest / ratio), round(finest)
    if sides[0] < FEWEST_NODES:
        least = round(FEWEST_NODES * ratio**2)
        raise InputError(
            f"side is {finest}, but must be at least {least}: the coarsest of the three grids has {sides[0]}."
        )
    require_number("memory", memory, above=0.0)
    entries = float(finest) ** dim * OFFSETS**dim
    most = min(memory * 1e9 / BYTES_PER_ENTRY, 2.0**31 - 1.0)
    if entries > most:
        fits = int((most / OFFSETS**dim) ** (1.0 / dim))
        need = entries * BYTES_PER_ENTRY / 1e9
        raise InputError(
            f"side is {finest}, which in {dim} dimensions needs about {need:.3g} GB, but memory is {memory:g}; "
            f"at most {fits} nodes per coordinate fit."
        )
    return sides


def require_solvable(problem: Problem, grid: Grid) -> None:
    """Raise `InputError` unless the problem's functions have their shapes, are finite at the nodes of ``grid`` and have
    period 1, and its control costs `|u|^q / q`."""
    d, m = problem.dim, problem.control_dim
    shapes = {"state_cost": (), "drift": (d,), "control_matrix": (d, m), "initial_density": ()}
    probe = torch.rand(PROBED, d, generator=fixed_generator(), dtype=torch.float64)
    parts = probe, *grid.nodes().split(PIECE)
    sigma = problem.noise(probe)
    if sigma is not None:
        shapes["noise"] = (d, sigma.shape[-1])
    for name, shape in shapes.items():
        function = getattr(problem, name)
        first = function(probe)
        if tuple(first.shape) != (len(probe), *shape):
            wanted = ", ".join(["N", *map(str, shape)])
            raise InputError(
                f"{name} gives shape {tuple(first.shape)} at {len(probe)} states, but must give ({wanted})."
            )
        size = 0.0
        for part in parts:
            values = function(part).reshape(len(part), -1)
            bad = ~torch.isfinite(values).all(dim=-1)
            if bad.any():
                at = [round(c, 6) for c in part[bad][0].tolist()]
                raise InputError(f"{name} is {values[bad][0].tolist()} at x = {at}, but must be finite everywhere.")
            size = max(size, float(values.abs().max()))
        for k in range(d):
            moved = probe + torch.eye(d, dtype=torch.float64)[k]
            if float((function(moved) - first).abs().max()) > TOLERANCE * max(size, 1e-12):
                raise InputError(f"{name} does not have period 1 in x_{k + 1}, but all of a problem on the torus must.")
    u = 3.0 * torch.randn(CONTROLS, m, generator=fixed_generator(1), dtype=torch.float64)
    if problem.control_limit is not None:
        u = problem.control_cost.within(u, torch.rand(CONTROLS, generator=fixed_generator(2), dtype=torch.float64))
    own, power = problem.control_cost.cost(u), u.norm(dim=-1) ** problem.exponent / problem.exponent
    if not torch.allclose(own, power, rtol=1e-8, atol=1e-12):
        raise InputError(f"{type(problem).__name__} has a control cost of its own, but the grid knows only |u|^q / q.")
