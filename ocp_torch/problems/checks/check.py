"""All checks of a problem, the cheap ones first. Every failure is one sentence with function, shape or state.

Only what is certainly wrong is refused. Rough and discontinuous functions are legal, so answers are compared only at states
that are the same to the bit, in single precision too, and away from where functions often jump.
"""

import difflib
import inspect
import math
from types import CodeType

import torch
from torch import Tensor

from ocp_torch.errors import ProblemError, require_integer, require_number, shown
from ocp_torch.problems.blame import named
from ocp_torch.problems.checks.functions import Functions
from ocp_torch.problems.checks.mass import require_mass
from ocp_torch.problems.checks.physical import SystemFunctions, require_turns
from ocp_torch.problems.checks.sameness import (
    Answers,
    require_concurrency,
    require_differentiable,
    require_period,
    require_purity,
    require_still,
)
from ocp_torch.problems.checks.slopes import require_slopes
from ocp_torch.problems.checks.values import require_divergences, require_finite, require_kept_noise, require_signs
from ocp_torch.problems.control_limit import control_cost
from ocp_torch.problems.lipschitz import Lipschitz
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import MOST_COORDINATES, Problem, shipped
from ocp_torch.problems.simulator.simulator import Simulator

# Sizes of the batches that shapes are checked with: 7 and 37 are no likely d or m, 1 is a single state.
SIZES = (7, 1, 37, 2)
SET_BY_INIT = ("dim", "control_dim", "discount", "exponent", "control_cost")
# Methods that users write of systems and of problems on the torus.
OF_SYSTEMS = ("cost", "dynamics", "disturbance")
OF_PROBLEMS = ("state_cost", "drift", "control_matrix", "noise", "initial_density")
# Similarity by `difflib` from which on a method counts as a misspelled one of these: drfit for drift is 0.8.
ALIKE = 0.8
DECLARED = ("state_cost_bound", "occupation_bound", "control_bound", "value_bound", "exact_optimum")
# Turns of a state round the torus within 1 / discount. Paths are simulated in steps of a fraction of a turn, which are
# halved: for 300 turns 15,000 and 31,000 steps took two minutes.
MOST_TURNS = 1e3
# The square of the turns that noise may spread a state over in that time.
MOST_SPREAD = 1e4
SPEED_STATES = 64  # at which typical speeds are taken
SPEED_DESIGN = 13  # the number of their fixed design


def check_once(problem: Problem) -> None:
    """Raise `InputError` where ``problem`` is not what `Problem` says one is; costs some ten thousand evaluations.

    The package's own classes are tested instead, and a data set has checks of its own.
    """
    require_made(problem)
    if not problem.has_simulator:
        return
    simulator = isinstance(problem, Simulator)
    if simulator or not shipped(type(problem)):
        require_spelling(problem)
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            if isinstance(problem, System):
                require_system(SystemFunctions(problem))
            _check(Functions(problem, simulator))
    require_units(problem)


def _check(functions: Functions) -> None:
    first = _require_functions(functions)
    for require in (
        require_finite,
        require_period,
        require_signs,
        require_kept_noise,
        require_divergences,
        require_slopes,
        require_mass,
        require_concurrency,
    ):
        require(functions)
    require_still(functions, first)


def require_system(functions: SystemFunctions) -> None:
    """Raise where what a user wrote of a system, in physical units, is not what `System` says."""
    first = _require_functions(functions)
    for require in (require_finite, require_turns, require_signs, require_slopes):
        require(functions)
    require_still(functions, first)


def _require_functions(functions: Functions) -> Answers:
    """Raise where the functions have wrong shapes or depend on more than the state; their first answers."""
    _require_forms(functions, list(functions.data))
    first = require_purity(functions)
    if not functions.simulator:  # before the divergences, which autograd makes of these
        require_differentiable(functions)
    _require_forms(functions, [name for name in functions.forms if name not in functions.data])
    return first


def _require_forms(functions: Functions, names: list[str]) -> None:
    for dtype in (torch.float64, torch.float32):
        for size in SIZES:
            x = functions.states(size).to(dtype)
            for name in names:
                functions.given(name, x)
            functions.require_silence(x)


def require_made(problem: Problem) -> None:
    """Raise where something that `Problem.__init__` sets is missing, or was changed afterwards."""
    missing = [name for name in SET_BY_INIT if not _has(problem, name)]
    if missing:
        call = "coordinates, controls, .." if isinstance(problem, System) else "dim=.."
        raise ProblemError(
            f"{named(problem)} has no {missing[0]}: its __init__ must call super().__init__({call}), which sets it."
        )
    if not callable(problem.noise):
        raise ProblemError(
            f"{named(problem)} sets noise to {shown(problem.noise)}, but noise is a function of the state; give a number to "
            "super().__init__(noise=..) and leave self.noise alone."
        )
    require_integer("problem.dim", problem.dim, 1, maximum=MOST_COORDINATES)
    require_integer("problem.control_dim", problem.control_dim, 1, maximum=MOST_COORDINATES)
    require_number("problem.discount", problem.discount, above=0.0)
    require_number("problem.exponent", problem.exponent, above=1.0, at_most=2.0)
    expected = control_cost(problem.exponent, problem.control_limit)
    cost = problem.control_cost
    if type(cost) is type(expected) and (cost.q, cost.limit) != (expected.q, expected.limit):
        raise ProblemError(
            f"{named(problem)} changes exponent or control_limit after super().__init__, which has made the control cost of "
            "them; give both to super().__init__."
        )
    replaced = [name for name in (*OF_SYSTEMS, *OF_PROBLEMS) if name in vars(problem)]
    if replaced and shipped(type(problem)):  # whose name is all that the files of a run have of it
        raise ProblemError(
            f"{replaced[0]} is set on an object of {named(problem)}, whose files name only this class of the package, "
            "without it; write a subclass that has it."
        )
    for name in DECLARED:
        bound = getattr(problem, name, None)
        infinite = name == "occupation_bound" and bound == math.inf
        if bound is not None and not infinite:
            require_number(f"{name} of {named(problem)}", _number(bound))
    constants = Lipschitz() if problem.lipschitz is None else problem.lipschitz
    if not isinstance(constants, Lipschitz):
        raise ProblemError(
            f"lipschitz of {named(problem)} is {shown(constants)}, but must be Lipschitz(state_cost=.., drift=.., ..) of "
            "ocp_torch.problems, or None."
        )
    for name, constant in vars(constants).items():
        if constant is not None:
            require_number(f"{name} in lipschitz of {named(problem)}", _number(constant), at_least=0.0)


def _number(given: object) -> object:
    """What a user declares, which may be a tensor of one number."""
    return given.item() if isinstance(given, Tensor) and given.ndim == 0 else given


def require_spelling(problem: Problem) -> None:
    """Raise where a method's name is almost that of one which users write and this class lacks: nothing would call it.
    Methods that the class itself uses are left alone."""
    members = [member for kind in type(problem).__mro__ if not shipped(kind) for member in vars(kind).items()]
    own = {name for name, value in members if inspect.isfunction(value)}
    functions = [inspect.unwrap(getattr(value, "fget", None) or value) for _, value in members]
    helpers = set[str]().union(*(_asked_for(f.__code__) for f in functions if inspect.isfunction(f)))
    base, written = (System, OF_SYSTEMS) if isinstance(problem, System) else (Problem, OF_PROBLEMS)
    for name in sorted(own - helpers):
        close = difflib.get_close_matches(name, {*written} - own, n=1, cutoff=ALIKE)
        if close and not name.startswith("_") and not hasattr(base, name):
            raise ProblemError(
                f"{named(problem)} defines {name}, which nothing asks for; did you mean {close[0]}? If not, give it a name "
                "that is less alike, or one that begins with _."
            )


def _asked_for(code: CodeType) -> set[str]:
    """All names that ``code``, and the functions within it, look up."""
    return {*code.co_names}.union(*(_asked_for(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


def require_units(problem: Problem) -> None:
    """Raise where units of cost and time make a state move too far within 1 / discount to be simulated."""
    x, f, a, B = problem.probe(SPEED_STATES, SPEED_DESIGN, "x", "f", "a", "B")
    # A typical control: it costs as much as the state cost varies.
    u = (problem.exponent * float(f.std())) ** (1.0 / problem.exponent)
    each = torch.as_tensor(problem.control_cost.sides).clamp_max(u).to(B)
    drift, push = float(a.norm(dim=-1).mean()), float((B * each).flatten(1).norm(dim=-1).mean())
    turns = (drift + push) / problem.discount
    if turns > MOST_TURNS:
        time = 1.0 / problem.discount
        raise ProblemError(
            f"the units of {named(problem)} are too far apart: within 1 / discount = {time:.3g} a state would move "
            f"{turns:.2g} times round the torus (drift {drift:.2g} and control {push:.2g} per unit of time), more than the "
            f"{MOST_TURNS:g} that can be followed; discount, drift and control_matrix must be of one unit of time, and "
            "state_cost of the unit of |u|^q / q: f times s goes with control_matrix times s^(-1/q)."
        )

    sigma = problem.noise(x)
    spread = 0.0 if sigma is None else float(sigma.square().sum(dim=(1, 2)).mean()) / problem.discount
    if spread > MOST_SPREAD:
        raise ProblemError(
            f"the noise of {named(problem)} is too large: within 1 / discount = {1.0 / problem.discount:.3g} it would spread "
            f"a state over {spread**0.5:.2g} turns of the torus, more than the {MOST_SPREAD**0.5:g} that can be followed; "
            "sigma is in turns per square root of the unit of time, and a diffusion in turns squared per unit of time."
        )


def _has(problem: Problem, name: str) -> bool:
    try:
        return getattr(problem, name, None) is not None
    except Exception:  # a user's own property may need what is missing
        return False
