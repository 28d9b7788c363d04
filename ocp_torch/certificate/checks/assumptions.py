"""The assumptions the bounds rest on, and whether what was observed under the controller contradicts them."""

import math
from dataclasses import dataclass, field, replace

import torch

from ocp_torch.certificate.checks.observed import Observed
from ocp_torch.certificate.checks.wellposed import WellPosed
from ocp_torch.problems.constants import FROM_DENSITY, FROM_PROBLEM, Constants
from ocp_torch.problems.needs import GIVEN, GUESSED, PROVED, SEARCHED, Need
from ocp_torch.problems.problem import Problem, shipped

TOLERANCE = 0.02  # relative excess of an estimated supremum over a bound, up to which numerical errors explain it
VALUE_TOLERANCE = 1e-3  # relative excess of a simulated value over C_V that numerical errors explain
# An M that is not declared must be this factor above the density observed: trained with an M that is too small the dual keeps
# the density just below it, and F_M is then above OPT.
CLEARANCE = 1.1
# Factor by which an imperfect controller's density may exceed a sup mu* that a problem declares without showing it exact.
DECLARED = 1.25


@dataclass(frozen=True)
class Assumptions:
    """The constants used, what was estimated beside them, whether every check passed, and a warning for each that did not.

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
    basis: dict[str, str] = field(default_factory=dict)  # of M and C_V, given if absent, and of the data (`needs`)
    M_is: str = ""  # how `M` was guessed, where there is more to say of it
    warnings: list[str] = field(default_factory=list)

    @property
    def hold(self) -> bool:
        """Whether every check passed; a guessed `M`, which nothing that counts rests on, is not among them."""
        unused = {"occupation_holds"} if self.basis.get("M") == GUESSED else set()
        return all(v for k, v in vars(self).items() if k.endswith("_holds") and k not in unused)

    @property
    def M_is_large(self) -> Need:
        """`M >= sup mu*`."""
        condition = f"sup mu* <= {_number(self.M)}" + (f" ({self.M_is})" if self.M_is else "")
        return Need("M", self.basis.get("M", GIVEN), condition, self.occupation_holds)

    @property
    def C_V_is_large(self) -> Need:
        """`C_V >= sup V`, of the optimum for a bound on `OPT`, of the controller for one on its performance."""
        return Need("C_V", self.basis.get("C_V", GIVEN), f"sup V <= {_number(self.C_V)}", self.value_holds)

    @property
    def cost_is_positive(self) -> Need:
        """`f >= 0`."""
        return Need("f", SEARCHED, "f >= 0 everywhere", self.cost_holds)

    @property
    def regular(self) -> Need:
        """No jumps, where a divergence is used."""
        return Need("regular", SEARCHED, "neither a, B nor the controller jumps", self.regular_holds)

    @property
    def data_are_enclosed(self) -> Need:
        """What a proof over cells assumes of the data between states."""
        return Need(
            "data", self.basis.get("data", PROVED), "the data are within their enclosure or Lipschitz constants"
        )

    def with_value_bound(self, C_V: float) -> "Assumptions":
        """These assumptions with the `C_V` that the suprema found of `V` and its slack prove for the controller at hand."""
        return replace(self, C_V=C_V, value_holds=True, control_holds=True, basis=self.basis | {"C_V": SEARCHED})

    def to_dict(self) -> dict:
        """JSON form of the numbers; an infinite supremum is null."""
        numbers = {
            k: v for k, v in vars(self).items() if not k.endswith("_holds") and k not in ("basis", "M_is", "warnings")
        }
        finite = {k: v if v is None or math.isfinite(v) else None for k, v in numbers.items()}
        return {**finite, "hold": self.hold}


def found_by_search(what: str) -> Need:
    """The need that the supremum ``what``, the largest value of sampled states and ascents, is the true one."""
    return Need(what, SEARCHED, f"{what} is what the search found")


def _number(value: float | None) -> str:
    return "?" if value is None else f"{value:.4g}"


def check_assumptions(
    problem: Problem, constants: Constants, posed: WellPosed, observed: Observed, uses: tuple[bool, bool]
) -> Assumptions:
    """Compare what was ``observed`` with ``constants``: the assumptions, with a warning for each that fails.

    ``uses`` says whether the certificate has a lower side, which rests on `M`, and an upper one that rests on `C_V`.
    """
    uses_M, uses_C_V = uses
    M_is = FROM_DENSITY if constants.sources["M"] == FROM_DENSITY else ""
    jump, reached = observed.jump, observed.largest_value
    warnings = list(posed.warnings)
    M_holds, why = occupation_holds(problem, constants, observed.sup_occupation, posed.mass)
    if uses_M and not M_holds:
        warnings.append(f"F_M is not used: {why}.")
    elif uses_M and constants.basis("M") == GUESSED:
        how = f", {M_is}," if M_is else ","
        warnings.append(
            f"F_M is a bound only if sup mu* <= {constants.M:.4g}{how} a guess: no gap that counts uses it."
        )
    C_V_holds = value_holds(reached, constants)
    if uses_C_V and not C_V_holds:
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
        value_holds=C_V_holds or not uses_C_V,
        control_holds=control_holds or not uses_C_V,
        regular_holds=not jumps and posed.smooth_seam,
        cost_holds=posed.nonnegative,
        problem_holds=posed.sound,
        a_priori_sup_occupation=observed.a_priori_occupation,
        largest_value=reached,
        largest_jump=jump.size if jump else None,
        smallest_state_cost=posed.smallest_cost,
        initial_mass=posed.mass,
        basis={
            "M": constants.basis("M"),
            "C_V": constants.basis("C_V"),
            "data": PROVED if shipped(type(problem)) else GIVEN,  # enclosures of the package's own problems are tested
        },
        M_is=M_is,
        warnings=warnings,
    )


def value_holds(reached: float | None, constants: Constants) -> bool:
    """Whether the largest value that a controller ``reached``, if it is known, does not exceed `C_V`."""
    return reached is None or reached <= constants.C_V * (1.0 + VALUE_TOLERANCE)


def occupation_holds(
    problem: Problem, constants: Constants, estimate: float | None, mass: float = 1.0
) -> tuple[bool, str]:
    """Whether nothing contradicts `M >= sup mu*`, and what does. An `M` that was given must be compared with ``estimate``,
    the supremum of the density under the controller, unless the problem knows `mu*` exactly; a guess stays one whatever it
    was compared with. ``mass`` is the integral of `mu0`, and so of every occupation density."""
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
