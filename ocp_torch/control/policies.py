"""Controllers as functions of the state: from `V` alone, from `w / mu`, or zero; and the densities `mu` they need."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.pace import Pace
from ocp_torch.fields.fields import SUBSOLUTION, Fields
from ocp_torch.maths import jets
from ocp_torch.maths.jets import Field, Jet
from ocp_torch.objectives.objective import CLOSED, NETWORK, SADDLE
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.generator import Generator, pull_back
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# The controllers of trained fields.
VALUE = "value"  # from `V`
DENSITY = "density"  # from `w / mu`
TRAJECTORIES = "trajectories"  # from the `V` of a warm start, for controls that are held
MINIMISED = "minimised"  # from `w` and the `mu` of Lemma 2 where training takes another: `G` bounds its cost
BOUNDING = SUBSOLUTION  # from `V` trained on for the lower bound

LARGEST_DENSITY = 1e30  # a density above it counts as infinite, in single precision too

# The multiples of this number are spread evenly, and no grid or symmetric state has them as coordinates.
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)

# A policy maps states (N, d) to controls (N, m); a density maps them to (N,); `w` and `mu` together are (N, m) and (N,).
Policy = Callable[[Tensor], Tensor]
Density = Callable[[Tensor], Tensor]
Densities = Callable[[Tensor], tuple[Tensor, Tensor]]


class ValuePolicy:
    """`u = grad R*(-B^T grad V / rho)` (Proposition 2): optimal when `V = V*`."""

    def __init__(self, problem: Problem, value: Field) -> None:
        self.problem, self.value = problem, value

    def __call__(self, x: Tensor) -> Tensor:
        return self.control(self.problem.control_matrix(x), jets.jet(self.value, x))

    def control(self, B: Tensor, V: Jet) -> Tensor:
        """The control where the jet of `V` is known already."""
        return self.problem.control_cost.argmax(self._price(B, V))

    def _price(self, B: Tensor, V: Jet) -> Tensor:
        return -pull_back(B, V.gradient) / self.problem.discount

    @torch.no_grad()
    def flux_divergence(self, x: Tensor, B: Tensor, div_B: Tensor) -> tuple[Tensor, Tensor]:
        r"""The control ``(N, m)`` and `div(B u)` ``(N,)`` at states ``(N, d)``, as data.

        Where `B` does not vary the divergence is `(div B) . u - tr(B J B^T hess V) / rho` with the derivative `J` of
        `grad R*`: one sweep along the columns of `B J^{1/2}` in place of a reverse pass for each control."""
        if not is_even(self.problem, B):
            return jets.control_flux_divergence(self, x, B, div_B)
        V, rho = jets.jet(self.value, x), self.problem.discount
        root = self.problem.control_cost.argmax_root(self._price(B, V), B.mT).mT
        u, bent = self.control(B, V), jets.curvature(self.value, x, math.sqrt(2.0 / rho) * root)
        return u, (div_B * u).sum(dim=-1) - bent


def is_even(problem: Problem, B: Tensor) -> bool:
    """Whether the control matrices ``B`` ``(N, d, m)`` of ``problem`` are the same at all of `N` states and at a generic one,
    so that they do not vary around these states either."""
    generic = (GOLDEN * torch.arange(1, problem.dim + 1, dtype=B.dtype, device=B.device)).remainder(1.0)
    return bool((B == problem.control_matrix(generic.unsqueeze(0))).all())


def admissible_density(kind: str | None, problem: Problem, fields: Fields, constants: Constants) -> Field:
    """`w` of trained fields, within what a limit on the control allows: the `mu` of Lemma 2 allows any `w` already."""
    if kind == CLOSED:
        return fields.control_density
    return problem.control_cost.admissible(fields.control_density, occupation_density(kind, problem, fields, constants))


def density_policy(densities: Densities, cost: PowerCost) -> Policy:
    """`u = w / mu`, within the limit of ``cost``; 0 where `mu` is 0 (no mass is there) or infinite (mass stands still), and
    NaN where a state is."""

    def policy(x: Tensor) -> Tensor:
        w, mu = densities(x)
        idle = (mu <= 0) | (mu > LARGEST_DENSITY)
        mu = torch.where(idle, 1.0, mu)
        return torch.where(idle.unsqueeze(-1), 0.0, cost.within(w, mu) / mu.unsqueeze(-1))

    return policy


def zero_policy(problem: Problem) -> Policy:
    """`u = 0`, what the certificate calls doing nothing."""
    return lambda x: x.new_zeros(len(x), problem.control_dim)


def trained_densities(kind: str | None, problem: Problem, fields: Fields, constants: Constants) -> Densities:
    """`w(x)` and `mu(x)` of trained fields: `mu` ``closed`` (Lemma 2, no drift), ``saddle`` (Lemma 3), both of which are made
    of `w`, or ``network`` (`exp log mu`)."""
    cost = problem.control_cost

    def closed(x: Tensor) -> tuple[Tensor, Tensor]:
        samples = Samples.of(problem, x)
        w, inflow = Generator.of(problem, samples).control_inflow(fields.control_density)
        return w, cost.primal_occupation(w, samples.f, constants.C_V, inflow)

    def saddle(x: Tensor) -> tuple[Tensor, Tensor]:
        generator = Generator.of(problem, Samples.live(problem, x))
        beta = generator.reduced_cost(generator.jet(fields.value))
        w = fields.control_density(x)
        return w, cost.saddle_occupation(w, beta, constants.M)

    network = lambda x: (fields.control_density(x), fields.log_occupation(x).exp())
    return {CLOSED: closed, SADDLE: saddle, NETWORK: network}[kind or NETWORK]


def occupation_density(kind: str | None, problem: Problem, fields: Fields, constants: Constants) -> Density:
    """`mu(x)` of `trained_densities`; that of a ``network`` is had without `w`."""
    if kind in (None, NETWORK):
        return lambda x: fields.log_occupation(x).exp()
    densities = trained_densities(kind, problem, fields, constants)
    return lambda x: densities(x)[1]


def trained_policies(
    kind: str | None, problem: Problem, fields: Fields, constants: Constants, every: bool = False
) -> dict[str, Policy]:
    """The controllers trained fields give: ``value`` if they hold `V`, ``density`` if they hold `w`, ``trajectories`` if they
    hold the `V` of a warm start, and ``subsolution`` if they hold one trained on from `V` for the lower bound without noise;
    or ``every`` one, ``minimised`` too."""
    policies: dict[str, Policy] = {}
    if fields.value is not None:
        policies[VALUE] = ValuePolicy(problem, fields.value)
    # Lemmas 2 and 3 give mu from the cost at the state itself.
    if fields.control_density is not None and (kind == NETWORK or problem.has_simulator):
        densities = trained_densities(kind, problem, fields, constants)
        policies[DENSITY] = density_policy(densities, problem.control_cost)
        if every and kind != CLOSED and problem.has_simulator and problem.still:
            densities = trained_densities(CLOSED, problem, fields, constants)
            policies[MINIMISED] = density_policy(densities, problem.control_cost)
    if fields.trajectory_value is not None:
        policies[TRAJECTORIES] = HeldPolicy(problem, fields.trajectory_value, Pace.of(problem))
    if fields.subsolution is not None and not problem.noisy:
        policies[BOUNDING] = ValuePolicy(problem, fields.subsolution)
    return policies
