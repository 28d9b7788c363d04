r"""The assumptions the bounds rest on, held against what was met under the learned controller."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace

import torch

from ocp_torch.certificate.checks.regularity import Jump
from ocp_torch.certificate.checks.wellposed import WellPosed
from ocp_torch.certificate.simulated.occupation import estimated_sup_occupation, occupation_along_flow
from ocp_torch.problems.constants import FROM_PROBLEM, Constants
from ocp_torch.problems.needs import GIVEN, GUESSED, SEARCHED, Need
from ocp_torch.problems.problem import Problem

__all__ = ["Assumptions", "Observed", "check_assumptions", "estimated_sup_occupation", "occupation_along_flow"]

# An estimated supremum may exceed a bound by so much before it contradicts it.
TOLERANCE = 0.02
# An M that somebody gave must be so much above the density met. Trained with an M that is too small, a controller does
# not exceed it: the dual keeps its density just below, and F_M is then above OPT.
CLEARANCE = 1.1
# A sup mu* that a problem declares, but does not show to be exact, may be exceeded by an imperfect controller's density.
DECLARED = 1.25


@dataclass(frozen=True)
class Observed:
    """What the checks met; `None` where it was not looked for."""

    sup_occupation: float | None = None
    a_priori_occupation: float | None = None  # >= sup mu^u, by the divergence of the closed loop
    sup_control: float | None = None
    largest_value: float | None = None  # V^u at a simulated start
    jump: Jump | None = None
    problem: WellPosed | None = None


@dataclass(frozen=True)
class Assumptions:
    """The constants used, what was estimated beside them, and whether every check passed.

    The flags say which bounds stand: `F_M` needs ``occupation_holds``; `J` and `G` need ``value_holds`` and
    ``cost_holds``; `J` and the Lagrangian bound ``regular_holds``; everything needs ``problem_holds``.
    """

    M: float | None
    C_V: float | None
    C_u: float
    estimated_sup_occupation: float | None
    sup_control: float | None
    occupation_holds: bool
    value_holds: bool
    control_holds: bool
    regular_holds: bool = True
    cost_holds: bool = True
    problem_holds: bool = True
    a_priori_sup_occupation: float | None = None
    largest_value: float | None = None
    largest_jump: float | None = None
    smallest_state_cost: float | None = None
    initial_mass: float | None = None
    basis: dict[str, str] = field(
        default_factory=dict
    )  # of M and C_V (see `ocp_torch.problems.needs`); given if absent

    @property
    def hold(self) -> bool:
        """Whether every check passed; a guessed `M`, which nothing that counts rests on, is not among them."""
        unused = {"occupation_holds"} if self.basis.get("M") == GUESSED else set()
        return all(v for k, v in vars(self).items() if k.endswith("_holds") and k not in unused)

    def needs(self, name: str) -> tuple[Need, ...]:
        """What the bound ``name`` rests on, beside a problem that is one; nothing else for simulations and the truth."""
        found = "what the search found"
        regular = Need("regular", SEARCHED, "neither a, B nor the controller jumps", self.regular_holds)
        cost = Need("f", SEARCHED, "f >= 0 everywhere", self.cost_holds)
        M = Need("M", self.basis.get("M", GIVEN), f"sup mu* <= {_number(self.M)}", self.occupation_holds)
        C_V = Need("C_V", self.basis.get("C_V", GIVEN), f"sup V <= {_number(self.C_V)}", self.value_holds)
        slack = Need("sup Q", SEARCHED, f"sup Q is {found}")
        both = Need("sup |Q_u|", SEARCHED, f"sup |Q_u| is {found}")
        return {
            "F_M": (M,),
            "shifted": (slack,),
            "rigorous": (),
            "J": (C_V, cost, regular),
            "G": (C_V, cost),
            "lagrangian": (both, regular),
            "evaluation": (both,),
        }.get(name, ())

    def with_value_bound(self, C_V: float) -> Assumptions:
        """With the `C_V` that the suprema found of `V` and its slack prove for the controller at hand."""
        return replace(self, C_V=C_V, value_holds=True, control_holds=True, basis=self.basis | {"C_V": SEARCHED})

    def to_dict(self) -> dict:
        """JSON form; a supremum that grew beyond all numbers is null."""
        numbers = {k: v for k, v in asdict(self).items() if not k.endswith("_holds") and k != "basis"}
        finite = {k: v if v is None or math.isfinite(v) else None for k, v in numbers.items()}
        return {**finite, "hold": self.hold}


def check_assumptions(
    problem: Problem, constants: Constants, met: Observed, uses: tuple[bool, bool]
) -> tuple[Assumptions, list[str]]:
    """Hold what was ``met`` against ``constants``; ``uses`` says whether a lower and an upper side are in the certificate."""
    uses_M, uses_C_V = uses
    warnings = list(met.problem.warnings) if met.problem else []
    M_holds, why = occupation_holds(problem, constants, met)
    if uses_M and not M_holds:
        warnings.append(f"F_M is not used: {why}.")
    elif uses_M and constants.basis("M") == GUESSED:
        warnings.append(f"F_M is a bound only if sup mu* <= {constants.M:.4g}, a guess: no gap uses it.")
    value_holds = met.largest_value is None or met.largest_value <= constants.C_V * (1.0 + 1e-3)
    if uses_C_V and not value_holds:
        warnings.append(
            f"J with C_V = {constants.C_V:.4g} and G are not used: the controller's value reaches {met.largest_value:.4g}."
        )
    control_holds = met.sup_control is None or met.sup_control <= constants.C_u * (1.0 + TOLERANCE)
    if not control_holds:
        warnings.append(f"the control reaches {met.sup_control:.4g}, beyond C_u = {constants.C_u:.4g}.")
    jumps = met.jump is not None and met.jump.size > 0.0
    if jumps:
        at = [round(c, 4) for c in met.jump.x[:6].tolist()] + (["..."] if len(met.jump.x) > 6 else [])
        warnings.append(
            f"J and the Lagrangian bound are not used: the {met.jump.what} {met.jump.verb} by {met.jump.size:.3g}, at "
            f"x = {at} for one, and they need all to be without jumps."
        )
    assumptions = Assumptions(
        constants.M if uses_M else None,
        constants.C_V if uses_C_V else None,
        constants.C_u,
        met.sup_occupation,
        met.sup_control,
        occupation_holds=M_holds or not uses_M,
        value_holds=value_holds or not uses_C_V,
        control_holds=control_holds or not uses_C_V,
        regular_holds=not jumps and (met.problem is None or met.problem.smooth_seam),
        cost_holds=met.problem is None or met.problem.nonnegative,
        problem_holds=met.problem is None or met.problem.sound,
        a_priori_sup_occupation=met.a_priori_occupation,
        largest_value=met.largest_value,
        largest_jump=met.jump.size if met.jump else None,
        smallest_state_cost=met.problem.smallest_cost if met.problem else None,
        initial_mass=met.problem.mass if met.problem else None,
        basis={"M": constants.basis("M"), "C_V": constants.basis("C_V")},
    )
    return assumptions, warnings


def occupation_holds(problem: Problem, constants: Constants, met: Observed) -> tuple[bool, str]:
    """Whether nothing speaks against `M >= sup mu*`, and what does. An `M` that was given must have been held against the
    density under the controller, unless the problem knows `mu*` exactly; a guess stays one whatever it was held against."""
    true, estimate = problem.occupation_bound, met.sup_occupation
    if true is not None and math.isinf(true):
        return False, "mu* is unbounded for this problem, so no M is large enough"
    point = torch.full((1, problem.dim), 0.5, dtype=torch.float64)
    if true is not None and constants.M >= true and problem.exact_occupation(point) is not None:
        return True, ""
    mean = 1.0 if met.problem is None else met.problem.mass
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


def _number(value: float | None) -> str:
    return "?" if value is None else f"{value:.4g}"
