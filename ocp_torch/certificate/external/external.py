r"""The certificate of one given controller, wherever it comes from: what it costs, and how far from optimal it is.

`V^u` and `mu^u` are fitted to its closed loop by least squares (P(u) and D(u), section 5.4 of the paper); the fitted `V`
is the control variate of the simulation and, with the suprema of its Bellman slack, bounds `V^u` on both sides. A second
`V`, trained for the optimum, gives the lower bound on `OPT` and a controller to compare with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from ocp_torch.certificate.certificate import Certificate, Run
from ocp_torch.certificate.certify import BASELINE_PART, TANGENT_PART, in_float64, measured, searches_of
from ocp_torch.certificate.checks.assumptions import check_assumptions
from ocp_torch.certificate.checks.contradictions import examined
from ocp_torch.certificate.checks.tails import notes_on, sharpened
from ocp_torch.certificate.checks.wellposed import check_problem
from ocp_torch.certificate.estimate import integral, replicated_samples
from ocp_torch.certificate.external.black_box import BlackBox
from ocp_torch.certificate.progress import Progress, silent
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.sides import lower_side
from ocp_torch.certificate.simulated.performance import simulate_performance
from ocp_torch.certificate.upper.lagrangian import ClosedLoopBounds, closed_loop_bounds
from ocp_torch.certificate.upper.policy_evaluation import fit_closed_loop
from ocp_torch.control.policies import Policy, ValuePolicy, zero_policy
from ocp_torch.maths.jets import Field
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.scan import odd_states

# The name under which its performance stands in a certificate.
GIVEN = "given"


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
    """The certificate of ``policy``; with ``value`` (float64), any `V`, also how far from optimal it is at most.

    ``network`` makes the networks for `V^u` and `mu^u`; each stage's name is given to ``progress`` as it begins. Raises
    `InputError` where the policy fails.
    """
    count, seed, ascents = settings.replicates, run.seed, settings.ascents
    part = max(TANGENT_PART, problem.dim // 2)
    wide = replicated_samples(problem, settings.points, count, seed, divergences=False)
    few = replicated_samples(problem, max(1, settings.points // part), count, seed, divergences=False)
    posed = check_problem(problem, wide)
    odd = odd_states(problem, settings.scanned(problem), seed)
    warnings: list[str] = []
    if settings.stage.steps:
        progress("closed-loop fit")
    evaluated, own = evaluate_policy(problem, policy, network, constants, settings, few, wide, seed, odd)
    if settings.stage.steps and evaluated is None:
        warnings.append("no bound on Perf without simulation: this problem gives no divergences of a and B.")
    simulate = lambda policy, number, value=None, initial=None: simulate_performance(
        problem, policy, number, count, seed, value, initial, settings.horizon, settings.tolerance
    )
    number, perf, zero, given, best = settings.trajectories, {}, None, None, None
    lower = None
    if value is not None:
        progress("bounds")
        lower = lower_side(problem, value, wide, constants.M, ascents, settings.searches(constants), seed, odd)
    if number:
        progress("simulation")
        initial = [integral(s, own(s.x) * s.mu0) for s in wide] if own is not None else None
        given = simulate(policy, number, own, initial)
        perf[GIVEN] = given.perf
        zero = simulate(zero_policy(problem), max(2, number // BASELINE_PART)).perf
        if value is not None:
            best = simulate(ValuePolicy(problem, value), number, value, lower.initial)
            perf["value"] = best.perf
    progress("assumptions")
    met = measured(problem, policy, given, few, posed, replace(settings, occupation_states=0))
    if best is not None:
        # M is about the optimal controller, which the one from V is nearer to than anybody's.
        near = measured(problem, ValuePolicy(problem, value), best, few, posed, settings)
        met = replace(met, sup_occupation=near.sup_occupation, a_priori_occupation=near.a_priori_occupation)
    assumptions, notes = check_assumptions(problem, constants, met, uses=(value is not None, False))
    if evaluated is not None and evaluated.hidden is not None:
        notes.append(f"J and the Lagrangian bound are not used: {evaluated.hidden.sentence}.")
        assumptions = replace(assumptions, regular_holds=False)
    coarse = isinstance(policy, BlackBox) and policy.precision is torch.float32
    if evaluated is not None:
        assumptions = assumptions.with_value_bound(evaluated.C_V)
        if coarse:
            notes.append("J is left out: the controller computes in float32, too coarse for its divergence.")
    # On a jump the divergence is not what the formulas see: a wrong number is not shown at all.
    smooth = evaluated if assumptions.regular_holds else None
    notes += notes_on({"J": smooth.J, "lagrangian": smooth.lagrangian} if smooth else {})
    if value is None:
        notes.append("no lower bound: there is no V to give one.")
    certificate = Certificate(
        run=run,
        exact=problem.exact_optimum,
        lower={"F_M": lower.F_M if lower else None, "shifted": lower.shifted if lower else None},
        upper={
            "J": smooth.J if smooth and not coarse else None,
            "G": None,
            "lagrangian": smooth.lagrangian if smooth else None,
            "evaluation": evaluated.sandwich[1] if evaluated else None,
        },
        perf=perf,
        baseline={"zero": zero},
        assumptions=assumptions,
        warnings=[*constants.warnings, *notes, *warnings],
        searches=searches_of(lower, evaluated),
        confidence=settings.confidence,
        subject=GIVEN,
        perf_lower={
            "evaluation": evaluated.sandwich[0] if evaluated else None,
            "lagrangian": smooth.below if smooth else None,
        },
    )
    return examined(certificate)


def evaluate_policy(
    problem: Problem,
    policy: Policy,
    network: Callable[..., nn.Module],
    constants: Constants,
    settings: CertificateSettings,
    few: list[Samples],
    wide: list[Samples],
    seed: int,
    odd: Tensor,
) -> tuple[ClosedLoopBounds | None, Field | None]:
    """Bounds on `Perf(u)` from fields fitted to the closed loop of ``policy``, their suprema sought at the states ``odd``
    too, and the fitted `V^u`; `None` without a fit."""
    if not (settings.stage.steps and problem.gives_divergences):
        return None, None
    fitted = in_float64(fit_closed_loop(problem, policy, None, network, constants, settings.stage, seed))
    loop = ClosedLoop(problem, policy)
    with torch.no_grad():
        initial = [integral(s, fitted.value(s.x) * s.mu0) for s in wide]
    judge = lambda sets: closed_loop_bounds(
        loop, fitted.value, fitted.log_occupation, loop.samples_of(sets), settings.ascents, GIVEN, initial, odd
    )
    return sharpened(judge, problem, few, seed), fitted.value
