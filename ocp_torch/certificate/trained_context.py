"""The context of trained fields: nothing here knows how they were trained."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from ocp_torch.certificate.checks.hidden import Hidden
from ocp_torch.certificate.checks.observed import Observed, observe
from ocp_torch.certificate.checks.tails import sharpened
from ocp_torch.certificate.checks.wellposed import WellPosed, check_problem
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.simulated.candidates import simulate_candidates
from ocp_torch.certificate.simulated.performance import Simulated
from ocp_torch.certificate.trained import FieldsContext, in_float64
from ocp_torch.certificate.upper.lagrangian import ClosedLoopBounds
from ocp_torch.certificate.upper.penalised import DensityBounds, density_bounds
from ocp_torch.certificate.upper.policy_evaluation import fit_closed_loop
from ocp_torch.control.policies import Density, Policy, admissible_density, occupation_density
from ocp_torch.problems.samples import Samples

# States of each set at which the density is looked at for places without mass.
LOOKED_AT = 4096


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedContext(FieldsContext):
    """Up to two controllers, from `V` and from `w / mu`: both are simulated, and the better one is handed out."""

    divergent = "J, G and the Lagrangian bound"

    @cached_property
    def posed(self) -> WellPosed:
        return check_problem(self.problem, self.few if self.value is None else self.wide)

    @cached_property
    def policies(self) -> dict[str, Policy]:
        return self.policies_of(self.fields)

    @cached_property
    def _simulated(self) -> tuple[dict[str, Simulated], Estimate | None]:
        if not self.settings.trajectories:
            return {}, None
        self.progress("simulation")
        initial = None if self.sampled_value is None else self.sampled_value.initial
        return simulate_candidates(self.problem, self.policies, self.value, initial, self.settings, self.seed)

    @property
    def perf(self) -> dict[str, Estimate | None]:
        found, _ = self._simulated
        return {name: found[name].perf if name in found else None for name in ("value", "density")}

    @property
    def zero(self) -> Estimate | None:
        return self._simulated[1]

    @cached_property
    def kind(self) -> str:
        """The controller with the lower performance, or the first where none is known."""
        known = {name: s.perf.above for name, s in self._simulated[0].items() if s.perf.finite}
        return min(known, key=known.__getitem__, default=next(iter(self.policies)))

    @property
    def has_densities(self) -> bool:
        """Whether there is a trained `w`, of which a divergence is known."""
        return self.fields.control_density is not None and self.problem.gives_divergences

    @cached_property
    def densities(self) -> DensityBounds | None:
        return sharpened(self.densities_on, self.problem, self.few, self.seed) if self.has_densities else None

    def densities_on(self, sets: list[Samples]) -> DensityBounds:
        """`J` and `G` of the trained `w` and `mu` on ``sets``."""
        form = (self.occupation, self.problem, self.fields, self.constants)
        return density_bounds(self.problem, admissible_density(*form), self._mu, sets, self.constants.C_V)

    @cached_property
    def _mu(self) -> Density:
        return occupation_density(self.occupation, self.problem, self.fields, self.constants)

    @cached_property
    def _fit(self) -> tuple[ClosedLoopBounds | None, list[str]]:
        """The bounds of `mu` fitted to the closed loop of the controller handed out, or a warning that says why not."""
        if not self.settings.stage.steps:
            return None, []
        kind = self.kind  # before this part is announced: it may have to be simulated
        self.progress("closed-loop fit")
        if not self.problem.gives_divergences:
            return None, ["no upper bound without simulation: this problem gives no divergences of a and B."]
        problem, trained, policy = self.problem, self.trained, self.policies_of(self.trained.fields)[kind]
        how = self.constants, self.settings.stage, self.seed
        try:
            fitted = in_float64(fit_closed_loop(problem, policy, trained.fields, trained.network, *how))
        except ArithmeticError as error:
            return None, [f"the certification stage failed: {error}"]
        V = self.sampled_value
        value, initial = (fitted.value, None) if V is None else (V.value, V.initial)
        return self.bounds_of(self.policies[kind], value, fitted.log_occupation, initial), []

    @property
    def fitted(self) -> ClosedLoopBounds | None:
        return self._fit[0]

    @property
    def hidden(self) -> Hidden | None:
        found = (bounds.hidden for bounds in (self.densities, self.fitted) if bounds is not None)
        return next((hidden for hidden in found if hidden is not None), None)

    @cached_property
    def observed(self) -> Observed:
        kind = self.kind
        self.progress("assumptions")
        simulated = self._simulated[0].get(kind)
        usable = simulated if simulated is not None and simulated.perf.finite else None
        states = self.settings.occupation_states
        return observe(self.problem, self.policies[kind], usable, self.few, self.posed, states)

    @property
    def notes(self) -> list[str]:
        notes = []
        if self.kind == "density" and self.densities is not None:
            with torch.no_grad():
                if any(bool((self._mu(samples.x[:LOOKED_AT]) <= 0.0).any()) for samples in self.few):
                    notes.append(
                        "mu is 0 at sampled states, where w / mu is not regular: J and G may miss what it costs there."
                    )
        return notes + self._fit[1]

    @property
    def remarks(self) -> list[str]:
        """What a user should know of the controllers themselves."""
        notes = [
            f"the performance of the controller from {name} is not finite; it is left out."
            for name, estimate in self.perf.items()
            if estimate is not None and not estimate.finite
        ]
        known = [e.above for e in self.perf.values() if e is not None and e.finite]
        if known and self.zero is not None and min(known) > self.zero.above:
            notes.append("the best controller is worse than doing nothing.")
        return notes
