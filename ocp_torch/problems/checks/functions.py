"""The functions of a problem, asked with care: what each gives has the right shape, precision and device."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ocp_torch.errors import InputError, ProblemError
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.problems.blame import failing_state, named, origin, place, words
from ocp_torch.problems.problem import Problem

# Function -> shape of its answer beyond N, in the letters of the documentation.
DATA = {"state_cost": "", "drift": "d", "control_matrix": "dm", "initial_density": ""}
DIVERGENCES = {"drift_divergence": "", "control_divergence": "m"}
TRUTH = {"exact_value": "", "exact_control": "m", "exact_occupation": ""}
FORMS = {**DATA, **DIVERGENCES, **TRUTH}
NOISE = "noise"  # sigma, of `k` Brownian motions, where there is noise
# Names for the two answers of `noise_divergences`.
DIV_D = "noise_divergences[0]"
DIV_DIV_D = "noise_divergences[1]"
SPREAD = {DIV_D: "d", DIV_DIV_D: ""}
STATES = 4096  # at which everything must be finite
STATES_OF_A_SIMULATOR = 512  # instead, where each state may cost milliseconds
MOST_ENTRIES = 2**22  # of `B` at all of these states, which bounds the memory
FEWEST_STATES = 16  # however large `B` is
# States that are compared a period apart are odd multiples of 1 / 2^17: on no grid of cells, and unchanged to the bit, in
# single precision too, when a few periods are added.
GRID = 2**17
# Each check has a fixed design of states, the same for every problem and run: this plus the check's own number.
FIRST_DESIGN = 11


class Functions:
    """The functions of ``problem`` by name; ``simulator`` where each state may cost milliseconds.

    ``name`` is the class as a command line has it, ``count`` the number of states for checks that need many. ``forms`` has
    the shapes of all functions, ``data`` those of the functions that must give a tensor. ``cost`` and ``density`` name the
    functions that must not be negative, ``sigma`` the noise; ``where`` says where all of them must be finite.
    """

    cost, density, sigma = "state_cost", "initial_density", NOISE
    own_forms, own_data, spread, where = FORMS, DATA, SPREAD, "on the whole torus"

    def __init__(self, problem: Problem, simulator: bool) -> None:
        self.problem, self.simulator = problem, simulator
        self.name = named(problem)
        self.sizes = {"d": problem.dim, "m": problem.control_dim}
        entries = problem.dim * problem.control_dim
        most = STATES_OF_A_SIMULATOR if simulator else STATES
        self.count = max(FEWEST_STATES, min(most, MOST_ENTRIES // entries))
        self.forms, self.data = self.own_forms, self.own_data
        first = self.called(self.function(self.sigma), self.states(FEWEST_STATES), self.sigma)
        self.noisy = first is not None
        if self.noisy:
            self.sizes["k"] = max(1, *first.shape[2:3]) if isinstance(first, Tensor) and first.ndim == 3 else 1
            self.data = {**self.own_data, self.sigma: "dk"}
            # The divergences of a simulator's noise are differences already: there is nothing to compare.
            self.forms = {**self.own_forms, **self.data, **({} if simulator else self.spread)}

    def place(self, x: Tensor) -> str:
        """One state ``(d,)`` of the torus for a sentence, in physical units where the problem has some."""
        chart = getattr(self.problem, "chart", None)
        return place(x) if chart is None else chart.place(chart.from_torus(x.unsqueeze(0))[0])

    def states(self, count: int, design: int = 0) -> Tensor:
        """Evenly spread states, ``(count, d)`` float64."""
        return scrambled_sobol(count, self.problem.dim, FIRST_DESIGN + design, torch.float64)

    def exact_states(self, count: int, design: int) -> Tensor:
        """States ``(count, d)`` that are the same to the bit in both precisions, and after a few periods (see `GRID`)."""
        return ((self.states(count, design) * (GRID // 2)).floor() * 2.0 + 1.0) / GRID

    def require_silence(self, x: Tensor) -> None:
        """Raise where the noise is `None` at some states and given at ``x``."""
        if not self.noisy and self.called(self.function(self.sigma), x.clone(), self.sigma) is not None:
            raise ProblemError(
                f"{self.sigma} of {self.name} gives None for some states and a matrix for others; it must give None always, "
                "or always a matrix of shape (N, d, k), which may be 0."
            )

    def ask(self, name: str, x: Tensor) -> Tensor:
        """`given` for a function that must give a tensor."""
        answer = self.given(name, x)
        assert answer is not None
        return answer

    def given(self, name: str, x: Tensor) -> Tensor | None:
        """What the function ``name`` gives at ``x`` ``(N, d)``; `None` only from a function that may give it.

        Raises `ProblemError` where it raises, changes ``x``, or gives another type, shape, precision or device.
        """
        answer = self.called(self.function(name), given := x.clone(), name)
        if not torch.equal(given, x):
            raise ProblemError(
                f"{name} of {self.name} changes its argument x in place; it must leave it as it is (x = x.clone() first)."
            )
        if answer is None and name not in self.data:
            return None
        self._require_form(name, answer, x)
        return answer

    def function(self, name: str) -> Callable[[Tensor], Any]:
        """The function ``name`` of the problem."""
        if name not in SPREAD:
            return getattr(self.problem, name)
        return lambda x: None if (pair := self._divergence_pair(x)) is None else pair[name == DIV_DIV_D]

    def _divergence_pair(self, x: Tensor):
        pair = self.problem.noise_divergences(x)
        if pair is not None and not (isinstance(pair, tuple | list) and len(pair) == 2):
            raise ProblemError(
                f"noise_divergences of {self.name} gave a {type(pair).__name__}, but must give two tensors, div D of shape "
                "(N, d) and div div D of shape (N,), or None where they are not known."
            )
        return pair

    def called(self, function: Callable, x: Tensor, name: str):
        """What ``function``, called ``name``, gives at ``x``; whatever it raises becomes a `ProblemError` of one sentence."""
        try:
            return function(x)
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # whatever a stranger's code may raise
            state = failing_state(function, x)
            at = f"states of shape {tuple(x.shape)} in {_kind(x)}" if state is None else self.place(state)
            where = origin(error, type(self.problem))
            raise ProblemError(f"{name} of {self.name} raised {words(error)} at {at}{where}.") from None

    def _require_form(self, name: str, answer: object, x: Tensor) -> None:
        letters = self.forms[name]
        wanted = (len(x), *(self.sizes[letter] for letter in letters))
        form = f"(N, {', '.join(letters)})".replace(", )", ",)")
        if not isinstance(answer, Tensor):
            kind = f"{type(answer).__module__}.{type(answer).__qualname__}".removeprefix("builtins.")
            raise ProblemError(
                f"{name} of {self.name} gave a {kind} for states of shape {tuple(x.shape)}, but must give a torch tensor of "
                f"shape {form}; torch.as_tensor(.., dtype=x.dtype, device=x.device) makes one."
            )
        if tuple(answer.shape) != wanted:
            sizes = ", ".join(f"{k} = {self.sizes[k]}" for k in letters)
            hint = f" with {sizes}" if sizes else ""
            hint += " (control_dim is d unless super().__init__ is given another)" if "m" in letters else ""
            hint += " (a column for each of k Brownian motions, as many at all states)" if "k" in letters else ""
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
