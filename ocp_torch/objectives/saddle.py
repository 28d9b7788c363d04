r"""The primal-dual saddle, PD (section 6 of the paper), as it stands there and with each player's exact penalty added.

`L(V; w, mu) = E[V mu0 + l]` with `l = (f + R(w/mu)) mu - V mu + (L^0 V mu + grad V . B w) / rho` is its Lagrangian.
"""

from torch import Tensor

from ocp_torch.errors import require_integer, require_number
from ocp_torch.fields.fields import CONTROL_DENSITY, LOG_OCCUPATION, VALUE, Fields
from ocp_torch.objectives.dual import value_loss
from ocp_torch.objectives.objective import NETWORK, SADDLE, Objective, Phase
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


class Saddle(Objective):
    r"""`sup_V inf_w Psi`, `Psi = E[V mu0 + grad V . B w / rho + S_M(w, f - V + L^0 V / rho)]`, `S_M` of Lemma 3.

    Convex in `w`, concave in `V`, and needs no divergence of the problem. (With a limit on the control, `S_M` is finite
    for those `w` only that `M` can carry, and `w` is cut to them first.) With ``augmentation`` `k > 0` the value player
    minimises `-(Psi + k F_M)`, which `V*` does as well.
    """

    players = {"value": (VALUE,), "density": (CONTROL_DENSITY,)}
    occupation = SADDLE

    def __init__(self, problem: Problem, augmentation: float = 0.0, notes: tuple[str, ...] = ()) -> None:
        super().__init__(problem, notes)
        self.augmentation = augmentation

    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        generator = self.generator(samples)
        V = generator.jet(fields.value)
        w = self.cost.within(fields.control_density(samples.x), phase.constants.M)
        pushed, beta = generator.controlled(V, w) / self.rho, generator.reduced_cost(V)
        psi = samples.mean(V.value * samples.mu0 + pushed + self.cost.saddle_minimum(w, beta, phase.constants.M))
        if self.augmentation == 0.0:
            return {"value": -psi, "density": psi}
        own = value_loss(phase, fields, samples, V.value, generator.hjb_slack(V), residual=0.0)
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
    states of each batch at most, of those that carry weight (`m` reverse passes through `w` make its states expensive).

    Convexity: `l` is a perspective plus linear terms, so `max(l, 0)` and `J` are convex in `(w, mu)`, and `c L + k F_M` is
    concave in `V`. For `c = 1` and where `l >= 0` the operator of the game is that of `L`, which is monotone, plus
    subgradients of convex functions, which are too. In `log mu`, as in a network's weights, convexity is lost.
    """

    players = {"value": (VALUE,), "density": (CONTROL_DENSITY, LOG_OCCUPATION)}
    occupation = NETWORK

    def __init__(
        self,
        problem: Problem,
        augmentation: float,
        coupling: float,
        residual: float,
        warm_start: float,
        density_batch: int | None,
    ) -> None:
        super().__init__(problem)
        self.augmentation, self.coupling, self.residual = augmentation, coupling, residual
        self.density_batch = density_batch
        self.delays = {"density": warm_start if coupling == 0.0 else 0.0}

    def needs_divergences(self, phase: Phase) -> bool:
        """Only once the density player moves."""
        return phase.progress >= self.delays["density"]

    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        k, C_V = self.augmentation, phase.constants.C_V
        generator = self.generator(samples)
        V = generator.jet(fields.value)
        of_value = k * value_loss(phase, fields, samples, V.value, generator.hjb_slack(V), self.residual)
        if not self.needs_divergences(phase):
            return {"value": of_value}
        if self.coupling == 0.0:
            most = None if self.density_batch is None else self.density_batch // phase.shares
            samples, rows = samples.take_weighted(most)
            generator, V = self.generator(samples), V.map(lambda part: part[rows])
        w, inflow = generator.control_inflow(self.admissible(fields))
        mu, outflow = generator.occupation_outflow(fields.log_occupation)
        running = samples.f * mu + self.cost.perspective(w, mu)
        hinged = running + C_V * (inflow - outflow).clamp_min(0.0)
        # Each player sees the other as data.
        local = running + generator.multiplier_term(V.map(Tensor.detach), mu, w)
        if self.coupling > 0.0:
            seen = generator.multiplier_term(V, mu.detach(), w.detach())
            of_value = of_value - self.coupling * samples.mean(V.value * samples.mu0 + seen)
        return {"value": of_value, "density": samples.mean(local.clamp_min(0.0) + k * hinged)}


def saddle(
    problem: Problem,
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
        return Saddle(problem)
    if problem.gives_divergences:
        return AugmentedSaddle(problem, weight, coupling, residual, warm_start, density_batch)
    note = f"this problem gives no divergences of {problem.unknown_divergences}: pd trains w alone, with mu in closed form."
    return Saddle(problem, weight, notes=(note,))
