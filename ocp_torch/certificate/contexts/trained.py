"""What the bounds of trained fields share, where the problem can be simulated."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch

from ocp_torch.certificate.checks.observed import Observed, observe
from ocp_torch.certificate.checks.wellposed import WellPosed, check_problem
from ocp_torch.certificate.contexts.fields import FieldsContext, in_float64
from ocp_torch.certificate.report import the_controller
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated.candidates import Candidate
from ocp_torch.certificate.simulated.performance import Simulated
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.certificate.statistics.tails import sharpened
from ocp_torch.certificate.upper.lagrangian import ClosedLoopBounds
from ocp_torch.certificate.upper.penalised import DensityBounds, density_bounds
from ocp_torch.certificate.upper.policy_evaluation import fit_closed_loop
from ocp_torch.compute.background import BackgroundResult
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.policies import (
    BOUNDING,
    CLOSED,
    DENSITY,
    MINIMISED,
    TRAJECTORIES,
    VALUE,
    Density,
    admissible_density,
    occupation_density,
)
from ocp_torch.fields.fields import Fields
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.samples import Samples

CHECKED_STATES = 4096  # states of each set at which the density is checked for places without mass


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedContext(FieldsContext):
    """The controllers of `trained_policies`: all are simulated, and the best is handed out."""

    divergent = "J, G and the Lagrangian bound"

    @cached_property
    def well_posed(self) -> WellPosed:
        sets = self.divergence_samples if self.value is None else self.value_samples
        return check_problem(self.problem, sets, lambda: self.narrow_states)

    @cached_property
    def candidates(self) -> dict[str, Candidate]:
        sampled, own = self.sampled_value, self.fields.trajectory_value
        initial = None if sampled is None else sampled.initial
        single = self.fields.rounded
        rounded = {name: (policy, single.value) for name, policy in self.policies_of(single).items()}
        found = {name: Candidate(policy, self.value, initial, rounded[name]) for name, policy in self.policies.items()}
        if sampled is not None and own is not None:  # the controller from its V has a control variate of its own
            initial = replace(sampled, value=own, search=False).initial
            beside = (rounded[TRAJECTORIES][0], single.trajectory_value)
            found[TRAJECTORIES] = Candidate(self.policies[TRAJECTORIES], own, initial, beside)
        return found

    @property
    def tightened(self) -> Subsolution | None:
        """`V` trained on for its bound, as the certificate would train it, where that promises enough and there is no noise:
        its controller may be the best one. Beside that the others are simulated, which the certificate remembers. Raises
        `ProblemError` where a function of the problem is not finite."""
        sampled = self.sampled_value
        if sampled is None or not sampled.search or self.problem.noisy:
            return None
        _ = self.well_posed  # before anything is simulated
        with sampled.ahead(sampled.tightened):
            _ = self.simulated
            self.progress("lower bound")
            return sampled.tightened.answer()

    @property
    def remembered(self) -> dict[str, Simulated]:
        found = {name: self.trained.memory.recall(name, *self._made_with) for name in self.policies}
        return {name: simulated for name, simulated in found.items() if simulated is not None}

    @cached_property
    def simulated(self) -> tuple[dict[str, Simulated], Estimate | None]:
        found, zero = super().simulated
        for name, simulated in found.items():
            self.trained.memory.keep(simulated, name, *self._made_with)
        return found, zero

    @property
    def _made_with(self) -> tuple[Fields, CertificateSettings, int, Constants]:
        return self.fields, self.settings, self.seed, self.constants

    @cached_property
    def kind(self) -> str:
        """The controller that was handed out, or else the one with the lowest performance."""
        return self.trained.kind or self._best_of(list(self.policies))

    @property
    def controller_fixed(self) -> bool:
        return self.trained.kind is not None

    @cached_property
    def followed(self) -> str:
        return self._best_of(self._acting or [self.kind])

    @property
    def _acting(self) -> list[str]:
        """The controllers that act at every instant."""
        return [name for name, policy in self.policies.items() if not isinstance(policy, HeldPolicy)]

    def _best_of(self, names: list[str], at_first: bool = False) -> str:
        """The one of the controllers ``names`` with the lowest performance, by a first look or by all simulations; the first
        where none is known."""
        found = {} if len(names) == 1 else self.looked if at_first else self.simulated[0]
        return self._best_in({name: found[name] for name in names if name in found}) or names[0]

    def _best_in(self, found: dict[str, Simulated]) -> str | None:
        """The controller with the lowest performance ``found``; `None` where none is finite."""
        known = {name: simulated.perf.above for name, simulated in found.items() if simulated.perf.finite}
        return min(known, key=known.__getitem__, default=None)

    @property
    def expected(self) -> str | None:
        """The controller that was chosen before; else that of `V` trained on, where that of `V` itself is the best one known:
        it was .08 to .28 % better on six dubins, unicycles and arms, and .02 % worse on a pendulum."""
        if self.controller_fixed or BOUNDING not in self.policies:
            return super().expected
        return BOUNDING if self._best_in(self.remembered) == VALUE else None

    def held_for(self, name: str | None) -> float | None:
        policy = self.policies.get(name or self.kind)
        return policy.pace.step if isinstance(policy, HeldPolicy) else None

    @property
    def has_densities(self) -> bool:
        """Whether there is a trained `w` whose divergence is known."""
        return self.fields.control_density is not None and self.problem.gives_divergences

    @cached_property
    def densities(self) -> DensityBounds | None:
        if not self.has_densities:
            return None
        return sharpened(self.densities_on, self.problem, self.divergence_samples, self.seed)

    def densities_on(self, sets: list[Samples]) -> DensityBounds:
        """`J` and `G` of the trained `w` and `mu` on ``sets``."""
        w = admissible_density(self.occupation, self.problem, self.fields, self.constants)
        return density_bounds(self.problem, w, self._mu, sets, self.constants.C_V)

    @cached_property
    def _mu(self) -> Density:
        return occupation_density(self.occupation, self.problem, self.fields, self.constants)

    @contextlib.contextmanager
    def ahead(self) -> Iterator[None]:
        """A context in which other cores work on the upper side, of the controller that leads after a first look, and on the
        lower one: as many of the two as there are cores for."""
        upper: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        if self._acting and self.settings.stage.steps and self.problem.copyable:
            _ = self.divergence_samples, self.sampled_value and self.sampled_value.initial  # needed here as well
            leader = None if self.controller_fixed else self.expected
            upper = self._fitting(leader or self._best_of(self._acting, at_first=True)).ahead()
        with upper, super().ahead():
            yield

    @cached_property
    def _fit(self) -> tuple[ClosedLoopBounds | None, list[str]]:
        """The bounds of `mu` fitted to the closed loop of the controller that is followed, or a warning that says why not."""
        if not self.settings.stage.steps:
            return None, []
        kind = self.followed  # before this part is announced: it may have to be simulated
        self.progress("closed-loop fit")
        for other in set(self._acting) & set(self.results) - {kind}:
            self.results[other].stop()  # it was begun for one that was expected to be the best
        _ = self.sampled_value and self.sampled_value.best  # meanwhile, where another core is at the fit
        return self._fitting(kind).answer()

    def _fitting(self, kind: str) -> BackgroundResult[tuple[ClosedLoopBounds | None, list[str]]]:
        """That fit to the closed loop of the controller ``kind``."""
        if kind not in self.results:
            self.results[kind] = BackgroundResult(partial(self._fitted, kind), self.problem)
        return self.results[kind]

    def _fitted(self, kind: str) -> tuple[ClosedLoopBounds | None, list[str]]:
        if unknown := self.problem.unknown_divergences:
            return None, [f"no upper bound without simulation: this problem gives no divergences of {unknown}."]
        problem, trained = self.problem, self.trained
        how = self.constants, self.settings.stage, self.seed
        try:
            policy = self.policies_of(trained.fields)[kind]
            fitted = in_float64(fit_closed_loop(problem, policy, trained.fields, trained.network, *how))
        except ArithmeticError as error:
            return None, [f"the certification stage failed: {error}"]
        V = self.sampled_value
        value, initial = (fitted.value, None) if V is None else (V.value, V.initial)
        return self.bounds_of(kind, self.policies[kind], value, fitted.log_occupation, initial), []

    @property
    def fitted(self) -> ClosedLoopBounds | None:
        return self._fit[0]

    @property
    def largest_density(self) -> float | None:
        """The largest of the fitted density and of the one found backwards in time; `None` where neither is known."""
        fitted = None if self.fitted is None or self.hidden is not None else self.fitted.sup_occupation
        return max((d for d in (fitted, self.observed.sup_occupation) if d is not None), default=None)

    @cached_property
    def observed(self) -> Observed:
        found = self.simulated[0].get(self.followed)
        self.progress("assumptions")
        usable = found if found is not None and found.perf.finite else None
        states, together = self.settings.occupation_states, self.problem.concurrent  # networks of ours are pure
        upper = self.has_densities or self.settings.stage.steps > 0  # bounds that a jump would spoil
        rounded = self.policies_of(self.fields.rounded)[self.followed]
        policy, sets = self.policies[self.followed], self.divergence_samples
        return observe(self.problem, policy, usable, sets, states, together, upper, rounded)

    @property
    def first_warnings(self) -> list[str]:
        notes = list(self._fit[1])
        # The forms of `mu` of those density players' controllers that may be handed out.
        forms = {DENSITY: self.occupation} if self.followed == DENSITY else {}
        forms |= {MINIMISED: CLOSED} if MINIMISED in self.policies else {}
        if self.densities is not None and any(map(self._is_empty_somewhere, forms.values())):
            what = "where w / mu is not regular: J and G may miss what it costs there"
            notes.insert(0, f"mu is 0 at sampled states, {what}.")
        return notes

    @torch.no_grad()
    def _is_empty_somewhere(self, occupation: str | None) -> bool:
        """Whether the `mu` that fields give by ``occupation`` is 0 at a sampled state."""
        mu = occupation_density(occupation, self.problem, self.fields, self.constants)
        return any(bool((mu(samples.x[:CHECKED_STATES]) <= 0.0).any()) for samples in self.divergence_samples)

    @property
    def last_warnings(self) -> list[str]:
        """Warnings about the controllers themselves."""
        found, zero = self.simulated
        notes = [
            f"the performance of {the_controller(name)} is not finite; it is left out."
            for name, simulated in found.items()
            if not simulated.perf.finite
        ]
        known = [simulated.perf.above for simulated in found.values() if simulated.perf.finite]
        if known and zero is not None and min(known) > zero.above:
            notes.append("the best controller is worse than doing nothing.")
        return notes
