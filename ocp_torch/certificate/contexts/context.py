"""What the bounds of one certificate share: a problem, states, functions and results, each computed once."""

import contextlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from ocp_torch.certificate.checks.assumptions import Assumptions, check_assumptions, value_holds
from ocp_torch.certificate.checks.hidden import Hidden
from ocp_torch.certificate.checks.observed import Observed
from ocp_torch.certificate.checks.wellposed import WellPosed, check_problem
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.settings import CERTIFIED, CertificateSettings, Progress, Run, silent
from ocp_torch.certificate.simulated.candidates import Candidate, first_look, simulate_candidates
from ocp_torch.certificate.simulated.outside import time_outside
from ocp_torch.certificate.simulated.performance import Simulated
from ocp_torch.certificate.statistics.estimate import Estimate, replicated_samples
from ocp_torch.certificate.statistics.tails import sharpened
from ocp_torch.certificate.upper.lagrangian import ClosedLoopBounds, closed_loop_bounds
from ocp_torch.certificate.upper.penalised import DensityBounds
from ocp_torch.control.policies import DENSITY, Policy
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.jets import Field
from ocp_torch.maths.peaks import Peaks
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.needs import GUESSED
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.scan import odd_states

# A divergence takes a reverse pass through a network for each control at each state: upper sides and residuals are computed
# on one state in eight, and beyond sixteen dimensions on one in `d / 2`.
DIVERGENCE_PART = 8
# The problem is scanned as if a certificate had at least so many states: a feature that the scan misses every bound misses.
LEAST_SCANNED = 2**17


@dataclass(frozen=True, eq=False)
class Context:
    """The base of the three kinds: trained fields, a given controller, recorded samples.

    ``kind`` names the controller that is handed out, ``candidates`` are all that can be simulated. ``fitted`` are the bounds
    of the density that was fitted to the closed loop. ``first_warnings`` stand before those of the bounds, ``last_warnings``
    after.
    """

    problem: Problem
    constants: Constants
    settings: CertificateSettings
    run: Run
    progress: Progress = silent
    results: dict = field(default_factory=dict, init=False)  # what a bound has computed and needs again, by name

    recorded = external = False  # whether it is of recorded samples, or of a given controller
    divergent = ""  # which bounds take a divergence, in words
    always_listed: ClassVar[tuple[str, ...]] = ()  # controllers that are named even if they were not simulated
    if TYPE_CHECKING:  # each kind gives these itself, as a field, a constant or a property

        @property
        def kind(self) -> str | None: ...
        @property
        def value(self) -> Field | None: ...  # `V` in float64
        @property
        def fitted(self) -> ClosedLoopBounds | None: ...
        @property
        def candidates(self) -> dict[str, Candidate]: ...
        @property
        def observed(self) -> Observed: ...
        @property
        def last_warnings(self) -> list[str]: ...

    @property
    def followed(self) -> str | None:
        """The controller whose closed loop is checked and fitted: the one handed out, where that acts at every instant."""
        return self.kind

    @property
    def controller_fixed(self) -> bool:
        """Whether the controller that is handed out was chosen before."""
        return False

    def held_for(self, name: str | None) -> float | None:
        """For how long the controller ``name`` holds its control; `None` for one that acts at every instant."""
        return None

    def value_holds_of(self, name: str) -> bool:
        """Whether no simulated value of the controller ``name`` exceeds `C_V`."""
        found = self.simulated[0].get(name)
        return found is None or value_holds(found.largest_value, self.constants)

    @property
    def saved_subsolution(self) -> Subsolution | None:
        """The function that the lower bound was of before: `V` need not be trained on for it again."""
        return None

    @property
    def first_warnings(self) -> list[str]:
        return []

    @property
    def occupation(self) -> str | None:
        return None

    @property
    def densities(self) -> DensityBounds | None:
        """`J` and `G` of trained `w` and `mu`."""
        return None

    @property
    def coarse(self) -> bool:
        """Whether the controller computes in a precision too low for its divergence."""
        return False

    @property
    def seed(self) -> int:
        return self.run.seed

    @cached_property
    def value_samples(self) -> list[Samples]:
        """Independent sets of many states, for expectations and suprema of `V` and its slack."""
        return replicated_samples(self.problem, self.settings.points, self.settings.replicates, self.seed, False)

    @cached_property
    def divergence_samples(self) -> list[Samples]:
        """Independent sets of fewer states, for bounds that take divergences."""
        count = max(1, self.settings.points // max(DIVERGENCE_PART, self.problem.dim // 2))
        return replicated_samples(self.problem, count, self.settings.replicates, self.seed, not self.external)

    @cached_property
    def narrow_states(self) -> Tensor | None:
        """States ``(K, d)`` where the problem's data are unlike elsewhere: narrow features that sampled states miss."""
        scanned = self.problem.scan_factor * max(self.settings.points * self.settings.replicates, LEAST_SCANNED)
        return odd_states(self.problem, scanned, self.seed)

    @cached_property
    def well_posed(self) -> WellPosed:
        """What the checks of the problem itself found."""
        return check_problem(self.problem, self.value_samples, lambda: self.narrow_states)

    @cached_property
    def sampled_value(self) -> SampledValue | None:
        """`V` on the wide sets."""
        if self.value is None:
            return None
        search = self.settings.searches(self.constants)
        odd, kept, s = self.narrow_states, self.saved_subsolution, self.settings
        how = s.ascents, search, self.seed, odd, kept, s.bound_steps, s.audited
        return SampledValue(self.problem, self.value, self.value_samples, *how)

    def ahead(self) -> contextlib.AbstractContextManager[None]:
        """A context in which a second core works on the lower side, beside simulation and the upper side."""
        return contextlib.nullcontext() if self.sampled_value is None else self.sampled_value.ahead()

    @property
    def remembered(self) -> dict[str, Simulated]:
        """What an earlier certificate simulated of controllers that are the same, by name."""
        return {}

    @cached_property
    def looked(self) -> dict[str, Simulated]:
        """What a first look shows of the controllers, by name: some are simulated roughly at first."""
        if not self.settings.trajectories or not self.candidates:
            return {}
        self.progress("simulation")
        # Where the controller with the best certified bound is handed out, none can be left out.
        best_only = not self.external and self.settings.prefer != CERTIFIED
        return first_look(*self._asked, best_only, self.remembered, self.expected)

    @cached_property
    def simulated(self) -> tuple[dict[str, Simulated], Estimate | None]:
        """What simulation shows of the controllers, by name, and what doing nothing costs."""
        return simulate_candidates(*self._asked, self.looked) if self.looked else ({}, None)

    @property
    def _asked(self) -> tuple[Problem, dict[str, Candidate], CertificateSettings, int]:
        return self.problem, self.candidates, self.settings, self.seed

    @property
    def expected(self) -> str | None:
        """The controller that will be handed out, or probably, if that is known before any is simulated."""
        return self.kind if self.controller_fixed else None

    def outside(self, name: str | None) -> Estimate | None:
        """The part of the discounted time that the controller ``name`` spends outside the box of a system."""
        handed_out = self.candidates.get(name) if name in self.simulated[0] else None
        return handed_out and time_outside(self.problem, handed_out.policy, self.settings, self.seed)

    def bounds_of(
        self, name: str | None, policy: Policy, value: Field, log_occupation: Field, initial: list[float] | None
    ) -> ClosedLoopBounds:
        """The bounds of the closed loop of ``policy``, the controller ``name``, by any ``value`` and ``log_occupation``, all
        in float64; ``initial`` is `E[V mu0]` per set, if that is known from more states."""
        loop, ascents, sought = ClosedLoop(self.problem, policy), self.settings.ascents, list[Peaks]()

        def judge(sets: list[Samples]) -> ClosedLoopBounds:
            before = sought[-1] if sought else None
            at = loop.samples_of(sets)
            found = closed_loop_bounds(
                loop, value, log_occupation, at, ascents, name, initial, self.narrow_states, before
            )
            sought.append(found.sought)
            return found

        return sharpened(judge, self.problem, self.divergence_samples, self.seed)

    @property
    def largest_density(self) -> float | None:
        """The largest density met under the controller that is nearest to the optimal one."""
        return self.observed.sup_occupation

    @cached_property
    def effective_constants(self) -> Constants:
        """The constants by which bounds are computed: an `M` that was not given follows from the density met."""
        guessed = self.constants.basis("M") == GUESSED  # else the density need not be computed
        return self.constants.informed(self.largest_density) if guessed else self.constants

    @property
    def hidden(self) -> Hidden | None:
        """A divergence that the sampled states do not see."""
        found = (bounds.hidden for bounds in (self.densities, self.fitted) if bounds is not None)
        return next((hidden for hidden in found if hidden is not None), None)

    @property
    def uses(self) -> tuple[bool, bool]:
        """Whether there is a lower side, which rests on `M`, and an upper side that rests on the `C_V` of the constants."""
        return self.value is not None, self.densities is not None

    @cached_property
    def checked(self) -> Assumptions:
        """The assumptions as the checks leave them."""
        return check_assumptions(self.problem, self.effective_constants, self.well_posed, self.observed, self.uses)

    @cached_property
    def closed_loop(self) -> ClosedLoopBounds | None:
        """``fitted``, where nothing jumps and no divergence is hidden: else its formulas do not hold, and a wrong number is
        not shown at all."""
        usable = self.fitted is not None and self.hidden is None and self.checked.regular_holds
        return self.fitted if usable else None

    @cached_property
    def shows_fitted_J(self) -> bool:
        """Whether the `J` of the closed loop is shown: unless the `J` of the trained densities is of the same controller,
        with a `C_V` that holds, and no larger."""
        if self.closed_loop is None:
            return False
        own = self.densities if self.followed == DENSITY and self.checked.value_holds else None
        return own is None or not own.J.value <= self.closed_loop.J.value

    @cached_property
    def assumptions(self) -> Assumptions:
        """What the bounds rest on, after all checks."""
        found = self.checked if self.hidden is None else replace(self.checked, regular_holds=False)
        # A C_V proved for a given controller stands whatever its divergence; for trained fields it is used with their J.
        proved = self.fitted if self.external else self.closed_loop if self.shows_fitted_J else None
        return found if proved is None else found.with_value_bound(proved.C_V)
