"""From trained fields to a certificate: nothing here knows how they were trained."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import nn

from ocp_torch.bounds import Bounds
from ocp_torch.certificate.assumptions import check_assumptions, estimated_sup_occupation
from ocp_torch.certificate.certificate import Certificate, Run
from ocp_torch.certificate.estimate import replicated_samples
from ocp_torch.certificate.performance import Simulated, simulate_performance
from ocp_torch.certificate.sides import lower_side, upper_side
from ocp_torch.control_laws import control_laws, occupation_density, zero_law
from ocp_torch.errors import require_integer
from ocp_torch.fields.fields import Fields
from ocp_torch.problems.problem import Problem


@dataclass(frozen=True)
class CertificateSettings:
    """How much is spent on a certificate. Raises `InputError` on counts that cannot give a standard error."""

    points: int = 8192  # states per replicate for the integrals and sampled suprema
    replicates: int = 8  # independent randomised point sets behind each standard error
    trajectories: int = 128  # simulated starts per replicate; 0 skips every simulation
    ascents: int = 32  # local ascents from the worst sampled states

    def __post_init__(self) -> None:
        require_integer("certificate.points", self.points, 1)
        require_integer("certificate.replicates", self.replicates, 2)
        require_integer("certificate.trajectories", self.trajectories, 0)
        require_integer("certificate.ascents", self.ascents, 1)


def in_float64(fields: Fields) -> Fields:
    """A frozen float64 copy on the CPU: what every bound is computed with."""
    clone: nn.Module = copy.deepcopy(fields).to("cpu").double().requires_grad_(False)
    return clone.eval()


def certify_fields(
    problem: Problem,
    fields: Fields,
    bounds: Bounds,
    occupation: str | None,
    settings: CertificateSettings,
    run: Run,
) -> Certificate:
    """The certificate of trained ``fields``, on states that no training sampler draws.

    ``occupation`` says how they give `mu` (see `control_laws`), `None` where they hold no `w`.
    """
    fields = in_float64(fields)
    seed, count = run.seed, settings.replicates
    has_value, has_density = fields.value is not None, fields.control_density is not None
    sets = replicated_samples(problem, settings.points, count, seed, divergences=has_density)
    lower = lower_side(problem, fields.value, sets, bounds.M, settings.ascents) if has_value else None
    J = G = None
    if has_density:
        mu = occupation_density(occupation, problem, fields, bounds)
        J, G = upper_side(problem, fields.control_density, mu, sets, bounds.C_V)
    laws = control_laws(occupation, problem, fields, bounds)
    simulated: dict[str, Simulated] = {}
    zero = None
    sup_control = sup_occupation = None
    if settings.trajectories:
        initial = lower.initial if lower else None
        for name, law in laws.items():
            simulated[name] = simulate_performance(
                problem, law, settings.trajectories, count, seed, value=fields.value, initial=initial
            )
        zero = simulate_performance(problem, zero_law(problem), settings.trajectories, count, seed).perf
    best = min(simulated, key=lambda n: simulated[n].perf.above, default=None)
    with torch.no_grad():
        if laws:
            law = laws[best or next(iter(laws))]
            sup_control = max(float(law(samples.x[:4096]).norm(dim=-1).max()) for samples in sets)
        if best is not None:
            sup_occupation = estimated_sup_occupation(problem, laws[best], simulated[best].end_states)
    assumptions, warnings = check_assumptions(
        problem,
        bounds,
        sup_occupation,
        sup_control,
        simulated[best].largest_value if best else None,
        uses=(has_value, has_density),
    )
    perf = {name: simulated[name].perf if name in simulated else None for name in ("value", "density")}
    warnings += _plausibility(perf, zero)
    return Certificate(
        run=run,
        exact=problem.exact_optimum,
        lower={"F_M": lower.F_M if lower else None, "shifted": lower.shifted if lower else None},
        upper={"J": J, "G": G, "lagrangian": None},
        perf=perf,
        baseline={"zero": zero},
        assumptions=assumptions,
        warnings=warnings,
    )


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
