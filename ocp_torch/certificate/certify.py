"""From trained fields to a certificate: nothing here knows how they were trained."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ocp_torch.certificate.certificate import Certificate, Run
from ocp_torch.certificate.checks.assumptions import Observed, check_assumptions
from ocp_torch.certificate.checks.contradictions import examined
from ocp_torch.certificate.checks.regularity import largest_jump
from ocp_torch.certificate.checks.tails import notes_on, sharpened
from ocp_torch.certificate.checks.wellposed import WellPosed, check_problem
from ocp_torch.certificate.estimate import Estimate, replicated_samples
from ocp_torch.certificate.external.recorded import certify_recorded
from ocp_torch.certificate.progress import Progress, silent
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.sides import LowerSide, lower_side, upper_side
from ocp_torch.certificate.simulated.occupation import a_priori_sup_occupation, estimated_sup_occupation
from ocp_torch.certificate.simulated.performance import Simulated, simulate_performance
from ocp_torch.certificate.upper.lagrangian import ClosedLoopBounds, closed_loop_bounds
from ocp_torch.certificate.upper.policy_evaluation import fit_closed_loop
from ocp_torch.control.policies import (
    CLOSED,
    Policy,
    admissible_density,
    occupation_density,
    trained_policies,
    zero_policy,
)
from ocp_torch.errors import InputError
from ocp_torch.fields.fields import Fields
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.scan import odd_states

if TYPE_CHECKING:
    from ocp_torch.certificate.proof.rigorous import RigorousBound

# Doing nothing has no control variate; its performance is a yardstick, not a bound, and needs few trajectories. So does
# a controller that another one clearly beats.
BASELINE_PART = 4
# But so few trajectories take hardly longer than a part of them.
CHEAP = 256
# What costs `m` tangents through a network at each state, upper sides and residuals, is done on one state in
# eight, and beyond sixteen dimensions on one in `d / 2`.
TANGENT_PART = 8


@dataclass(frozen=True)
class Trained:
    """What training hands over: the fields, how they give `mu` (see `trained_policies`), and the network they are made of."""

    fields: Fields
    occupation: str | None
    network: Callable[..., nn.Module]

    def in_float64(self) -> Fields:
        """The fields as every bound is computed with them."""
        return in_float64(self.fields)


def in_float64(fields: Fields) -> Fields:
    """A frozen float64 copy on the CPU: what every bound is computed with."""
    clone: nn.Module = copy.deepcopy(fields).to("cpu").double().requires_grad_(False)
    return clone.eval()


def certify_fields(
    problem: Problem,
    trained: Trained,
    constants: Constants,
    settings: CertificateSettings,
    run: Run,
    progress: Progress = silent,
) -> Certificate:
    """The certificate of ``trained`` fields, on states that no training sampler draws.

    Both controllers are simulated; the better one is handed out, and the certification stage speaks of that one. Each
    stage's name is given to ``progress`` as it begins.
    """
    require_finite(trained.fields)
    progress("bounds")
    if not problem.has_simulator:
        return certify_recorded(problem, trained, constants, settings, run)
    fields, occupation = in_float64(trained.fields), trained.occupation
    seed, count = run.seed, settings.replicates
    has_value, has_density = fields.value is not None, fields.control_density is not None
    lower = None
    odd = odd_states(problem, settings.scanned(problem), seed)
    part = max(TANGENT_PART, problem.dim // 2)
    few = replicated_samples(problem, max(1, settings.points // part), count, seed, divergences=True)
    if has_value:
        sets = replicated_samples(problem, settings.points, count, seed, divergences=False)
        lower = lower_side(
            problem, fields.value, sets, constants.M, settings.ascents, settings.searches(constants), seed, odd
        )
    proved, proof_notes = None, []
    if settings.rigorous:
        progress("proof")
        from ocp_torch.certificate.proof.rigorous import proved_lower  # loaded only where a proof is asked for

        if lower:
            proved, proof_notes = proved_lower(problem, fields.value, lower)
    posed = check_problem(problem, sets if has_value else few)
    policies = trained_policies(occupation, problem, fields, constants)
    if settings.trajectories:
        progress("simulation")
    simulated, zero = simulations(problem, policies, fields, lower, settings, seed)
    stage = None
    warnings: list[str] = []
    finite = {name: s for name, s in simulated.items() if s.perf.finite}
    best = min(finite, key=lambda n: finite[n].perf.above, default=next(iter(policies)))
    J = G = hidden = None
    if has_density and problem.gives_divergences:
        mu = occupation_density(occupation, problem, fields, constants)
        w = admissible_density(occupation, problem, fields, constants)
        J, G, hidden, _ = sharpened(lambda sets: upper_side(problem, w, mu, sets, constants.C_V), problem, few, seed)
        with torch.no_grad():
            vanishes = any(bool((mu(samples.x[:4096]) <= 0.0).any()) for samples in few)
        if best == "density" and vanishes:
            warnings.append(
                "mu is 0 at sampled states, where w / mu is not regular: J and G may miss what it costs there."
            )
    if settings.stage.steps:
        progress("closed-loop fit")
        stage, notes = certification_stage(problem, trained, fields, constants, settings, few, lower, best, seed, odd)
        warnings += notes
    progress("assumptions")
    met = measured(problem, policies[best], finite.get(best), few, posed, settings)
    assumptions, notes = check_assumptions(problem, constants, met, uses=(has_value, J is not None))
    warnings = list(constants.warnings) + notes + warnings + proof_notes
    # J bounds the performance of w / mu and G that of w over the mu of Lemma 2: of nothing else.
    speaks = {"J": best == "density", "G": best == "density" and occupation == CLOSED and assumptions.value_holds}
    if met.jump.in_problem or not posed.smooth_seam:
        G = None
    hidden = hidden or (stage.hidden if stage is not None else None)
    if hidden is not None:
        warnings.append(f"J, G and the Lagrangian bound are not used: {hidden.sentence}.")
        assumptions, J, G = replace(assumptions, regular_holds=False), None, None
    if not assumptions.regular_holds:
        # On a jump the divergence is not what the stage sees: a wrong number is not shown at all.
        stage = None
    if stage is not None and not (speaks["J"] and assumptions.value_holds and J.value <= stage.J.value):
        if J is not None and not assumptions.value_holds:
            warnings.append(f"the J shown is that of the closed loop, with C_V = {stage.C_V:.4g} proved for it.")
        J, assumptions, speaks["J"] = stage.J, assumptions.with_value_bound(stage.C_V), True
    if G is not None and not speaks["G"]:
        warnings.append("G bounds OPT, but not the controller that is handed out: the gap does not use it.")
    upper = {"J": J, "G": G, "lagrangian": stage.lagrangian if stage else None}
    warnings += notes_on({**upper, "F_M": lower.F_M if lower else None})
    perf = {name: simulated[name].perf if name in simulated else None for name in ("value", "density")}
    warnings += _plausibility(perf, zero)
    certificate = Certificate(
        run=run,
        exact=problem.exact_optimum,
        lower={
            "F_M": lower.F_M if lower else None,
            "shifted": lower.shifted if lower else None,
            **({"rigorous": proved.estimate if proved else None} if settings.rigorous else {}),
        },
        upper=upper,
        perf=perf,
        baseline={"zero": zero},
        assumptions=assumptions,
        warnings=warnings,
        searches=searches_of(lower, stage, proved),
        speaks=speaks,
        confidence=settings.confidence,
    )
    return examined(certificate)


def require_finite(fields: Fields) -> None:
    """Raises `InputError` where weights are not: no number computed from them would mean anything."""
    for name, network in fields.networks.items():
        if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
            raise InputError(f"the network for {name} holds weights that are not finite; there is nothing to certify.")


def simulations(
    problem: Problem,
    policies: dict[str, Policy],
    fields: Fields,
    lower: LowerSide | None,
    settings: CertificateSettings,
    seed: int,
) -> tuple[dict[str, Simulated], Estimate | None]:
    """Performance of each of ``trained_policies``, and of doing nothing.

    A policy that is clearly worse than another on a quarter of the trajectories gets no more of them, where that saves time.
    """
    if not settings.trajectories:
        return {}, None
    simulate = partial(
        simulate_performance,
        problem,
        replicates=settings.replicates,
        seed=seed,
        horizon=settings.horizon,
        tolerance=settings.tolerance,
    )
    few = max(2, settings.trajectories // BASELINE_PART)
    initial = lower.initial if lower else None
    judge = lambda policy, trajectories: simulate(
        policy, trajectories=trajectories, value=fields.value, initial=initial
    )
    pays = len(policies) > 1 and settings.trajectories * settings.replicates > CHEAP
    found = {name: judge(policy, few) for name, policy in policies.items()} if pays else {}
    best = min((s.perf.above for s in found.values() if s.perf.finite), default=math.inf)
    for name, policy in policies.items():
        if name not in found or not found[name].perf.below > best:
            found[name] = judge(policy, settings.trajectories)
    return found, simulate(zero_policy(problem), trajectories=few).perf


def measured(
    problem: Problem,
    policy: Policy,
    simulated: Simulated | None,
    sets: list[Samples],
    posed: WellPosed,
    settings: CertificateSettings,
) -> Observed:
    """What the assumptions are held against, under the controller ``policy``."""
    with torch.no_grad():
        sup_control = max(float(policy(samples.x[:4096]).norm(dim=-1).max()) for samples in sets)
    states = torch.cat([samples.x[:256] for samples in sets])
    near = states if simulated is None else torch.cat([states, simulated.end_states[:4096]])
    jump = largest_jump(policy, problem.dim, problem=problem, near=near)
    occupation = a_priori = None
    # Where the problem says that mu* is unbounded there is no M to hold a largest density against.
    if simulated is not None and settings.occupation_states and problem.occupation_bound != math.inf:
        occupation = estimated_sup_occupation(problem, policy, simulated.end_states, settings.occupation_states)
        a_priori = a_priori_sup_occupation(problem, policy, sets[0].x[:4096])
    largest_value = simulated.largest_value if simulated is not None else None
    return Observed(occupation, a_priori, sup_control, largest_value, jump, posed)


def certification_stage(
    problem: Problem,
    trained: Trained,
    fields: Fields,
    constants: Constants,
    settings: CertificateSettings,
    sets: list[Samples],
    lower: LowerSide | None,
    kind: str,
    seed: int,
    odd: Tensor,
) -> tuple[ClosedLoopBounds | None, list[str]]:
    """Fit `mu` to the closed loop of the controller ``kind`` and evaluate its bounds, suprema at the states ``odd`` too;
    ``fields`` are float64 copies."""
    if not problem.gives_divergences:
        return None, ["no upper bound without simulation: this problem gives no divergences of a and B."]
    rough = trained_policies(trained.occupation, problem, trained.fields, constants)[kind]
    try:
        fitted = fit_closed_loop(problem, rough, trained.fields, trained.network, constants, settings.stage, seed)
    except ArithmeticError as error:
        return None, [f"the certification stage failed: {error}"]
    fitted = in_float64(fitted)
    loop = ClosedLoop(problem, trained_policies(trained.occupation, problem, fields, constants)[kind])
    value = fields.value if fields.value is not None else fitted.value
    initial = lower.initial if lower is not None else None
    judge = lambda sets: closed_loop_bounds(
        loop, value, fitted.log_occupation, loop.samples_of(sets), settings.ascents, kind, initial, odd
    )
    return sharpened(judge, problem, sets, seed), []


def searches_of(
    lower: LowerSide | None, stage: ClosedLoopBounds | None, proved: RigorousBound | None = None
) -> list[str]:
    """How each supremum was found."""
    found = {lower.best.sentence: lower.best.largest} if lower else {}
    if stage is not None:
        found |= {"eps_hi": stage.eps_hi, "eps_lo": stage.eps_lo}
    return ([proved.sentence] if proved else []) + [
        f"{name} = {e.value:.3e}, the largest of {e.points:,} sampled states and {e.ascents} ascents"
        for name, e in found.items()
    ]


def _plausibility(perf: dict, zero) -> list[str]:
    """What a user should know of the controllers themselves."""
    notes = [
        f"the performance of the controller from {name} is not finite; it is left out."
        for name, estimate in perf.items()
        if estimate is not None and not estimate.finite
    ]
    known = [e.above for e in perf.values() if e is not None and e.finite]
    if known and zero is not None and min(known) > zero.above:
        notes.append("the best controller is worse than doing nothing.")
    return notes
