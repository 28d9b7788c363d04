"""The one certifier: it asks the listed bounds what they say of a context, and puts that into a certificate."""

from collections.abc import Callable

from torch import nn

from ocp_torch.certificate.bound import LOWER, PERFORMANCE, UPPER, Bound
from ocp_torch.certificate.bounds import BOUNDS
from ocp_torch.certificate.certificate import Certificate
from ocp_torch.certificate.checks.contradictions import examined
from ocp_torch.certificate.checks.tails import notes_on
from ocp_torch.certificate.context import Context
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.external.controller import ControllerContext
from ocp_torch.certificate.external.dataset import RecordedContext
from ocp_torch.certificate.settings import CertificateSettings, Progress, Run, silent
from ocp_torch.certificate.trained import FieldsContext, Trained, TrainedContext
from ocp_torch.control.policies import Policy
from ocp_torch.maths.jets import Field
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.recorded.dataset import Dataset


def certify(context: Context) -> Certificate:
    """The certificate of ``context``. Raises `ProblemError` where a function of its problem is not finite."""
    context.progress("bounds")
    bounds = [bound for bound in BOUNDS if bound.applies(context)]
    evaluated = lambda side: {bound.name: shown(bound, context) for bound in bounds if bound.side == side}
    _ = context.posed  # first of all: functions that are not finite are refused here
    lower = evaluated(LOWER)
    perf, (_, zero) = context.perf, context.simulated  # before the upper side, which is of the best of them
    upper, perf_lower = evaluated(UPPER), evaluated(PERFORMANCE)
    sides = {LOWER: lower, UPPER: upper, PERFORMANCE: perf_lower}
    certificate = Certificate(
        run=context.run,
        exact=context.problem.exact_optimum,
        lower=lower,
        upper=upper,
        perf=perf,
        baseline={"zero": zero},
        assumptions=context.assumptions,
        warnings=[
            *context.constants.warnings,
            *context.checked.warnings,
            *context.notes,
            *(note for bound in bounds for note in bound.notes(context, sides[bound.side][bound.name])),
            *notes_on(upper | lower),
            *context.remarks,
        ],
        searches=list(dict.fromkeys(line for bound in bounds for line in bound.searches(context))),
        speaks={bound.name: bound.speaks(context) for bound in bounds if bound.side == UPPER},
        confidence=context.settings.confidence,
        subject=context.subject,
        perf_lower=perf_lower,
    )
    return examined(certificate)


def shown(bound: Bound, context: Context) -> Estimate | None:
    """What ``bound`` says, unless it is known to be wrong."""
    estimate = bound.evaluate(context)
    return estimate if estimate is not None and bound.valid(context) else None


def certify_fields(
    problem: Problem,
    trained: Trained,
    constants: Constants,
    settings: CertificateSettings,
    run: Run,
    progress: Progress = silent,
) -> Certificate:
    """The certificate of ``trained`` fields, on states that no training sampler draws, or on samples that were held out.

    The name of each part is given to ``progress`` as it begins. Raises `InputError` where weights are not finite.
    """
    trained.require_finite()
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
) -> Certificate:
    """The certificate of any ``policy``; with ``value`` (float64), any `V`, also how far from optimal it is at most.

    ``network`` makes the networks for `V^u` and `mu^u`; the name of each part is given to ``progress`` as it begins. Raises
    `InputError` where the policy fails.
    """
    shared = problem, constants, settings, run, progress
    return certify(ControllerContext(*shared, policy=policy, value=value, network=network))
