"""Hold the constants of a problem against what was observed under the controller that is certified."""

from __future__ import annotations

import math

import torch

from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.checks.observed import Observed
from ocp_torch.problems.constants import FROM_PROBLEM, Constants
from ocp_torch.problems.needs import GUESSED
from ocp_torch.problems.problem import Problem

# An estimated supremum may exceed a bound by so much, relative to it, before it contradicts it.
TOLERANCE = 0.02
# And a simulated value by so much before it contradicts C_V, since both carry numerical errors.
ROUGH = 1e-3
# An M that somebody gave must be so much above the density observed. Trained with an M that is too small, a controller does
# not exceed it: the dual keeps its density just below, and F_M is then above OPT.
CLEARANCE = 1.1
# A sup mu* that a problem declares, but does not show to be exact, may be exceeded by an imperfect controller's density.
DECLARED = 1.25


def check_assumptions(
    problem: Problem, constants: Constants, observed: Observed, uses: tuple[bool, bool]
) -> tuple[Assumptions, list[str]]:
    """Hold what was ``observed`` against ``constants``: the assumptions, and a warning for each that fails.

    ``uses`` says whether the certificate has a lower side, which rests on `M`, and an upper one that rests on `C_V`.
    """
    uses_M, uses_C_V = uses
    posed, jump, reached = observed.problem, observed.jump, observed.largest_value
    warnings = list(posed.warnings) if posed else []
    M_holds, why = occupation_holds(problem, constants, observed)
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
    jumps = jump if jump is not None and jump.size > 0.0 else None
    if jumps is not None:
        at = [round(c, 4) for c in jumps.x[:6].tolist()] + (["..."] if len(jumps.x) > 6 else [])
        warnings.append(
            f"J and the Lagrangian bound are not used: the {jumps.what} {jumps.verb} by {jumps.size:.3g}, at "
            f"x = {at} for one, and they need all to be without jumps."
        )
    assumptions = Assumptions(
        constants.M if uses_M else None,
        constants.C_V if uses_C_V else None,
        constants.C_u,
        observed.sup_occupation,
        observed.sup_control,
        occupation_holds=M_holds or not uses_M,
        value_holds=value_holds or not uses_C_V,
        control_holds=control_holds or not uses_C_V,
        regular_holds=jumps is None and (posed is None or posed.smooth_seam),
        cost_holds=posed is None or posed.nonnegative,
        problem_holds=posed is None or posed.sound,
        a_priori_sup_occupation=observed.a_priori_occupation,
        largest_value=reached,
        largest_jump=jump.size if jump else None,
        smallest_state_cost=posed.smallest_cost if posed else None,
        initial_mass=posed.mass if posed else None,
        basis={"M": constants.basis("M"), "C_V": constants.basis("C_V")},
    )
    return assumptions, warnings


def occupation_holds(problem: Problem, constants: Constants, observed: Observed) -> tuple[bool, str]:
    """Whether nothing speaks against `M >= sup mu*`, and what does. An `M` that was given must have been held against the
    density under the controller, unless the problem knows `mu*` exactly; a guess stays one whatever it was held against."""
    true, estimate = problem.occupation_bound, observed.sup_occupation
    if true is not None and math.isinf(true):
        return False, "mu* is unbounded for this problem, so no M is large enough"
    point = torch.full((1, problem.dim), 0.5, dtype=torch.float64)
    if true is not None and constants.M >= true and problem.exact_occupation(point) is not None:
        return True, ""
    mean = 1.0 if observed.problem is None else observed.problem.mass
    if constants.M < mean * (1.0 - 1e-6):
        return False, f"M = {constants.M:.4g} is below the mean of every occupation density, {mean:.4g}"
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
