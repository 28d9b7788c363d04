r"""The primal-dual saddle, PD (section 6 of the paper), as it stands there and with each player's exact penalty added.

`L(V; w, mu) = E[(f + R(w/mu)) mu + V (mu0 - mu) + grad V . (a mu + B w) / rho]` is the Lagrangian (equation 14).
"""

from __future__ import annotations

from torch import Tensor

from ocp_torch import calculus, control_laws, formulas
from ocp_torch.bounds import Bounds
from ocp_torch.errors import require_number
from ocp_torch.fields.fields import CONTROL_DENSITY, LOG_OCCUPATION, VALUE, Fields
from ocp_torch.objectives.objective import Objective
from ocp_torch.problems.problem import Problem
from ocp_torch.samples import Samples


class Saddle(Objective):
    r"""`sup_V inf_w E[V mu0 + grad V . B w / rho + S_M(w, f - V + grad V . a / rho)]`, with `S_M` of Lemma 3.

    Convex in `w`, concave in `V`, and needs no divergence of the problem.
    """

    players = {"value": (VALUE,), "density": (CONTROL_DENSITY,)}
    occupation = control_laws.SADDLE

    def losses(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        value, gradient = calculus.value_and_gradient(fields.value, samples.x)
        w = fields.control_density(samples.x)
        pushed = (formulas.pull_back(samples, gradient) * w).sum(dim=-1) / self.rho
        beta = samples.f - value + formulas.along(samples, gradient) / self.rho
        psi = samples.mean(value * samples.mu0 + pushed + self.cost.saddle_minimum(w, beta, self.bounds.M))
        return {"value": -psi, "density": psi}


class AugmentedSaddle(Objective):
    r"""The value player minimises `-(L + k F_M(V))`, the density player `L + k J(w, mu)`, with `k = augmentation > 0`.

    The saddle point does not move. Let `(V*, w*, mu*)` be the optimal triple. For the value player against `(w*, mu*)`:
    Liouville's equation makes `L(V; w*, mu*) = E[(f + R(u*)) mu*] = OPT` for every `V`, and `F_M(V) <= OPT = F_M(V*)` once
    `M >= sup mu*`, so `V*` maximises the sum. For the density player against `V*`: the Hamilton-Jacobi-Bellman equation
    makes the integrand of `L(V*; w, mu) - OPT` non-negative, zero at `(w*, mu*)` (Lemma 4), and `J(w, mu) >= OPT = J(w*,
    mu*)` once `C_V >= sup V*`, so `(w*, mu*)` minimises the sum. Neither can gain: it is an equilibrium still, and each
    player's own term, no longer linear along `L`'s flat directions, is what damps the rotation of the plain game.

    Convexity: `L + k J` is convex in `(w, mu)` (a perspective plus linear terms and a hinge of them) and `L + k F_M` is
    concave in `V`. The game is no longer zero-sum, but its operator is that of `L`, which is monotone, plus the
    subgradients of `-k F_M` and `k J`, which are monotone too. In `log mu` convexity is lost, as in a network's weights.
    """

    players = {"value": (VALUE,), "density": (CONTROL_DENSITY, LOG_OCCUPATION)}
    needs_divergences = True
    occupation = control_laws.NETWORK

    def __init__(self, problem: Problem, bounds: Bounds, augmentation: float) -> None:
        super().__init__(problem, bounds)
        self.augmentation = augmentation

    def losses(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        k, M, C_V = self.augmentation, self.bounds.M, self.bounds.C_V
        value, gradient = calculus.value_and_gradient(fields.value, samples.x)
        slack = formulas.hjb_slack(samples, value, gradient, self.cost, self.rho)
        penalised = value * samples.mu0 - M * slack.clamp_min(0.0)
        w, inflow = formulas.controlled_inflow(samples, fields.control_density, self.rho)
        mu, loss = formulas.drifting_loss(samples, fields.log_occupation, self.rho)
        running = samples.f * mu + self.cost.perspective(w, mu)
        hinged = running + C_V * (inflow - loss).clamp_min(0.0)
        lagrangian = lambda v, g, cost, m, c: cost + formulas.lagrange_term(samples, v, g, m, c, self.rho)
        # Each player sees the other as data.
        of_value = lagrangian(value, gradient, running.detach(), mu.detach(), w.detach())
        of_density = lagrangian(value.detach(), gradient.detach(), running, mu, w)
        return {
            "value": -samples.mean(of_value + k * penalised),
            "density": samples.mean(of_density + k * hinged),
        }


def saddle(problem: Problem, bounds: Bounds, augmentation: float = 1.0) -> Objective:
    """The paper's saddle for ``augmentation = 0``, the augmented one otherwise. Raises `InputError` if negative."""
    weight = require_number("method.augmentation", augmentation, at_least=0.0)
    return AugmentedSaddle(problem, bounds, weight) if weight > 0.0 else Saddle(problem, bounds)
