"""What is observed of a controller, and the constants of its problem held against that."""

import math
from dataclasses import dataclass

import torch

from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.checks.regularity import Jump, largest_jump
from ocp_torch.certificate.checks.wellposed import WellPosed
from ocp_torch.certificate.simulated.occupation import a_priori_sup_occupation, estimated_sup_occupation
from ocp_torch.certificate.simulated.performance import Simulated
from ocp_torch.control.policies import Policy
from ocp_torch.problems.constants import FROM_PROBLEM, Constants
from ocp_torch.problems.needs import GUESSED
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# Of each set of samples: states at which the control is looked at, and states that lines are drawn through in search of
# jumps. More find rarer ones and take longer.
CONTROLLED, CROSSED = 4096, 256
# An estimated supremum may exceed a bound by so much, relative to it, before it contradicts it; and a simulated value by so
# much before it contradicts C_V, since both carry numerical errors.
TOLERANCE, ROUGH = 0.02, 1e-3
# An M that somebody gave must be so much above the density observed. Trained with an M that is too small, a controller does
# not exceed it: the dual keeps its density just below, and F_M is then above OPT.
CLEARANCE = 1.1
# A sup mu* that a problem declares, but does not show to be exact, may be exceeded by an imperfect controller's density.
DECLARED = 1.25


@dataclass(frozen=True)
class Observed:
    """What the checks found; `None` where it was not looked for."""

    sup_occupation: float | None = None
    a_priori_occupation: float | None = None  # >= sup mu^u, by the divergence of the closed loop
    sup_control: float | None = None
    largest_value: float | None = None  # V^u at a simulated start
    jump: Jump | None = None


def observe(
    problem: Problem, policy: Policy, simulated: Simulated | None, sets: list[Samples], occupation_states: int
) -> Observed:
    """Look at the controller ``policy`` at the states of ``sets``, and where the trajectories of ``simulated`` end; its
    occupation density is computed at so many ``occupation_states``, 0 for not at all."""
    with torch.no_grad():
        sup_control = max(float(policy(samples.x[:CONTROLLED]).norm(dim=-1).max()) for samples in sets)
    near = torch.cat([samples.x[:CROSSED] for samples in sets])
    occupation = a_priori = largest_value = None
    if simulated is not None:
        near, largest_value = torch.cat([near, simulated.end_states[:CONTROLLED]]), simulated.largest_value
        # Where the problem says that mu* is unbounded there is no M to hold a largest density against.
        if occupation_states and problem.occupation_bound != math.inf:
            occupation = estimated_sup_occupation(problem, policy, simulated.end_states, occupation_states)
            a_priori = a_priori_sup_occupation(problem, policy, sets[0].x[:CONTROLLED])
    jump = largest_jump(policy, problem.dim, problem=problem, near=near)
    return Observed(occupation, a_priori, sup_control, largest_value, jump)


def check_assumptions(
    problem: Problem, constants: Constants, posed: WellPosed, observed: Observed, uses: tuple[bool, bool]
) -> Assumptions:
    """Hold what was ``observed`` against ``constants``: the assumptions, with a warning for each that fails.

    ``uses`` says whether the certificate has a lower side, which rests on `M`, and an upper one that rests on `C_V`.
    """
    uses_M, uses_C_V = uses
    jump, reached = observed.jump, observed.largest_value
    warnings = list(posed.warnings)
    M_holds, why = occupation_holds(problem, constants, observed.sup_occupation, posed.mass)
    if uses_M and not M_holds:
        warnings.append(f"F_M is not used: {why}.")
    elif uses_M and constants.basis("M") == GUESSED:
        warnings.append(f"F_M is a bound only if sup mu* <= {constants.M:.4g}, a guess: no gap uses it.")
    value_holds = reached is None or reached <= constants.C_V * (1.0 + ROUGH)
    if uses_C_V and not value_holds:
        warnings.append(
            f"J with C_V = {constants.C_V:.4g} and G are not used: the controller's value reaches {reached:.4g}."
        )
    control_holds = observed.sup_control is None or observed.sup_control <= constants.C_u * (1.0 + TOLERANCE)
    if not control_holds:
        warnings.append(f"the control reaches {observed.sup_control:.4g}, beyond C_u = {constants.C_u:.4g}.")
    jumps = jump is not None and jump.size > 0.0
    if jump is not None and jumps:
        at = [round(c, 4) for c in jump.x[:6].tolist()] + (["..."] if len(jump.x) > 6 else [])
        warnings.append(
            f"J and the Lagrangian bound are not used: the {jump.what} {jump.verb} by {jump.size:.3g}, at "
            f"x = {at} for one, and they need all to be without jumps."
        )
    return Assumptions(
        constants.M if uses_M else None,
        constants.C_V if uses_C_V else None,
        constants.C_u,
        observed.sup_occupation,
        observed.sup_control,
        occupation_holds=M_holds or not uses_M,
        value_holds=value_holds or not uses_C_V,
        control_holds=control_holds or not uses_C_V,
        regular_holds=not jumps and posed.smooth_seam,
        cost_holds=posed.nonnegative,
        problem_holds=posed.sound,
        a_priori_sup_occupation=observed.a_priori_occupation,
        largest_value=reached,
        largest_jump=jump.size if jump else None,
        smallest_state_cost=posed.smallest_cost,
        initial_mass=posed.mass,
        basis={"M": constants.basis("M"), "C_V": constants.basis("C_V")},
        warnings=warnings,
    )


def occupation_holds(
    problem: Problem, constants: Constants, estimate: float | None, mass: float = 1.0
) -> tuple[bool, str]:
    """Whether nothing speaks against `M >= sup mu*`, and what does. An `M` that was given must have been held against the
    density under the controller, of which ``estimate`` is the supremum, unless the problem knows `mu*` exactly; a guess stays
    one whatever it was held against. ``mass`` is the integral of `mu0`, and so of every occupation density."""
    true = problem.occupation_bound
    if true is not None and math.isinf(true):
        return False, "mu* is unbounded for this problem, so no M is large enough"
    point = torch.full((1, problem.dim), 0.5, dtype=torch.float64)
    if true is not None and constants.M >= true and problem.exact_occupation(point) is not None:
        return True, ""
    if constants.M < mass * (1.0 - 1e-6):
        return False, f"M = {constants.M:.4g} is below the mean of every occupation density, {mass:.4g}"
    if constants.sources["M"] != FROM_PROBLEM and true is not None and constants.M < true * (1.0 - TOLERANCE):
        return False, f"M = {constants.M:.4g} is below this problem's sup mu*, {true:.4g}"
    if estimate is None:
        blind = "was held against no occupation density: certificate.occupation_states is 0, or nothing was simulated"
        return constants.basis("M") == GUESSED, f"M = {constants.M:.4g} {blind}"
    reached = f"the occupation density under the controller reaches about {estimate:.4g}"
    if not math.isfinite(estimate):
        return False, "the occupation density under the controller grows beyond all bounds, so no M can be believed"
    if true is not None and constants.M >= true:
        return estimate <= DECLARED * constants.M, f"M = {constants.M:.4g}, as the problem declares, but {reached}"
    return (
        estimate * CLEARANCE <= constants.M,
        f"M = {constants.M:.4g}, but {reached}, and must stay clearly below M to say that M did not shape it",
    )
