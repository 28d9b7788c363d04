r"""A mass pushed along a line by a force: the linear system with a quadratic cost, whose optimum is known."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import require_number, require_numbers
from ocp_torch.problems.physical.chart import smooth_step
from ocp_torch.problems.physical.coordinates import MARGIN, Interval
from ocp_torch.problems.physical.start import EDGE
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.systems.linear_quadratic import LinearQuadratic

# Gauss-Legendre nodes: exact for a square times the edge of a start, a polynomial of degree 5.
NODES = 4


class DoubleIntegrator(System):
    r"""`p'' = F / m`, cost `(position_weight p^2 + velocity_weight p'^2 + force_weight F^2) / 2`; `p` in m, `F` in N.

    On the whole plane and without a limit the optimum is ``plane``, a `LinearQuadratic` with value `V`, and ``lqr_optimum``
    its mean over the start, which is within ``starts`` of rest, in m and m/s. In the ``box``, given likewise, and its margins
    `V` has the Hamilton-Jacobi-Bellman slack `(1 - chi) (V - failure_cost + chi (tr(P D) - R*))`, `chi` the cut-off: at most
    0 if `failure_cost >= V + tr(P D)` up to the seams, as by default. No path crosses a seam: so `lqr_optimum <= OPT`.

    The two are equal, and ``exact_optimum`` is declared, where the linear controller keeps every path from the start in the
    box, and itself within the limit. Then `mu* <= sup mu0 rho / (rho - k)`, `k` the rate at which that flow contracts
    (`math.inf` for `k >= rho`). With ``force_noise``, in N sqrt(s) beside the force, paths leave the box, and the inequality
    is all there is; ``noise`` crosses seams, and nothing is known. Raises `InputError` for wrong arguments.
    """

    divergence_free = True

    def __init__(
        self,
        mass: float = 1.0,
        box: Sequence[float] = (1.0, 0.7),
        starts: Sequence[float] = (0.7, 0.5),
        position_weight: float = 4.0,
        velocity_weight: float = 0.0,
        force_weight: float = 1.0,
        failure_cost: float | None = None,
        discount: float = 2.0,
        control_limit: float | Sequence[float] | None = None,
        force_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        self.mass = require_number("problem.mass", mass, above=0.0)
        self.box = require_numbers("problem.box", box, 2, above=0.0)
        self.starts = half = require_numbers("problem.starts", starts, 2, above=0.0)
        self.position_weight = require_number("problem.position_weight", position_weight, above=0.0)
        self.velocity_weight = require_number("problem.velocity_weight", velocity_weight, at_least=0.0)
        self.force_weight = require_number("problem.force_weight", force_weight, above=0.0)
        self.force_noise = require_number("problem.force_noise", force_noise, at_least=0.0)
        rho = require_number("problem.discount", discount, above=0.0)
        A, Q = torch.zeros(2, 2).double(), torch.tensor([self.position_weight, self.velocity_weight]).double().diag()
        A[0, 1] = 1.0
        self._pushed = torch.tensor([[0.0], [1.0 / self.mass]], dtype=torch.float64)
        D = 0.5 * self.force_noise**2 * self._pushed @ self._pushed.T
        self.plane = LinearQuadratic(A, self._pushed / self.force_weight**0.5, Q, D, rho)
        position, velocity = self.box
        seams = (1.0 + 2.0 * MARGIN) * torch.tensor([[position, velocity], [position, -velocity]], dtype=torch.float64)
        enough = float(self.plane.value(seams).max()) + self.plane.constant
        super().__init__(
            [Interval("position", -position, position, "m"), Interval("velocity", -velocity, velocity, "m/s")],
            ["force [N]"],
            discount,
            control_weight=self.force_weight,
            control_limit=control_limit,
            start={"position": (-half[0], half[0]), "velocity": (-half[1], half[1])},
            noise=noise,
            failure_cost=enough if failure_cost is None else failure_cost,
        )
        self.state_cost_bound = max(float(self.cost(seams).max()), self._failure)
        bounded = self.diffusion is None and self._failure >= enough
        self.lqr_optimum = self._mean(half) if bounded else None
        limit = math.inf if self.control_limit is None else float(np.min(self.control_limit))
        ends = torch.tensor([half, self.box], dtype=torch.float64)
        if bounded and not self.noisy and self.plane.stays(ends[0], ends[1], limit):
            self.exact_optimum, k = self.lqr_optimum, self.plane.contraction
            most = float(self.initial_density(self.to_torus(torch.zeros(1, 2, dtype=torch.float64))))
            self.occupation_bound = most * rho / (rho - k) if k < rho else math.inf

    def _mean(self, half: Sequence[float]) -> float:
        """`E[V mu0]`: the coordinates of a start are independent and symmetric, so that only their squares count."""
        z, weight = np.polynomial.legendre.leggauss(NODES)
        inner, edge = 1.0 - 2.0 * EDGE, torch.from_numpy(1.0 + EDGE * (z - 1.0))
        beyond = float(
            (torch.from_numpy(EDGE * weight) * edge.square() * smooth_step((edge - inner) / (1.0 - inner))).sum()
        )
        square = (inner**3 / 3.0 + beyond) / (1.0 - EDGE)
        return (
            0.5 * self.discount * square * sum(float(p) * h**2 for p, h in zip(self.plane.P.diag(), half, strict=True))
            + self.plane.constant
        )

    def cost(self, s: Tensor) -> Tensor:
        return 0.5 * (self.position_weight * s[:, 0].square() + self.velocity_weight * s[:, 1].square())

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        a = torch.stack([s[:, 1], torch.zeros_like(s[:, 1])], dim=-1)
        return a, self._like(s, "pushed", self._pushed).expand(len(s), 2, 1)

    def disturbance(self, s: Tensor) -> Tensor | None:
        return self.force_noise * self.dynamics(s)[1] if self.force_noise else None
