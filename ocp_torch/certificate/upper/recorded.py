r"""`J` from recorded samples: an expectation over the torus of functions of the data, so a weighted mean of held-out samples.

The closed loop of a controller that is known at every state (`w / mu` of two networks; from `V` where `B` is constant) has
its data at the recorded states too: `f + R(u)`, `a + B u` and, from `div a` and `div B`, its divergence.
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.bound import recorded
from ocp_torch.certificate.checks.hidden import Hidden, hidden_divergence
from ocp_torch.certificate.checks.tails import widened
from ocp_torch.certificate.estimate import Estimate, starting_level, starting_mean
from ocp_torch.certificate.fields import in_float64
from ocp_torch.certificate.upper.multiples import best_multiples, terms_on
from ocp_torch.certificate.upper.penalised import PenalisedPrimal
from ocp_torch.certificate.upper.policy_evaluation import Drawn, fit_closed_loop
from ocp_torch.control.policies import Policy
from ocp_torch.maths.jets import CHUNK, control_flux_divergence
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import MARGIN
from ocp_torch.problems.samples import Samples

if TYPE_CHECKING:
    from ocp_torch.certificate.context import Context
    from ocp_torch.certificate.external.dataset import RecordedContext

DENSEST_SAMPLES = 10  # samples of largest fitted density at which the contraction of the flow is checked


class RecordedPrimal(PenalisedPrimal):
    """`J` where only recorded samples are known."""

    def applies(self, context: "Context") -> bool:
        return context.recorded

    def evaluate(self, context: "Context") -> Estimate | None:
        fit = recorded(context).fit
        return fit.J if fit else None

    def valid(self, context: "Context") -> bool:
        return context.hidden is None and context.checked.regular_holds

    def about(self, context: "Context") -> str | None:
        return context.kind

    def notes(self, context: "Context", shown: Estimate | None) -> list[str]:
        if context.hidden is not None:
            return [f"J is not used: {context.hidden.sentence}."]
        fit = recorded(context).fit
        said = "J is above the controller's performance if C_V = {:.4g}, by the samples met, bounds its value."
        return [said.format(fit.C_V)] if fit else []


@torch.no_grad()
def closed_loop_samples(samples: Samples, policy: Policy, cost: PowerCost) -> Samples:
    """What `ClosedLoop` of ``policy`` would give at the states of ``samples``."""
    pieces = []
    for part in samples.split(CHUNK):
        div_a, div_B = part.require_divergences("the closed loop")
        u, flux = control_flux_divergence(policy, part.x, part.B, div_B)
        flow = part.velocity(u)
        pieces.append(replace(part, f=part.f + cost.cost(u), a=flow, div_a=div_a + flux))
    loop = Samples.concatenate(pieces)
    return replace(loop, B=torch.zeros_like(loop.x).unsqueeze(-1), div_B=torch.zeros_like(loop.x[:, :1]))


class RecordedFit(NamedTuple):
    """`J` of a controller, its ``C_V``, the largest ``mu`` of the fitted density, and what the samples' divergences miss."""

    J: Estimate
    C_V: float
    sup_occupation: float
    hidden: Hidden | None


def fit_recorded(context: "RecordedContext", kind: str) -> RecordedFit:
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
    pool = Drawn(training, derive_seed(seed, Branch.POLICY_EVALUATION, 2))
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


def highest_occupation(mu: Tensor, loop: Samples, rho: float) -> float:
    """The largest of the fitted densities ``mu`` ``(N,)`` at samples of the closed ``loop``; infinite where the density may
    be unbounded.

    Where a density is largest its gradient is 0, and Liouville's equation says `-div g_u = rho (1 - mu0 / mu) < rho`. Where
    a flow contracts faster at the densest samples, the density has no bound and the fit shows only its lower part, unless
    noise in all directions spreads it.
    """
    top = loop.take(mu.topk(min(DENSEST_SAMPLES, len(mu))).indices)
    if top.noise is not None and float(torch.linalg.matrix_rank(top.noise).min()) == top.x.shape[1]:
        return float(mu.max())
    return float(mu.max()) if float((-top.require_divergences("the closed loop")[0]).max()) < rho else math.inf
