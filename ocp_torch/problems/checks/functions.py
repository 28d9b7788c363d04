"""The functions of a problem, asked with care: what each gives has the right shape, precision and device."""

from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.errors import InputError, ProblemError
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.problems.blame import failing_state, named, origin, place, words
from ocp_torch.problems.problem import Problem

# Shape of the answer beyond N, in the letters of the documentation.
DATA = {"state_cost": "", "drift": "d", "control_matrix": "dm", "initial_density": ""}
DIVERGENCES = {"drift_divergence": "", "control_divergence": "m"}
TRUTH = {"exact_value": "", "exact_control": "m", "exact_occupation": ""}
FORMS = {**DATA, **DIVERGENCES, **TRUTH}
# States at which everything must be finite; fewer where a matrix `B` for each would fill the memory, or each is a simulation,
# and some in any case.
STATES, MOST_ENTRIES, STATES_OF_A_SIMULATOR, FEWEST_STATES = 4096, 2**22, 512, 16
# Denominator of the states that are compared a period apart: odd multiples of 1 / 2^17 lie on no grid of cells, and stay
# what they are, in single precision too, when a few periods are added.
GRID = 2**17
# States of a check are a fixed design, the same for every problem and run: its number is this plus that of the check.
FIRST_DESIGN = 11


class Functions:
    """The functions of ``problem`` by name; ``simulator`` where each state may cost milliseconds.

    ``name`` is the class as a command line has it, ``count`` the number of states for checks that need many.
    """

    def __init__(self, problem: Problem, simulator: bool) -> None:
        self.problem, self.simulator = problem, simulator
        self.name = named(problem)
        self.sizes = {"d": problem.dim, "m": problem.control_dim}
        entries = problem.dim * problem.control_dim
        most = STATES_OF_A_SIMULATOR if simulator else STATES
        self.count = max(FEWEST_STATES, min(most, MOST_ENTRIES // entries))

    def states(self, count: int, design: int = 0) -> Tensor:
        """Evenly spread states, ``(count, d)`` float64."""
        return scrambled_sobol(count, self.problem.dim, FIRST_DESIGN + design, torch.float64)

    def exact_states(self, count: int, design: int) -> Tensor:
        """States that survive both precisions and a few periods to the bit (see `GRID`), ``(count, d)``."""
        return ((self.states(count, design) * (GRID // 2)).floor() * 2.0 + 1.0) / GRID

    def ask(self, name: str, x: Tensor) -> Tensor:
        """As `given`, of a function that must give a tensor."""
        answer = self.given(name, x)
        assert answer is not None
        return answer

    def given(self, name: str, x: Tensor) -> Tensor | None:
        """What the function ``name`` gives at ``x`` ``(N, d)``; `None` only where it may.

        Raises `ProblemError` where it raises, changes ``x``, or gives another type, shape, precision or device.
        """
        answer = self.called(getattr(self.problem, name), given := x.clone(), name)
        if not torch.equal(given, x):
            raise ProblemError(
                f"{name} of {self.name} changes its argument x in place; it must leave it as it is (x = x.clone() first)."
            )
        if answer is None and name not in DATA:
            return None
        self._require_form(name, answer, x)
        return answer

    def called(self, function: Callable, x: Tensor, name: str):
        """What ``function``, the one called ``name``, gives at ``x``; whatever it raises as one sentence."""
        try:
            return function(x)
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # whatever a stranger's code may raise
            state = failing_state(function, x)
            at = f"states of shape {tuple(x.shape)} in {_kind(x)}" if state is None else place(state)
            where = origin(error, type(self.problem))
            raise ProblemError(f"{name} of {self.name} raised {words(error)} at {at}{where}.") from None

    def _require_form(self, name: str, answer: object, x: Tensor) -> None:
        wanted = (len(x), *(self.sizes[letter] for letter in FORMS[name]))
        form = f"(N, {', '.join(FORMS[name])})".replace(", )", ",)")
        if not isinstance(answer, Tensor):
            kind = f"{type(answer).__module__}.{type(answer).__qualname__}".removeprefix("builtins.")
            raise ProblemError(
                f"{name} of {self.name} gave a {kind} for states of shape {tuple(x.shape)}, but must give a torch tensor of "
                f"shape {form}; torch.as_tensor(.., dtype=x.dtype, device=x.device) makes one."
            )
        if tuple(answer.shape) != wanted:
            sizes = ", ".join(f"{k} = {self.sizes[k]}" for k in FORMS[name])
            hint = f" with {sizes}" if sizes else ""
            hint += " (control_dim is d unless super().__init__ is given another)" if "m" in FORMS[name] else ""
            raise ProblemError(
                f"{name} of {self.name} gave shape {tuple(answer.shape)} for states of shape {tuple(x.shape)}, but must give "
                f"{form} = {wanted}{hint}."
            )
        if answer.dtype != x.dtype or answer.device != x.device:
            raise ProblemError(
                f"{name} of {self.name} gave {_kind(answer)} for states in {_kind(x)}, but must answer in the precision and "
                "on the device of x; make constants with dtype=x.dtype, device=x.device, or with .to(x)."
            )


def _kind(x: Tensor) -> str:
    return f"{x.dtype} on {x.device.type}"
