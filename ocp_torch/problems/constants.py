"""The three constants `M`, `C_V` and `C_u` that bounds and training rest on, and where each came from."""

import math
from dataclasses import dataclass, replace

import torch

from ocp_torch.errors import ProblemError, require_number
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.blame import named, place
from ocp_torch.problems.idle_noise import idle_noise
from ocp_torch.problems.needs import GIVEN, GUESSED, SEARCHED
from ocp_torch.problems.problem import MARGIN, Problem
from ocp_torch.problems.scan import odd_states
from ocp_torch.problems.starts import drawn_starts, starts_narrowly

# On recorded data nobody knows mu*, and there is no bound without M: M is guessed as this multiple of sup mu0.
OCCUPATION_GUESS = 4.0
# Where no M is known to be large enough, training aims at the bound without M, and M is a weight: this multiple of sup mu0,
# which won on flows that contract onto a goal.
OCCUPATION_WEIGHT = 40.0
PROBED = 2**13  # states at which suprema of f and mu0 are sought
PROBED_MATRICES = 2**11  # states at which a and B are asked for: pseudo-inverses take longer
PROBED_STARTS = 2**8  # starts at which sup mu0 is sought where mu0 is narrow
# States scanned for a spike of `f`, times `Problem.scan_factor`.
SCANNED = 2**15

# A guessed M becomes this multiple of the largest density met under a controller: the controller need not be optimal, and a
# search meets less than the supremum.
OBSERVED_ROOM = 1.2

# Sources of a constant.
FROM_CONFIGURATION, FROM_PROBLEM, ESTIMATED = "configuration", "problem", "estimated"
FROM_DENSITY = f"{OBSERVED_ROOM:g} times the controller's density"


@dataclass(frozen=True)
class Constants:
    """`M`, `C_V` and `C_u`, meant to be at least `sup mu*`, `sup V*` and `sup |u*|`, and the source of each by its name.

    Where ``unbounded``, no `M` is known to be large enough: it is only a weight of training, which then aims at the bound
    without `M`.
    """

    M: float
    C_V: float
    C_u: float
    sources: dict[str, str]
    warnings: tuple[str, ...] = ()
    unbounded: bool = False

    def __post_init__(self) -> None:
        for name in ("M", "C_V", "C_u"):
            require_number(name, getattr(self, name), above=0.0)

    @property
    def needs_no_M(self) -> bool:
        """Whether the bound without `M` has to carry the lower side: no `M` is large enough, or nobody gave one."""
        return self.unbounded or self.basis("M") == GUESSED

    def basis(self, name: str) -> str:
        """The basis of the constant ``name``: given, searched or guessed (see `ocp_torch.problems.needs`)."""
        if self.sources[name] not in (ESTIMATED, FROM_DENSITY):
            return GIVEN
        return GUESSED if name == "M" else SEARCHED

    def informed(self, density: float | None) -> "Constants":
        """These constants with a guessed `M` guessed anew from the largest ``density`` met under a controller.

        The guess stays where the density is below 1, which is the mean of any density, or not finite; and where it is within
        a factor of `OBSERVED_ROOM` of `M`, as training with `M` may have made it so."""
        if self.basis("M") != GUESSED or density is None or not 1.0 <= density < math.inf:
            return self
        if self.M / OBSERVED_ROOM <= density <= self.M * OBSERVED_ROOM:
            return self
        return replace(self, M=OBSERVED_ROOM * density, sources=self.sources | {"M": FROM_DENSITY})


def resolve_constants(
    problem: Problem,
    occupation_bound: float | None = None,
    value_bound: float | None = None,
    control_bound: float | None = None,
) -> Constants:
    """Each bound from the configuration if it was set there, else from the problem, else estimated with a warning.

    `OPT <= J` needs `C_V >= sup V*`, for which `sup f` will do (Proposition 1), with noise as well: doing nothing costs no
    more. `C_u` is that of Proposition 2 where `a = 0` and there is no noise. Otherwise the same formula, with the
    least-squares `alpha` (`B alpha = a`), is an estimate: its proof takes `|B^T grad V*|` from the Hamilton-Jacobi-Bellman
    equation, state by state, where noise adds a `D : hess V*` of either sign. No bound rests on it, but the control is held
    against it. A limit on the control is a `C_u` that is known.
    """
    chosen: dict[str, float] = {}
    sources: dict[str, str] = {}
    notes: list[str] = []
    reach, declared_control = problem.control_cost.reach, problem.control_bound
    if declared_control is None or not math.isfinite(declared_control):
        declared_control = reach
    for name, field, configured, declared, estimate in (
        ("C_V", "method.value_bound", value_bound, problem.value_bound, _estimate_value_bound),
        ("C_u", "method.control_bound", control_bound, declared_control, _estimate_control_bound),
        ("M", "method.occupation_bound", occupation_bound, problem.occupation_bound, _estimate_occupation_bound),
    ):
        if configured is not None:
            chosen[name], sources[name] = require_number(field, configured, above=0.0), FROM_CONFIGURATION
        elif declared is not None and math.isfinite(declared):
            # J bounds the cost of a controller that is not quite optimal only if C_V leaves it room above V*.
            room = MARGIN if name == "C_V" else 1.0
            whose = f"{field.removeprefix('method.')} of {named(problem)}"
            chosen[name], sources[name] = room * require_number(whose, float(declared), above=0.0), FROM_PROBLEM
        else:
            (chosen[name], why), sources[name] = estimate(problem), ESTIMATED
            notes.append(f"{name} is not known: {chosen[name]:.4g} is {why}; {field} sets it.")
    chosen["C_u"] = min(chosen["C_u"], reach)
    true = problem.occupation_bound
    if sources["M"] == FROM_CONFIGURATION and true is not None and chosen["M"] < true:
        shown = f"{true:.4g}" if math.isfinite(true) else "infinite"
        notes.append(f"method.occupation_bound = {chosen['M']:.4g} is below this problem's sup mu*, which is {shown}.")
    if idle := idle_noise(problem):
        notes.append(f"{idle}, as noise takes longer to simulate.")
    unbounded = is_unbounded(problem, occupation_bound)
    return Constants(**chosen, sources=sources, warnings=tuple(notes), unbounded=unbounded)


def is_unbounded(problem: Problem, occupation_bound: float | None = None) -> bool:
    """Whether no `M` is known to be large enough: `mu*` is declared unbounded, or neither problem nor user
    (``occupation_bound``) bounds it. Never so for a data set of unknown `mu*`, which has no bound without `M`."""
    if problem.occupation_bound is None:
        return occupation_bound is None and problem.has_simulator
    return math.isinf(problem.occupation_bound)


def state_cost_supremum(problem: Problem) -> float:
    """`sup f`: the problem's own bound unless a larger value is met; else an estimate by sampling and ascents, with
    head-room. Raises `ProblemError` where `f` is not finite."""
    given = problem.state_cost_bound
    if given is not None and not (problem.has_simulator and problem.scan_factor):
        return given
    (x,) = problem.probe(PROBED, 1, "x")
    if problem.has_simulator:
        x = torch.cat([x, odd_states(problem, SCANNED * problem.scan_factor, 0)])
    found = supremum(problem.state_cost, x, differentiable=False)
    if not math.isfinite(found.value):
        raise ProblemError(f"state_cost is {found.value} at {place(found.x)}; it must be finite on the whole torus.")
    return given if given is not None and found.value <= given else MARGIN * found.value


def _estimate_value_bound(problem: Problem) -> tuple[float, str]:
    largest = state_cost_supremum(problem)
    if largest == 0.0:
        raise ProblemError(
            f"the state cost of {named(problem)} is 0 at all states that were tried, so that doing nothing is optimal; it "
            "must be above 0 somewhere."
        )
    met = f"{MARGIN:g} times the largest state cost met at sampled states"
    whence = "the problem's state_cost_bound" if _declares(problem, largest) else met
    return require_number(f"the state cost of {named(problem)}", largest), f"{whence}, which bounds V*"


def _declares(problem: Problem, largest: float) -> bool:
    """Whether ``largest``, of `state_cost_supremum`, is what the problem declares; a data set's own is of its samples."""
    return problem.has_simulator and largest == problem.state_cost_bound


def _estimate_control_bound(problem: Problem) -> tuple[float, str]:
    q, conjugate = problem.exponent, problem.control_cost.conjugate_exponent
    largest = state_cost_supremum(problem)
    total, most = 2.0 * conjugate * largest, "declared" if _declares(problem, largest) else "sampled"
    beside = ", which noise may take the control beyond" if problem.noisy else ""
    if problem.driftless:
        return total ** (1.0 / q), f"what Proposition 2 of the paper gives with a {most} sup f{beside}"
    B, a = problem.probe(PROBED_MATRICES, 1, "B", "a")
    alpha = (torch.linalg.pinv(B) @ a.unsqueeze(-1)).squeeze(-1)
    fastest = float(alpha.norm(dim=-1).max())
    return (total + 2.0**q * (conjugate - 1.0) * fastest) ** (
        1.0 / q
    ), f"what Proposition 2 of the paper gives with a least-squares alpha{beside}"


def _estimate_occupation_bound(problem: Problem) -> tuple[float, str]:
    (mu0,) = problem.probe(PROBED, 1, "mu0")
    guess = OCCUPATION_WEIGHT if is_unbounded(problem) else OCCUPATION_GUESS
    if problem.has_simulator and starts_narrowly(problem):
        mu0 = problem.initial_density(drawn_starts(problem, PROBED_STARTS, 1))
    return guess * float(mu0.max()), f"a guess to train with, {guess:g} times sup mu0"
