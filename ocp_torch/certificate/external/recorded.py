r"""A certificate from recorded samples alone: expectations on samples held out, nothing simulated, no state evaluated anew.

`F_M(V)` and `J(w, mu)` are expectations over the torus of pointwise functions of the data, so weighted means over independent
samples estimate them without bias, with errors from their scatter. What a supremum is needed for cannot be had this way: the
shifted and the Lagrangian bound are left out, and `M` and `C_V` are estimates, and said to be.

The closed loop of a controller that is known at every state (`w / mu` of two networks; from `V` where `B` is constant) has
its data at the recorded states too: `f + R(u)`, `a + B u` and, from `div a` and `div B`, its divergence.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from ocp_torch.certificate.certificate import Certificate, Run
from ocp_torch.certificate.checks.assumptions import Observed, check_assumptions
from ocp_torch.certificate.checks.contradictions import examined
from ocp_torch.certificate.checks.hidden import Flux, Hidden, hidden_divergence
from ocp_torch.certificate.checks.regularity import largest_jump
from ocp_torch.certificate.checks.wellposed import WellPosed
from ocp_torch.certificate.estimate import Estimate, integral
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.upper.lagrangian import Terms, best_multiples
from ocp_torch.certificate.upper.policy_evaluation import fit_closed_loop
from ocp_torch.control.policies import NETWORK, Policy, trained_policies
from ocp_torch.fields.fields import Fields
from ocp_torch.maths import jets
from ocp_torch.maths.jets import CHUNK, chunked_jet
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.needs import SEARCHED
from ocp_torch.problems.problem import MARGIN
from ocp_torch.problems.recorded.dataset import Dataset
from ocp_torch.problems.samples import Samples

# Held-out samples are put into so many groups: the scatter of their means gives the standard error, with nearly as many
# degrees of freedom as there are groups.
GROUPS, FEWEST = 64, 8
# The samples with most mass, at which the contraction of the flow is looked at.
TOP = 10


def certify_recorded(
    problem: Dataset, trained, constants: Constants, settings: CertificateSettings, run: Run
) -> Certificate:
    """The certificate of ``trained`` (`certify.Trained`) fields on the held-out samples of ``problem``."""
    fields = trained.in_float64()
    sets = groups(problem.held_out)
    kind = handed_out(problem, trained)
    warnings = [
        f"from {sum(map(len, sets)):,} held-out samples, taken for independent draws from "
        f"{'the density given with them' if weighted(problem) else 'the uniform law'}; nothing was simulated.",
        *problem.recording.notes,
    ]
    policy = trained_policies(trained.occupation, problem, fields, constants)[kind] if kind else None
    J, sup_occupation, C_V = None, None, constants.C_V
    if kind is None:
        warnings.append(
            "no controller: B varies over the samples, so that from V is known at them only; use method=pd."
        )
    elif not problem.gives_divergences:
        warnings.append("no upper bound: the recording holds no div_a (and, where B varies, no div_B).")
    elif settings.stage.steps:
        try:
            J, C_V, sup_occupation, hidden = closed_loop_J(
                problem, trained, fields, policy, kind, constants, settings, sets, run.seed
            )
            if hidden is not None:
                J = None
                warnings.append(f"J is not used: {hidden.sentence}.")
        except ArithmeticError as error:
            warnings.append(f"the certification stage failed: {error}")
    met = Observed(
        sup_occupation=sup_occupation,
        sup_control=None if policy is None else largest_control(policy, sets),
        jump=None if policy is None else largest_jump(policy, problem.dim),
        problem=posed(problem),
    )
    F_M = None if fields.value is None else penalised(problem, fields, constants.M, sets)
    if J is not None:
        warnings.append(
            f"J is above the controller's performance if C_V = {C_V:.4g}, by the samples met, bounds its value."
        )
    if settings.rigorous:
        warnings.append("no rigorous lower bound: samples say nothing about the states between them.")
    assumptions, notes = check_assumptions(problem, constants, met, uses=(F_M is not None, J is not None))
    certificate = Certificate(
        run=run,
        exact=None,
        lower={"F_M": F_M, "shifted": None, **({"rigorous": None} if settings.rigorous else {})},
        upper={"J": J if assumptions.regular_holds else None, "G": None, "lagrangian": None},
        perf={"value": None, "density": None},
        baseline={"zero": None},
        assumptions=replace(
            assumptions, C_V=C_V if J is not None else None, basis=assumptions.basis | {"C_V": SEARCHED}
        ),
        warnings=[*constants.warnings, *notes, *warnings],
        confidence=settings.confidence,
        subject=kind,
    )
    return examined(certificate)


@torch.no_grad()
def largest_control(policy: Policy, sets: list[Samples]) -> float:
    """`sup |u|` over the samples."""
    return max(float(policy(s.x).norm(dim=-1).max()) for s in sets)


def groups(samples: Samples) -> list[Samples]:
    """Disjoint groups of equal size, in the random order of the split; the few left over are not used."""
    count = max(2, min(GROUPS, len(samples) // FEWEST))
    size = len(samples) // count
    return [samples.take(slice(k * size, (k + 1) * size)) for k in range(count)]


def weighted(problem: Dataset) -> bool:
    return bool((problem.held_out.weight != 1.0).any())


def handed_out(problem: Dataset, trained) -> str | None:
    """Which controller is: from `V` where `B` is known everywhere, else `w / mu` of two networks, else none."""
    if trained.fields.value is not None and problem.knows_control_matrix:
        return "value"
    return "density" if trained.fields.control_density is not None and trained.occupation == NETWORK else None


def penalised(problem: Dataset, fields: Fields, M: float, sets: list[Samples]) -> Estimate:
    """`F_M(V) = E[V mu0 - M max(Q, 0)]`."""
    values = []
    for samples in sets:
        V = chunked_jet(fields.value, samples.x)
        slack = Generator.of(problem, samples).hjb_slack(V)
        values.append(integral(samples, V.value * samples.mu0 - M * slack.clamp_min(0.0)))
    return Estimate.of(values)


@torch.no_grad()
def closed_loop_samples(samples: Samples, policy: Policy, cost: PowerCost) -> Samples:
    """What `ClosedLoop` of ``policy`` would give at the states of ``samples``."""
    pieces = []
    for part in samples.split(CHUNK):
        div_a, div_B = part.require_divergences("the closed loop")
        u, flux = jets.control_flux_divergence(policy, part.x, part.B, div_B)
        pushed = torch.einsum("ndm,nm->nd", part.B, u)
        none = torch.zeros_like(part.x)
        pieces.append(
            Samples(
                x=part.x,
                f=part.f + cost.cost(u),
                a=part.a + pushed,
                B=none.unsqueeze(-1),
                mu0=part.mu0,
                weight=part.weight,
                div_a=div_a + flux,
                div_B=none[:, :1],
            )
        )
    return Samples.concatenate(pieces)


class Drawn:
    """A fixed set of samples that is drawn from with replacement: the `Pool` of a closed loop that cannot be sampled anew."""

    def __init__(self, samples: Samples, seed: int) -> None:
        self.samples = samples
        self.picker = torch.Generator().manual_seed(seed)

    def grow(self, count: int) -> None:
        """There are no more."""

    def draw(self, count: int) -> Samples:
        """``count`` of them."""
        index = torch.randint(len(self.samples), (count,), generator=self.picker)
        return self.samples.take(index.to(self.samples.x.device))


def closed_loop_J(
    problem: Dataset,
    trained,
    fields: Fields,
    policy: Policy,
    kind: str,
    constants: Constants,
    settings: CertificateSettings,
    sets: list[Samples],
    seed: int,
) -> tuple[Estimate, float, float, Hidden | None]:
    """`J(mu u, mu)` of ``policy`` on ``sets`` with `log mu` fitted on the training samples; its `C_V`, the largest `mu` met,
    and what the divergences of the samples do not see.

    By parts `E[(f + R(u)) mu] = E[V mu0 - mu Q_u - V r]`, the same number with less scatter. `C_V` is the largest of the
    bound at hand and of `V - min(Q_u, 0)`, which bounds `V^u` where it is largest, at all samples met, with head-room.
    """
    cost, rho = problem.control_cost, problem.discount
    rough = trained_policies(trained.occupation, problem, trained.fields, constants)[kind]
    like = next(trained.fields.parameters())
    training = closed_loop_samples(problem.training.to(like), rough, cost)
    pool = Drawn(training, derive_seed(seed, Branch.POLICY_EVALUATION, 2))
    fitted = fit_closed_loop(problem, rough, trained.fields, trained.network, constants, settings.stage, seed, pool)
    fitted = replace(trained, fields=fitted).in_float64()
    value = fields.value if fields.value is not None else fitted.value
    terms, densities, spreads, fluxes, largest, deepest = [], [], [], [], 0.0, 0.0
    for samples in sets:
        loop = closed_loop_samples(samples, policy, cost)
        generator, V = Generator(loop, rho, cost), chunked_jet(value, loop.x)
        slack = generator.hjb_slack(V)
        with torch.no_grad():
            mu, outflow = generator.occupation_outflow(fitted.log_occupation)
        terms.append(Terms(loop, V.value, mu * slack, loop.mu0 - outflow))
        largest, deepest = max(largest, float(V.value.max())), max(deepest, float(-slack.min()))
        densities.append(mu)
        fluxes.append(Flux(loop.x, loop.weight, outflow - mu, mu.unsqueeze(-1) * loop.a / rho))
        spreads.append(loop.div_a)
    with torch.no_grad():
        loop = training.to(torch.zeros((), dtype=torch.float64))
        V = jets.jet(value, loop.x)
        slack = Generator(loop, rho, cost).hjb_slack(V)
    largest, deepest = max(largest, float(V.value.max())), max(deepest, float(-slack.min()))
    C_V = max(constants.C_V, MARGIN * (largest + deepest))
    excess = best_multiples(terms, lambda t, s: t.J(s, C_V))
    J = [integral(t.samples, t.v * t.samples.mu0) + e for t, e in zip(terms, excess, strict=True)]
    found = Estimate.of(J, controller=kind)
    highest = highest_occupation(torch.cat(densities), torch.cat(spreads), rho)
    return found, C_V, highest, hidden_divergence(fluxes)


def highest_occupation(mu: Tensor, spread: Tensor, rho: float) -> float:
    """The largest of the fitted densities ``mu`` ``(N,)``; infinite where it need not end there, by ``spread`` `= div g_u`.

    Where a density is largest its gradient is 0, and Liouville's equation says `-div g_u = rho (1 - mu0 / mu) < rho`. A flow
    that contracts faster than the discount forgets, there where the fit has most mass, has a density without bound, of
    which a fit shows the lower part.
    """
    top = mu.topk(min(TOP, len(mu))).indices
    return float(mu.max()) if float((-spread[top]).max()) < rho else math.inf


def posed(problem: Dataset) -> WellPosed:
    """What reading the file has checked already; the seam between two samples nobody can see."""
    samples = problem.held_out
    mass = float(problem.recording.samples.mean(problem.recording.samples.mu0))
    return WellPosed(True, True, True, float(samples.f.min()), mass, [])
