"""What was observed of a controller, for the assumptions to be held against."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ocp_torch.certificate.checks.regularity import Jump, largest_jump
from ocp_torch.certificate.checks.wellposed import WellPosed
from ocp_torch.certificate.simulated.occupation import a_priori_sup_occupation, estimated_sup_occupation
from ocp_torch.certificate.simulated.performance import Simulated
from ocp_torch.control.policies import Policy
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# Of each set of samples: states at which the control is looked at, and states that lines are drawn through in search of
# jumps. More find rarer ones and take longer.
CONTROLLED, CROSSED = 4096, 256


@dataclass(frozen=True)
class Observed:
    """What the checks found; `None` where it was not looked for."""

    sup_occupation: float | None = None
    a_priori_occupation: float | None = None  # >= sup mu^u, by the divergence of the closed loop
    sup_control: float | None = None
    largest_value: float | None = None  # V^u at a simulated start
    jump: Jump | None = None
    problem: WellPosed | None = None


def observe(
    problem: Problem,
    policy: Policy,
    simulated: Simulated | None,
    sets: list[Samples],
    posed: WellPosed,
    occupation_states: int,
) -> Observed:
    """Look at the controller ``policy`` at the states of ``sets``, and where the trajectories of ``simulated`` end.

    ``occupation_states`` is the number of states at which its occupation density is computed; 0 skips that.
    """
    with torch.no_grad():
        sup_control = max(float(policy(samples.x[:CONTROLLED]).norm(dim=-1).max()) for samples in sets)
    states = torch.cat([samples.x[:CROSSED] for samples in sets])
    near = states if simulated is None else torch.cat([states, simulated.end_states[:CONTROLLED]])
    jump = largest_jump(policy, problem.dim, problem=problem, near=near)
    occupation = a_priori = None
    # Where the problem says that mu* is unbounded there is no M to hold a largest density against.
    if simulated is not None and occupation_states and problem.occupation_bound != math.inf:
        occupation = estimated_sup_occupation(problem, policy, simulated.end_states, occupation_states)
        a_priori = a_priori_sup_occupation(problem, policy, sets[0].x[:CONTROLLED])
    largest_value = simulated.largest_value if simulated is not None else None
    return Observed(occupation, a_priori, sup_control, largest_value, jump, posed)
