r"""The primal-dual saddle, PD (section 6 of the paper), as it stands there and with each player's exact penalty added.

`L(V; w, mu) = E[V mu0 + l]` with `l = (f + R(w/mu)) mu - V mu + grad V . (a mu + B w) / rho` is its Lagrangian.
"""

from __future__ import annotations

from torch import Tensor

from ocp_torch.errors import require_integer, require_number
from ocp_torch.fields.fields import CONTROL_DENSITY, LOG_OCCUPATION, VALUE, Fields
from ocp_torch.maths import calculus
from ocp_torch.objectives.dual import value_loss
from ocp_torch.objectives.objective import NETWORK, SADDLE, Objective
from ocp_torch.problems import formulas
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


class Saddle(Objective):
    r"""`sup_V inf_w Psi`, `Psi = E[V mu0 + grad V . B w / rho + S_M(w, f - V + grad V . a / rho)]`, `S_M` of Lemma 3.

    Convex in `w`, concave in `V`, and needs no divergence of the problem. (With a limit `c` on the control, `S_M` is finite
    for `|w| <= c M` only, and `w` is shrunk to that ball first.) With ``augmentation`` `k > 0` the value player
    minimises `-(Psi + k F_M)`, which `V*` does as well.
    """

    players = {"value": (VALUE,), "density": (CONTROL_DENSITY,)}
    occupation = SADDLE

    def __init__(self, problem: Problem, constants: Constants, augmentation: float = 0.0) -> None:
        super().__init__(problem, constants)
        self.augmentation = augmentation

    def losses(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        value, gradient = calculus.value_and_gradient(fields.value, samples.x)
        w = self.cost.within(fields.control_density(samples.x), self.constants.M)
        pushed = (formulas.pull_back(samples, gradient) * w).sum(dim=-1) / self.rho
        beta = samples.f - value + formulas.along(samples, gradient) / self.rho
        psi = samples.mean(value * samples.mu0 + pushed + self.cost.saddle_minimum(w, beta, self.constants.M))
        if self.augmentation == 0.0:
            return {"value": -psi, "density": psi}
        slack = formulas.hjb_slack(samples, value, gradient, self.cost, self.rho)
        own = value_loss(self, fields, samples, value, slack, residual=0.0)
        return {"value": -psi + self.augmentation * own, "density": psi}


class AugmentedSaddle(Objective):
    r"""The value player minimises `-(c L + k F_M(V))`, the density player `E[max(l, 0)] + k J(w, mu)`.

    ``augmentation`` is `k > 0`, ``coupling`` is `c >= 0`, ``residual`` as for `Dual`. Let `(V*, w*, mu*)` be optimal. The
    saddle point does not move:

    * Value player, against `(w*, mu*)`: Liouville's equation makes `L(V; w*, mu*) = E[(f + R(u*)) mu*] = OPT` for every
      `V`, and `F_M(V) <= OPT = F_M(V*)` once `M >= sup mu*`. So `V*` maximises `c L + k F_M`, for every `c`.
    * Density player, against `V*`: the Hamilton-Jacobi-Bellman equation makes `l >= 0` pointwise for every `(w, mu)`, and
      `l = 0` at `(w*, mu*)` (Lemma 4); so there `E[max(l, 0)] = L - OPT`, and `J(w, mu) >= OPT = J(w*, mu*)` once
      `C_V >= sup V*`. So `(w*, mu*)` minimises the sum.

    Why each change: the penalties are not linear along the flat directions of `L`, and damp the rotation of the plain
    game. Against a `V` that is no subsolution yet, `L` is unbounded below in `mu`; `max(l, 0)` is not. With `c = 0` the
    value player ignores a density player that has not arrived yet (the game is then a dual ascent with a best response),
    and nothing is lost at the equilibrium, where `L` is flat in `V`. With ``warm_start`` and `c = 0` the density player
    even rests for that part of the run: what it would answer to is not there yet. Then it also learns from ``density_batch``
    states of each batch at most, of those that carry weight (`m` tangents through `w` make its states expensive).

    Convexity: `l` is a perspective plus linear terms, so `max(l, 0)` and `J` are convex in `(w, mu)`, and `c L + k F_M` is
    concave in `V`. For `c = 1` and where `l >= 0` the operator of the game is that of `L`, which is monotone, plus
    subgradients of convex functions, which are too. In `log mu`, as in a network's weights, convexity is lost.
    """

    players = {"value": (VALUE,), "density": (CONTROL_DENSITY, LOG_OCCUPATION)}
    occupation = NETWORK

    def __init__(
        self,
        problem: Problem,
        constants: Constants,
        augmentation: float,
        coupling: float,
        residual: float,
        warm_start: float,
        density_batch: int | None,
    ) -> None:
        super().__init__(problem, constants)
        self.augmentation, self.coupling, self.residual = augmentation, coupling, residual
        self.density_batch = density_batch
        self.resting = {"density": warm_start if coupling == 0.0 else 0.0}

    @property
    def needs_divergences(self) -> bool:
        """Only once the density player moves."""
        return self.progress >= self.resting["density"]

    def losses(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        k, C_V = self.augmentation, self.constants.C_V
        value, gradient = calculus.value_and_gradient(fields.value, samples.x)
        slack = formulas.hjb_slack(samples, value, gradient, self.cost, self.rho)
        of_value = k * value_loss(self, fields, samples, value, slack, self.residual)
        if not self.needs_divergences:
            return {"value": of_value}
        if self.coupling == 0.0:
            samples, rows = samples.take_weighted(self.density_batch)
            value, gradient = value[rows], gradient[rows]
        w, inflow = formulas.control_inflow(samples, self.admissible(fields), self.rho)
        mu, loss = formulas.occupation_outflow(samples, fields.log_occupation, self.rho)
        running = samples.f * mu + self.cost.perspective(w, mu)
        hinged = running + C_V * (inflow - loss).clamp_min(0.0)
        # Each player sees the other as data.
        local = running + formulas.multiplier_term(samples, value.detach(), gradient.detach(), mu, w, self.rho)
        if self.coupling > 0.0:
            seen = formulas.multiplier_term(samples, value, gradient, mu.detach(), w.detach(), self.rho)
            of_value = of_value - self.coupling * samples.mean(value * samples.mu0 + seen)
        return {"value": of_value, "density": samples.mean(local.clamp_min(0.0) + k * hinged)}


def saddle(
    problem: Problem,
    constants: Constants,
    augmentation: float = 0.25,
    coupling: float = 0.0,
    residual: float = 0.3,
    warm_start: float = 0.75,
    density_batch: int | None = None,
) -> Objective:
    """The paper's saddle for ``augmentation = 0``, the augmented one otherwise.

    Without divergences of `a` and `B` the augmentation is that of the value player alone, and a note says so. Raises
    `InputError` for negative weights, or a ``density_batch`` below 1.
    """
    if density_batch is not None:
        require_integer("method.density_batch", density_batch, 1)
    weight = require_number("method.augmentation", augmentation, at_least=0.0)
    coupling = require_number("method.coupling", coupling, at_least=0.0)
    residual = require_number("method.residual", residual, at_least=0.0)
    warm_start = require_number("method.warm_start", warm_start, at_least=0.0, at_most=1.0)
    if weight == 0.0:
        return Saddle(problem, constants)
    if problem.gives_divergences:
        return AugmentedSaddle(problem, constants, weight, coupling, residual, warm_start, density_batch)
    objective = Saddle(problem, constants, weight)
    objective.notes = ("this problem gives no divergences of a and B: pd trains w alone, with mu in closed form.",)
    return objective
