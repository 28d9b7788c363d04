r"""The context of one given controller: what it costs, and how far from optimal it is.

`V^u` and `mu^u` are fitted to its closed loop by least squares (P(u) and D(u), section 5.4 of the paper); the fitted `V`
is the control variate of the simulation and, with the suprema of its Bellman slack, bounds `V^u` on both sides. A second
`V`, trained for the optimum, gives the lower bound on `OPT` and a controller to compare with.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import nn

from ocp_torch.certificate.checks.observed import Observed, observe
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.contexts.fields import in_float64
from ocp_torch.certificate.external.black_box import BlackBox
from ocp_torch.certificate.simulated.candidates import Candidate
from ocp_torch.certificate.statistics.estimate import integral
from ocp_torch.certificate.upper.lagrangian import ClosedLoopBounds
from ocp_torch.certificate.upper.policy_evaluation import fit_closed_loop
from ocp_torch.control.policies import Policy, ValuePolicy
from ocp_torch.fields.fields import Fields
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.jets import Field

# The name under which the controller's performance stands in a certificate.
GIVEN = "given"


@dataclass(frozen=True, eq=False, kw_only=True)
class ControllerContext(Context):
    """``policy`` is the controller; ``value`` (float64), any `V`, says how far from optimal it is at most, for which the
    ``saved_subsolution`` was trained before; ``network`` makes the networks for `V^u` and `mu^u`. Raises `InputError` where
    the policy fails."""

    policy: Policy
    value: Field | None
    network: Callable[..., nn.Module]
    saved_subsolution: Subsolution | None = None

    external = True
    kind = GIVEN
    divergent = "J and the Lagrangian bound"

    @property
    def coarse(self) -> bool:
        return isinstance(self.policy, BlackBox) and self.policy.precision is torch.float32

    @cached_property
    def _attempt(self) -> tuple[Fields | None, list[str]]:
        """`V^u` and `log mu^u`, in float64, or a warning that says why not."""
        if not self.settings.stage.steps:
            return None, []
        self.progress("closed-loop fit")
        if unknown := self.problem.unknown_divergences:
            return None, [f"no bound on Perf without simulation: this problem gives no divergences of {unknown}."]
        how = self.constants, self.settings.stage, self.seed
        try:
            return in_float64(fit_closed_loop(self.problem, self.policy, None, self.network, *how)), []
        except ArithmeticError as error:
            return None, [f"the certification stage failed: {error}"]

    @property
    def _fit(self) -> Fields | None:
        return self._attempt[0]

    @cached_property
    def _initial(self) -> list[float] | None:
        """`E[V^u mu0]`, per set."""
        if self._fit is None:
            return None
        with torch.no_grad():
            return [integral(s, self._fit.value(s.x) * s.mu0) for s in self.value_samples]

    @cached_property
    def fitted(self) -> ClosedLoopBounds | None:
        if self._fit is None:
            return None
        return self.bounds_of(self.followed, self.policy, self._fit.value, self._fit.log_occupation, self._initial)

    @property
    def candidates(self) -> dict[str, Candidate]:
        own = None if self._fit is None else self._fit.value
        found = {GIVEN: Candidate(self.policy, own, self._initial)}
        if (V := self.sampled_value) is not None:
            found["value"] = Candidate(ValuePolicy(self.problem, V.value), V.value, V.initial)
        return found

    @cached_property
    def observed(self) -> Observed:
        found, _ = self.simulated
        self.progress("assumptions")
        met = observe(self.problem, self.policy, found.get(GIVEN), self.divergence_samples, 0)
        if self.value is None or "value" not in found:
            return met
        # M is about the optimal controller, to which the one from V is nearer than the given one.
        best, states = ValuePolicy(self.problem, self.value), self.settings.occupation_states
        near = observe(self.problem, best, found["value"], self.divergence_samples, states)
        return replace(met, sup_occupation=near.sup_occupation, a_priori_occupation=near.a_priori_occupation)

    @property
    def last_warnings(self) -> list[str]:
        notes = [] if self.value is not None else ["no lower bound: there is no V to give one."]
        return notes + self._attempt[1]
