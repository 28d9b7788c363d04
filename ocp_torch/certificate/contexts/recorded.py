r"""The context of recorded samples: expectations on samples held out, nothing simulated, no state evaluated anew.

`F_M(V)` and `J(w, mu)` are expectations over the torus of pointwise functions of the data, so weighted means over independent
samples estimate them without bias, with errors from their scatter. Samples give no suprema: the shifted and the Lagrangian
bound are left out, and `M` and `C_V` are estimates, and said to be.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch

from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.checks.hidden import Hidden, hidden_divergence
from ocp_torch.certificate.checks.observed import Observed, largest_jump
from ocp_torch.certificate.checks.wellposed import WellPosed
from ocp_torch.certificate.contexts.fields import FieldsContext, in_float64
from ocp_torch.certificate.statistics.estimate import Estimate, starting_level, starting_mean
from ocp_torch.certificate.statistics.tails import widened
from ocp_torch.certificate.upper.multiples import best_multiples, terms_on
from ocp_torch.certificate.upper.policy_evaluation import FixedPool, fit_closed_loop
from ocp_torch.certificate.upper.recorded import RecordedFit, closed_loop_samples, highest_occupation
from ocp_torch.control.policies import NETWORK
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.needs import SEARCHED
from ocp_torch.problems.problem import MARGIN
from ocp_torch.problems.recorded.dataset import Dataset
from ocp_torch.problems.samples import Samples

GROUPS = 64  # groups of held-out samples at most, the scatter of whose means gives the standard error
FEWEST_SAMPLES = 8  # in a group, unless that leaves fewer than two groups


@dataclass(frozen=True, eq=False)
class RecordedContext(FieldsContext):
    """Fields trained on recorded samples of ``problem``, evaluated on those that were held out."""

    problem: Dataset

    recorded = True
    sampled_value = fitted = None
    candidates: ClassVar[dict] = {}

    @cached_property
    def sets(self) -> list[Samples]:
        """The held-out samples in groups."""
        return groups(self.problem.held_out)

    @property
    def kind(self) -> str | None:
        """The controller: from `V` where `B` is known everywhere, else `w / mu` of two networks, else none."""
        trained = self.trained
        if trained.fields.value is not None and self.problem.knows_control_matrix:
            return "value"
        return "density" if trained.fields.control_density is not None and trained.occupation == NETWORK else None

    @cached_property
    def _fit(self) -> tuple[RecordedFit | None, list[str]]:
        """`J` of the controller, or a warning that says why there is none."""
        if self.kind is None:
            why = "B varies over the samples, so that from V is known at them only; use method=pd"
            return None, [f"no controller: {why}."]
        if not self.problem.gives_divergences:
            spread = "; where the noise varies div_D and div_div_D too" if self.problem.noisy else ""
            return None, [f"no upper bound: the recording holds no div_a (and, where B varies, no div_B{spread})."]
        if not self.settings.stage.steps:
            return None, []
        try:
            return fit_recorded(self, self.kind), []
        except ArithmeticError as error:
            return None, [f"the certification stage failed: {error}"]

    @property
    def fit(self) -> RecordedFit | None:
        return self._fit[0]

    @property
    def hidden(self) -> Hidden | None:
        return self.fit.hidden if self.fit else None

    @property
    def uses(self) -> tuple[bool, bool]:
        return self.value is not None, self.fit is not None and self.hidden is None

    @cached_property
    def well_posed(self) -> WellPosed:
        """The result of the checks made on reading the file; samples cannot show a jump at the seam."""
        samples, recording = self.problem.held_out, self.problem.recording
        mass = float(recording.samples.mean(recording.samples.mu0))
        return WellPosed(True, True, True, float(samples.f.min()), mass, [])

    @cached_property
    def observed(self) -> Observed:
        occupation = self.fit.sup_occupation if self.fit else None
        if self.kind is None:
            return Observed(occupation)
        policy = self.policies[self.kind]
        with torch.no_grad():
            control = max(float(policy(s.x).norm(dim=-1).max()) for s in self.sets)
        return Observed(occupation, sup_control=control, jump=largest_jump(policy, self.problem.dim))

    @cached_property
    def assumptions(self) -> Assumptions:
        C_V = self.fit.C_V if self.fit and self.hidden is None else None
        return replace(self.checked, C_V=C_V, basis=self.checked.basis | {"C_V": SEARCHED})

    @property
    def first_warnings(self) -> list[str]:
        weighted = bool((self.problem.held_out.weight != 1.0).any())
        return [
            f"from {sum(map(len, self.sets)):,} held-out samples, taken for independent draws from "
            f"{'the density given with them' if weighted else 'the uniform law'}; nothing was simulated.",
            *self.problem.recording.notes,
            *self._fit[1],
        ]

    @property
    def last_warnings(self) -> list[str]:
        if not self.settings.rigorous:
            return []
        return ["no rigorous lower bound: samples say nothing about the states between them."]


def groups(samples: Samples) -> list[Samples]:
    """Disjoint groups of equal size, in the random order of the split; the few left over are not used."""
    count = max(2, min(GROUPS, len(samples) // FEWEST_SAMPLES))
    size = len(samples) // count
    return [samples.take(slice(k * size, (k + 1) * size)) for k in range(count)]


def fit_recorded(context: RecordedContext, kind: str) -> RecordedFit:
    """`J(mu u, mu)` of the controller ``kind``, on held-out samples, with `log mu` fitted on the training samples.

    By parts `E[(f + R(u)) mu] = E[V mu0 - mu Q_u - V r]`, the same number with less scatter. `C_V` is the larger of the
    constant's and of `sup V + sup max(-Q_u, 0)`, which bounds `V^u`, over all samples and with head-room. Raises
    `ArithmeticError` where the fit fails.
    """
    problem, trained, constants, seed = context.problem, context.trained, context.constants, context.seed
    cost, rho, stage = problem.control_cost, problem.discount, context.settings.stage
    policy, rough = (context.policies_of(fields)[kind] for fields in (context.fields, trained.fields))
    like = next(trained.fields.parameters())
    training = closed_loop_samples(problem.training.to(like), rough, cost)
    pool = FixedPool(training, derive_seed(seed, Branch.POLICY_EVALUATION, 2))
    fitted = in_float64(fit_closed_loop(problem, rough, trained.fields, trained.network, constants, stage, seed, pool))
    value = context.value if context.value is not None else fitted.value
    loops = [closed_loop_samples(samples, policy, cost) for samples in context.sets]
    found = [terms_on(Generator(loop, rho, cost), value, fitted.log_occupation) for loop in loops]
    terms, slacks, densities, fluxes = zip(*found, strict=True)
    seen = training.to(torch.zeros((), dtype=torch.float64))
    with torch.no_grad():
        generator = Generator(seen, rho, cost)
        V = generator.jet(value)
        slack = generator.hjb_slack(V)
    largest = max(0.0, *(float(v.max()) for v in (*(t.v for t in terms), V.value)))
    deepest = max(0.0, *(float(-q.min()) for q in (*slacks, slack)))
    C_V = max(constants.C_V, MARGIN * (largest + deepest))
    excess = best_multiples(terms, lambda t, s: t.J(s, C_V))
    level = starting_level(seen, V.value)
    J = [starting_mean(t.samples, t.v, level) + e for t, e in zip(terms, excess, strict=True)]
    highest = highest_occupation(torch.cat(densities), Samples.concatenate(loops), rho)
    estimate = widened(
        Estimate.of(J, controller=kind),
        [t.samples.weight * (t.J(1.0, C_V) + (t.v - level) * t.samples.mu0) for t in terms],
    )
    return RecordedFit(estimate, C_V, highest, hidden_divergence(list(fluxes)))
