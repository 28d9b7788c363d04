r"""`J` from recorded samples: an expectation over the torus of functions of the data, so a weighted mean of held-out samples.

The closed loop of a controller that is known at every state (`w / mu` of two networks; from `V` where `B` is constant) has
its data at the recorded states too: `f + R(u)`, `a + B u` and, from `div a` and `div B`, its divergence.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.bound import recorded
from ocp_torch.certificate.checks.hidden import Flux, Hidden, hidden_divergence
from ocp_torch.certificate.estimate import Estimate, integral
from ocp_torch.certificate.trained import in_float64
from ocp_torch.certificate.upper.multiples import Terms, best_multiples
from ocp_torch.certificate.upper.penalised import PenalisedPrimal
from ocp_torch.certificate.upper.policy_evaluation import fit_closed_loop
from ocp_torch.control.policies import Policy
from ocp_torch.maths import jets
from ocp_torch.maths.jets import CHUNK, chunked_jet
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import MARGIN
from ocp_torch.problems.samples import Samples

if TYPE_CHECKING:
    from ocp_torch.certificate.context import Context
    from ocp_torch.certificate.external.dataset import RecordedContext

# The samples with most mass, at which the contraction of the flow is looked at.
TOP = 10


class RecordedPrimal(PenalisedPrimal):
    """`J` where only recorded samples are known."""

    def applies(self, context: Context) -> bool:
        return context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        fit = recorded(context).fit
        return fit.J if fit else None

    def valid(self, context: Context) -> bool:
        return context.hidden is None and context.checked.regular_holds

    def speaks(self, context: Context) -> bool:
        return True

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        if context.hidden is not None:
            return [f"J is not used: {context.hidden.sentence}."]
        fit = recorded(context).fit
        if fit is None:
            return []
        return [
            f"J is above the controller's performance if C_V = {fit.C_V:.4g}, by the samples met, bounds its value."
        ]


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


class RecordedFit(NamedTuple):
    """`J` of a controller, its ``C_V``, the largest ``mu`` of the fitted density, and what the samples' divergences miss."""

    J: Estimate
    C_V: float
    sup_occupation: float
    hidden: Hidden | None


def fit_recorded(context: RecordedContext, kind: str) -> RecordedFit:
    """`J(mu u, mu)` of the controller ``kind``, on held-out samples, with `log mu` fitted on the training samples.

    By parts `E[(f + R(u)) mu] = E[V mu0 - mu Q_u - V r]`, the same number with less scatter. `C_V` is the largest of the
    bound at hand and of `V - min(Q_u, 0)`, which bounds `V^u` where it is largest, at all samples, with head-room. Raises
    `ArithmeticError` where the fit fails.
    """
    problem, trained, constants, seed = context.problem, context.trained, context.constants, context.seed
    cost, rho = problem.control_cost, problem.discount
    policy, rough = (context.policies_of(fields)[kind] for fields in (context.fields, trained.fields))
    like = next(trained.fields.parameters())
    training = closed_loop_samples(problem.training.to(like), rough, cost)
    pool = Drawn(training, derive_seed(seed, Branch.POLICY_EVALUATION, 2))
    fitted = fit_closed_loop(
        problem, rough, trained.fields, trained.network, constants, context.settings.stage, seed, pool
    )
    fitted = in_float64(fitted)
    value = context.value if context.value is not None else fitted.value
    terms, densities, spreads, fluxes, largest, deepest = [], [], [], [], 0.0, 0.0
    for samples in context.sets:
        loop = closed_loop_samples(samples, policy, cost)
        generator, V = Generator(loop, rho, cost), chunked_jet(value, loop.x)
        slack = generator.hjb_slack(V)
        with torch.no_grad():
            mu, outflow = generator.occupation_outflow(fitted.log_occupation)
        terms.append(Terms(loop, V.value, mu * slack, loop.mu0 - outflow))
        largest, deepest = max(largest, float(V.value.max())), max(deepest, float(-slack.min()))
        densities.append(mu)
        fluxes.append(Flux(loop.x, loop.weight, outflow - mu, mu.unsqueeze(-1) * loop.a / rho))
        spreads.append(loop.require_divergences("the closed loop")[0])
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
    return RecordedFit(found, C_V, highest, hidden_divergence(fluxes))


def highest_occupation(mu: Tensor, spread: Tensor, rho: float) -> float:
    """The largest of the fitted densities ``mu`` ``(N,)``; infinite where it need not end there, by ``spread`` `= div g_u`.

    Where a density is largest its gradient is 0, and Liouville's equation says `-div g_u = rho (1 - mu0 / mu) < rho`. A flow
    that contracts faster than the discount forgets, there where the fit has most mass, has a density without bound, of
    which a fit shows the lower part.
    """
    top = mu.topk(min(TOP, len(mu))).indices
    return float(mu.max()) if float((-spread[top]).max()) < rho else math.inf
