"""The one certifier: it asks the listed bounds what they say of a context, and whether they contradict each other."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import torch
from torch import nn

from ocp_torch.certificate.bounds import BOUNDS
from ocp_torch.certificate.bounds.bound import LOWER, PERFORMANCE, UPPER, Bound
from ocp_torch.certificate.certificate import Certificate
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.contexts.controller import ControllerContext
from ocp_torch.certificate.contexts.fields import FieldsContext, Trained
from ocp_torch.certificate.contexts.recorded import RecordedContext
from ocp_torch.certificate.contexts.trained import TrainedContext
from ocp_torch.certificate.external.black_box import BlackBox
from ocp_torch.certificate.report import the_controller
from ocp_torch.certificate.settings import CERTIFIED, CertificateSettings, Progress, Run, silent
from ocp_torch.certificate.simulated.outside import outside_note
from ocp_torch.certificate.simulated.performance import Simulated
from ocp_torch.certificate.statistics.estimate import Estimate, known_of
from ocp_torch.control.policies import Policy
from ocp_torch.errors import InputError
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.jets import Field
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.needs import GUESSED
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.recorded.dataset import Dataset

# Bounds contradict each other where their intervals at this joint level are apart,
CONTRADICTION_LEVEL = 0.999
# by more than this part of their size: equal numbers may differ in the last digits of float64 and of what was given.
ROUNDING = 1e-9


class Ordered(NamedTuple):
    """Two numbers with their names, of which ``under`` is never above ``over`` if what they rest on is true."""

    low: str
    under: Estimate
    high: str
    over: Estimate

    def is_apart(self, level: float) -> bool:
        """Whether their intervals at ``level`` say that it is above nevertheless."""
        most = self.over.interval(level)[1] + ROUNDING * abs(self.over.value)
        return self.under.interval(level)[0] > most


def certify(context: Context) -> Certificate:
    """The certificate of ``context``. Raises `ProblemError` where a function of its problem is not finite."""
    bounds = [bound for bound in BOUNDS if bound.applies(context)]
    evaluated = lambda side: {bound.name: shown(bound, context) for bound in bounds if bound.side == side}
    _ = context.well_posed  # first of all, to refuse functions that are not finite
    with context.ahead():
        simulated, zero = context.simulated  # before the upper side, which is of the best of them
        upper, perf_lower = evaluated(UPPER), evaluated(PERFORMANCE)
        assumptions = context.assumptions  # before the lower side, whose `M` may follow from what is met here
        context.progress("bounds")
        lower = evaluated(LOWER)
    sides = {LOWER: lower, UPPER: upper, PERFORMANCE: perf_lower}
    certificate = Certificate(
        run=context.run,
        exact=context.problem.exact_optimum,
        lower=lower,
        upper=upper,
        perf=dict.fromkeys(context.always_listed) | {name: found.perf for name, found in simulated.items()},
        baseline={"zero": zero},
        assumptions=assumptions,
        warnings=[
            *context.constants.warnings,
            *context.checked.warnings,
            *context.first_warnings,
            *(note for bound in bounds for note in bound.notes(context, sides[bound.side][bound.name])),
            *(
                f"a few sampled states carry {name}: its interval is widened by {estimate.bias:.2g}."
                for name, estimate in (upper | lower).items()
                if estimate is not None and estimate.bias
            ),
            *context.last_warnings,
            *(note for name, found in simulated.items() for note in unseen(name, found)),
        ],
        searches=list(dict.fromkeys(line for bound in bounds for line in bound.searches(context))),
        about={bound.name: bound.about(context) for bound in bounds if bound.side == UPPER},
        confidence=context.settings.confidence,
        subject=context.kind,
        perf_lower=perf_lower,
        followed=context.followed,
        occupation=None if context.closed_loop is None else context.closed_loop.occupation,
        subsolution=None if context.sampled_value is None else context.sampled_value.subsolution,
    )
    return handed_out(examined(certificate), context)


def unseen(name: str, found: Simulated) -> list[str]:
    """What the simulation ``found`` of the controller ``name`` cannot have seen, in sentences."""
    of = the_controller(name)
    wall = f"nothing certain is known of what {of} costs: {found.jumped_over}."
    rare = f"no path of {of} came near the dearest states; if one does, it costs up to {found.unmet:.2g} more."
    return ([wall] if found.jumped_over else []) + ([rare] if found.unmet else [])


def handed_out(certificate: Certificate, context: Context) -> Certificate:
    """``certificate`` with the controller that is handed out as its subject, and what is computed for that one alone."""
    choose = context.settings.prefer == CERTIFIED and not context.controller_fixed
    best = certificate.best_certified if choose else None
    subject = certificate.subject if best is None else best
    outside, held_for = context.outside(subject), context.held_for(subject)
    warnings = [*certificate.warnings, *outside_note(context.problem, outside)]
    return replace(certificate, subject=subject, outside=outside, held_for=held_for, warnings=warnings)


def shown(bound: Bound, context: Context) -> Estimate | None:
    """The number of ``bound`` in ``context``; `None` where there is none, or it is known to be wrong."""
    estimate = bound.evaluate(context)
    return estimate if estimate is not None and bound.valid(context) else None


def examined(certificate: Certificate) -> Certificate:
    """``certificate`` with its contradiction, so that nothing counts, where a lower bound on `OPT` is above an upper one by
    more than their errors, or a lower bound on a performance above what was simulated. A guess that is shown to be wrong in
    this way is dropped, with a warning, and the rest stands."""
    if not certificate.stands:
        return certificate
    sound, guessed = _ordered(certificate)
    level = 1.0 - (1.0 - CONTRADICTION_LEVEL) / max(1, len(sound) + len(guessed))
    for pair in sound:
        if pair.is_apart(level):
            sentence = _contradiction(certificate, pair)
            return replace(certificate, contradiction=sentence, warnings=[sentence, *certificate.warnings])
    for pair in guessed:
        if pair.is_apart(level):
            needs = certificate.needs(pair.low)
            condition = " and ".join(need.condition for need in needs)
            low, high = f"{pair.low} = {pair.under.value:.6g}", f"{pair.high} = {pair.over.value:.6g}"
            note = f"{low} is above {high}: it is not so that {condition}."
            wrong = {need.name for need in needs if need.basis == GUESSED}
            return replace(certificate, refuted=certificate.refuted | wrong, warnings=[*certificate.warnings, note])
    return certificate


def _ordered(certificate: Certificate) -> tuple[list[Ordered], list[Ordered]]:
    """All pairs of what counts in ``certificate``; and those whose lower bound supposes a guess."""
    pairs = lambda below, above: [Ordered(*under, *over) for under, over in product(below.items(), above.items())]
    counting = lambda found: {name: e for name, e in known_of(found).items() if certificate.counts(name)}
    costs = {f"Perf ({name})": e for name, e in known_of(certificate.perf | certificate.baseline).items()}
    truth = {} if certificate.exact is None else {"OPT": Estimate(certificate.exact, 0.0)}
    # Whatever any controller costs, doing nothing included, OPT does not exceed it.
    above = counting(certificate.upper) | costs
    own = f"Perf ({certificate.controller})"
    own_cost = {own: costs[own]} if own in costs else {}
    sound = [
        *pairs(counting(certificate.lower), above | truth),
        *pairs(truth, above),
        *pairs(counting(certificate.perf_lower), own_cost),
    ]
    supposed = {name: e for name, e in known_of(certificate.lower).items() if certificate.conditional(name)}
    return sound, pairs(supposed, above | truth)


def _contradiction(certificate: Certificate, pair: Ordered) -> str:
    """Why nothing is certified where the two of ``pair`` are apart."""
    needs = [need for name in (pair.low, pair.high) for need in certificate.needs(name)]
    conditions = " or not ".join(dict.fromkeys(need.condition for need in needs))
    doubts = f"either not {conditions}, or " if conditions else ""
    return (
        f"nothing is certified: {pair.low} = {pair.under.value:.6g}, a lower bound, contradicts {pair.high} = "
        f"{pair.over.value:.6g}, an upper one; {doubts}the problem's functions or constants are not what they are said to be."
    )


def certify_fields(
    problem: Problem,
    trained: Trained,
    constants: Constants,
    settings: CertificateSettings,
    run: Run,
    progress: Progress = silent,
) -> Certificate:
    """The certificate of ``trained`` fields, on states that no training sampler draws, or on samples that were held out.
    Raises `InputError` where weights are not finite."""
    for name, network in trained.fields.networks.items():
        if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
            raise InputError(f"the network for {name} holds weights that are not finite; there is nothing to certify.")
    kind: type[FieldsContext] = RecordedContext if isinstance(problem, Dataset) else TrainedContext
    return certify(kind(problem, constants, settings, run, progress, trained=trained))


def certify_policy(
    problem: Problem,
    policy: Policy,
    value: Field | None,
    network: Callable[..., nn.Module],
    constants: Constants,
    settings: CertificateSettings,
    run: Run,
    progress: Progress = silent,
    kept: Subsolution | None = None,
) -> Certificate:
    """The certificate of any ``policy``; with ``value`` (float64), any `V`, also how far from optimal it is at most, for
    which ``kept`` was trained before. ``network`` makes the networks for `V^u` and `mu^u`. Raises `InputError` where the
    policy fails."""
    shared = problem, constants, settings, run, progress
    certificate = certify(
        ControllerContext(*shared, policy=policy, value=value, network=network, saved_subsolution=kept)
    )
    if isinstance(policy, BlackBox):  # after calls at many states
        policy.require_still()
    return certificate
