"""What the bounds of one certificate share: a problem, states, functions, and what was found of them, each computed once."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

from torch import Tensor

from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.checks.check import check_assumptions
from ocp_torch.certificate.checks.hidden import Hidden
from ocp_torch.certificate.checks.observed import Observed
from ocp_torch.certificate.checks.tails import sharpened
from ocp_torch.certificate.checks.wellposed import WellPosed, check_problem
from ocp_torch.certificate.estimate import Estimate, replicated_samples
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.progress import Progress, silent
from ocp_torch.certificate.run import Run
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.upper.lagrangian import ClosedLoopBounds, closed_loop_bounds
from ocp_torch.certificate.upper.penalised import DensityBounds
from ocp_torch.control.policies import Policy
from ocp_torch.maths.jets import Field
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.scan import odd_states

# A divergence takes a reverse pass through a network for each control at each state: what needs it, upper sides and
# residuals, is computed on one state in eight, and beyond sixteen dimensions on one in `d / 2`.
DIVERGENCE_PART = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class Context:
    """The base of the three kinds: trained fields, a given controller, recorded samples.

    ``kind`` names the controller that is handed out, ``subject`` likewise where it is no choice between several. ``perf``
    and ``zero`` are simulated performances, of controllers by name and of doing nothing. ``fitted`` are the bounds of the
    density that was fitted to the closed loop, ``hidden`` is a divergence that the sampled states do not see. ``notes`` are
    warnings before those of the bounds, ``remarks`` after them.
    """

    problem: Problem
    constants: Constants
    settings: CertificateSettings
    run: Run
    progress: Progress = silent  # told the name of each part as it begins
    results: dict = field(default_factory=dict, init=False)  # of functions that bounds declare to be computed `once`

    recorded = external = False  # whether it is of recorded samples, or of a controller that somebody brings
    divergent = ""  # which bounds take a divergence, in words
    if TYPE_CHECKING:  # each kind gives these itself, as a field, a constant or a property

        @property
        def kind(self) -> str | None: ...
        @property
        def value(self) -> Field | None: ...  # `V` in float64
        @property
        def fitted(self) -> ClosedLoopBounds | None: ...
        @property
        def hidden(self) -> Hidden | None: ...
        @property
        def perf(self) -> dict[str, Estimate | None]: ...
        @property
        def zero(self) -> Estimate | None: ...
        @property
        def observed(self) -> Observed: ...
        @property
        def notes(self) -> list[str]: ...
        @property
        def remarks(self) -> list[str]: ...

    @property
    def subject(self) -> str | None:
        return None

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

    @property
    def exact(self) -> float | None:
        """`OPT`, where the problem knows it."""
        return self.problem.exact_optimum

    @cached_property
    def wide(self) -> list[Samples]:
        """Independent sets of many states, for expectations and suprema of `V` and its slack."""
        return self._sets(self.settings.points, divergences=False)

    @cached_property
    def few(self) -> list[Samples]:
        """Sets of fewer, for what takes divergences."""
        part = max(DIVERGENCE_PART, self.problem.dim // 2)
        return self._sets(max(1, self.settings.points // part), divergences=not self.external)

    def _sets(self, count: int, divergences: bool) -> list[Samples]:
        return replicated_samples(self.problem, count, self.settings.replicates, self.seed, divergences)

    @cached_property
    def odd(self) -> Tensor | None:
        """States ``(K, d)`` where the problem's data are unlike elsewhere: narrow features that sampled states miss."""
        return odd_states(self.problem, self.settings.scanned(self.problem), self.seed)

    @cached_property
    def posed(self) -> WellPosed:
        """Whether the problem is one."""
        return check_problem(self.problem, self.wide)

    @cached_property
    def sampled_value(self) -> SampledValue | None:
        """`V` on the wide sets."""
        if self.value is None:
            return None
        search = self.settings.searches(self.constants)
        return SampledValue(self.problem, self.value, self.wide, self.settings.ascents, search, self.seed, self.odd)

    def bounds_of(
        self, policy: Policy, value: Field, log_occupation: Field, initial: list[float] | None
    ) -> ClosedLoopBounds:
        """The bounds of the closed loop of ``policy`` by any ``value`` and ``log_occupation``, all in float64; ``initial`` is
        `E[V mu0]` per set, if that is known from more states."""
        loop, ascents = ClosedLoop(self.problem, policy), self.settings.ascents
        judge = lambda sets: closed_loop_bounds(
            loop, value, log_occupation, loop.samples_of(sets), ascents, self.kind, initial, self.odd
        )
        return sharpened(judge, self.problem, self.few, self.seed)

    @property
    def uses(self) -> tuple[bool, bool]:
        """Whether there is a lower side, which rests on `M`, and an upper side that rests on the `C_V` of the constants."""
        return self.value is not None, self.densities is not None

    @cached_property
    def _check(self) -> tuple[Assumptions, list[str]]:
        return check_assumptions(self.problem, self.constants, self.observed, self.uses)

    @property
    def checked(self) -> Assumptions:
        """The assumptions as the checks leave them."""
        return self._check[0]

    @property
    def check_notes(self) -> list[str]:
        """A warning for each check that failed."""
        return self._check[1]

    @cached_property
    def closed_loop(self) -> ClosedLoopBounds | None:
        """``fitted``, where nothing jumps and no divergence is hidden: else it is not what the formulas see, and a wrong
        number is not shown at all."""
        usable = self.fitted is not None and self.hidden is None and self.checked.regular_holds
        return self.fitted if usable else None

    @cached_property
    def takes_fitted_J(self) -> bool:
        """Whether the `J` of the closed loop is shown: unless that of the trained densities is of the controller handed out,
        with a `C_V` that holds, and no larger."""
        if self.closed_loop is None:
            return False
        own = self.densities if self.kind == "density" and self.checked.value_holds else None
        return own is None or not own.J.value <= self.closed_loop.J.value

    @property
    def proved_C_V(self) -> float | None:
        """The `C_V` that the bounds of the closed loop prove for the controller, where it is used."""
        return self.closed_loop.C_V if self.closed_loop and self.takes_fitted_J else None

    @cached_property
    def assumptions(self) -> Assumptions:
        """What the bounds rest on, in the end."""
        found = self.checked if self.hidden is None else replace(self.checked, regular_holds=False)
        return found if self.proved_C_V is None else found.with_value_bound(self.proved_C_V)
