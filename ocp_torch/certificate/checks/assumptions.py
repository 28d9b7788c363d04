"""The assumptions the bounds rest on, and whether what was observed under the controller contradicts them."""

import math
from dataclasses import dataclass, field, replace

from ocp_torch.problems.needs import GIVEN, GUESSED, SEARCHED, Need


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
    basis: dict[str, str] = field(default_factory=dict)  # of M and C_V (`ocp_torch.problems.needs`); given if absent
    warnings: list[str] = field(default_factory=list)

    @property
    def hold(self) -> bool:
        """Whether every check passed; a guessed `M`, which nothing that counts rests on, is not among them."""
        unused = {"occupation_holds"} if self.basis.get("M") == GUESSED else set()
        return all(v for k, v in vars(self).items() if k.endswith("_holds") and k not in unused)

    @property
    def M_is_large(self) -> Need:
        """`M >= sup mu*`."""
        return Need("M", self.basis.get("M", GIVEN), f"sup mu* <= {_number(self.M)}", self.occupation_holds)

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

    def with_value_bound(self, C_V: float) -> "Assumptions":
        """With the `C_V` that the suprema found of `V` and its slack prove for the controller at hand."""
        return replace(self, C_V=C_V, value_holds=True, control_holds=True, basis=self.basis | {"C_V": SEARCHED})

    def to_dict(self) -> dict:
        """JSON form of the numbers; a supremum that grew beyond all numbers is null."""
        numbers = {k: v for k, v in vars(self).items() if not k.endswith("_holds") and k not in ("basis", "warnings")}
        finite = {k: v if v is None or math.isfinite(v) else None for k, v in numbers.items()}
        return {**finite, "hold": self.hold}


def found_by_search(what: str) -> Need:
    """That the supremum ``what``, the largest value of sampled states and ascents, is the true one."""
    return Need(what, SEARCHED, f"{what} is what the search found")


def _number(value: float | None) -> str:
    return "?" if value is None else f"{value:.4g}"
