"""A problem is checked once, before anything is trained: every failure is one sentence with function, shape or state.

What is refused is certainly wrong. Rough and discontinuous functions are legal, so answers are compared only at states that
are the same to the bit, in single precision too, and away from where functions like to jump.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.errors import InputError, ProblemError, require_integer, require_number
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.blame import failing_state, named, origin, place, words
from ocp_torch.problems.control_limit import control_cost
from ocp_torch.problems.mass import sampled_mass
from ocp_torch.problems.problem import MOST_COORDINATES, Problem

# Shape of the answer beyond N, in the letters of the documentation.
DATA = {"state_cost": "", "drift": "d", "control_matrix": "dm", "initial_density": ""}
DIVERGENCES = {"drift_divergence": "", "control_divergence": "m"}
TRUTH = {"exact_value": "", "exact_control": "m", "exact_occupation": ""}
FORMS = {**DATA, **DIVERGENCES, **TRUTH}
# Batches of so many states: none a likely d or m, and one of a single state.
SIZES = (7, 1, 37, 2)
# States at which everything must be finite; fewer where a matrix `B` for each would fill the memory, or each is a simulation.
STATES, MOST_ENTRIES, STATES_OF_A_SIMULATOR = 4096, 2**22, 512
# Answers that differ by more than that part of the largest are not the same; rounding in single precision stays below.
SAME = 1e-5
# A part of the largest cost that rounding may take f below 0 by.
ROUNDING = 1e-6
# Denominator of the states that are compared a period apart: odd multiples of 1 / 2^17 lie on no grid of cells, and stay
# what they are, in single precision too, when a few periods are added.
GRID = 2**17
# Divergences: states, the two steps of the differences, what these must agree to be believed, and how wrong is wrong.
FEW, STEPS, AGREE, WRONG = 24, (1e-3, 2.5e-4), 0.01, 0.1
# Simulated in steps of a fraction of a turn, more than that takes hours.
MOST_TURNS = 1e4
# Beyond so many numbers the differences behind a divergence cost too much.
MOST_DIFFERENCES = 2**24


def check_once(problem: Problem) -> None:
    """Raise `InputError` where ``problem`` is not what `Problem` says one is; costs some ten thousand evaluations.

    The package's own classes are tested instead, and a data set has checks of its own.
    """
    _require_made(problem)
    if not problem.has_simulator:
        return
    own = type(problem).__module__.startswith("ocp_torch.")
    simulator = hasattr(problem, "answers")
    if simulator or not own:
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            _Check(problem, simulator).run()
    _require_units(problem)


def _require_made(problem: Problem) -> None:
    """What `Problem.__init__` sets is there, and still what it was."""
    missing = [
        name for name in ("dim", "control_dim", "discount", "exponent", "control_cost") if not _has(problem, name)
    ]
    if missing:
        raise ProblemError(
            f"{named(problem)} has no {missing[0]}: its __init__ must call super().__init__(dim=..), which sets it."
        )
    require_integer("problem.dim", problem.dim, 1, maximum=MOST_COORDINATES)
    require_integer("problem.control_dim", problem.control_dim, 1, maximum=MOST_COORDINATES)
    require_number("problem.discount", problem.discount, above=0.0)
    require_number("problem.exponent", problem.exponent, above=1.0, at_most=2.0)
    expected = control_cost(problem.exponent, problem.control_limit)
    if type(problem.control_cost) is type(expected) and vars(problem.control_cost) != vars(expected):
        raise ProblemError(
            f"{named(problem)} changes exponent or control_limit after super().__init__, which has made the control cost of "
            "them; give both to super().__init__."
        )
    for name in ("state_cost_bound", "occupation_bound", "control_bound", "value_bound", "exact_optimum"):
        bound = getattr(problem, name, None)
        infinite = name == "occupation_bound" and bound == math.inf
        if bound is not None and not infinite:
            require_number(f"{name} of {named(problem)}", _number(bound))


def _require_units(problem: Problem) -> None:
    """Units of cost and time in which a state can be followed for the time that counts."""
    f, a, B = problem.probe(64, 13, "f", "a", "B")
    # A control that costs as much as the state cost varies.
    u = (problem.exponent * float(f.std())) ** (1.0 / problem.exponent)
    u = u if problem.control_limit is None else min(u, problem.control_limit)
    drift, push = float(a.norm(dim=-1).mean()), u * float(B.flatten(1).norm(dim=-1).mean())
    turns = (drift + push) / problem.discount
    if turns > MOST_TURNS:
        time = 1.0 / problem.discount
        raise ProblemError(
            f"the units of {named(problem)} are too far apart: within 1 / discount = {time:.3g} a state would move "
            f"{turns:.2g} times round the torus (drift {drift:.2g} and control {push:.2g} per unit of time), more than the "
            f"{MOST_TURNS:g} that can be followed; discount, drift and control_matrix must be of one unit of time, and "
            "state_cost of the unit of |u|^q / q: f times s goes with control_matrix times s^(-1/q)."
        )


def _has(problem: Problem, name: str) -> bool:
    try:
        return getattr(problem, name, None) is not None
    except Exception:  # a property of a user's own that leans on what is missing
        return False


def _number(value: object) -> object:
    return value.item() if isinstance(value, Tensor) and value.ndim == 0 else value


class _Check:
    def __init__(self, problem: Problem, simulator: bool) -> None:
        self.problem, self.simulator = problem, simulator
        self.name = named(problem)
        self.sizes = {"d": problem.dim, "m": problem.control_dim}
        entries = problem.dim * problem.control_dim
        most = STATES_OF_A_SIMULATOR if simulator else STATES
        self.count = max(16, min(most, MOST_ENTRIES // entries))

    def run(self) -> None:
        """All checks, the cheap ones first."""
        for dtype in (torch.float64, torch.float32):
            for size in SIZES:
                x = self._states(size).to(dtype)
                for name in FORMS:
                    self.ask(name, x)
        first = self._pure()
        if not self.simulator:
            self._differentiable()
        self._finite()
        self._periodic()
        self._signs()
        self._divergences()
        self._mass()
        self._still(first)

    def ask(self, name: str, x: Tensor) -> Tensor | None:
        """What the function ``name`` gives at ``x`` ``(N, d)``, its shape and type checked; `None` only where it may."""
        given = x.clone()
        answer = self._called(getattr(self.problem, name), given, f"{name} of {self.name}")
        if not torch.equal(given, x):
            raise ProblemError(
                f"{name} of {self.name} changes its argument x in place; it must leave it as it is (x = x.clone() first)."
            )
        wanted = (len(x), *(self.sizes[letter] for letter in FORMS[name]))
        form = f"(N, {', '.join(FORMS[name])})".replace(", )", ",)")
        if answer is None and name not in DATA:
            return None
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
        return answer

    def _called(self, function: Callable, x: Tensor, who: str):
        """``function`` at ``x``; whatever it raises as one sentence."""
        try:
            return function(x)
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # whatever a stranger's code may raise
            state = failing_state(function, x)
            at = f"states of shape {tuple(x.shape)} in {_kind(x)}" if state is None else place(state)
            where = origin(error, type(self.problem))
            raise ProblemError(f"{who} raised {words(error)} at {at}{where}.") from None

    def _states(self, count: int, branch: int = 0) -> Tensor:
        return scrambled_sobol(count, self.problem.dim, 11 + branch, torch.float64)

    def _odd(self, count: int, branch: int) -> Tensor:
        """States that survive both precisions and a few periods to the bit (see `GRID`)."""
        return ((self._states(count, branch) * (GRID // 2)).floor() * 2.0 + 1.0) / GRID

    def _pure(self) -> tuple[Tensor, dict[str, Tensor]]:
        """A function of each row alone: not of the other rows, nor of what was asked before, of this or another function."""
        x = self._odd(37, 1)
        kept = {name: self.ask(name, x) for name in DATA}
        first = {name: values.clone() for name, values in kept.items()}
        turned = x.flip(0)
        for name in reversed(DATA):
            self._same(name, x, first[name], self.ask(name, turned).flip(0), _OTHER_ROWS)
        for name, values in kept.items():
            self._same(
                name, x, first[name], values, "overwrites an answer it gave before; it must give a new tensor each time"
            )
        for name in DATA:
            for row in (0, 18, 36):
                alone = self.ask(name, x[row : row + 1])
                self._same(name, x[row : row + 1], first[name][row : row + 1], alone, _OTHER_ROWS, first[name])
        return x, first

    def _still(self, first: tuple[Tensor, dict[str, Tensor]]) -> None:
        """The same answers again, after some ten thousand others."""
        x, answers = first
        for name, values in answers.items():
            self._same(name, x, values, self.ask(name, x), _TWICE)

    def _same(
        self, name: str, x: Tensor, one: Tensor, other: Tensor, how: str, all_of_it: Tensor | None = None
    ) -> None:
        whole = one if all_of_it is None else all_of_it
        size = float(torch.cat([whole, other]).nan_to_num(0.0, 0.0, 0.0).abs().max())
        alike = (one == other) | (one.isnan() & other.isnan())  # what is not finite is told elsewhere
        change = torch.where(alike, 0.0, (one - other).abs()).reshape(len(x), -1).amax(dim=-1)
        worst = int(change.nan_to_num(nan=math.inf).argmax())
        if not float(change[worst]) <= SAME * size:
            raise ProblemError(f"{name} of {self.name} {how}: at {place(x[worst])} it differs by {change[worst]:.3g}.")

    def _differentiable(self) -> None:
        """Ascents to suprema differentiate by the state, as autograd's ordinary way does."""
        x = self._states(5, 2)
        for name in DATA:
            with torch.enable_grad():
                function = getattr(self.problem, name)
                self._called(lambda at, f=function: f(at.requires_grad_(True)), x.clone(), f"{name} of {self.name}")

    def _finite(self) -> None:
        """At evenly spread states and, the data, at those where a division goes wrong first: on the faces and the middles."""
        for dtype in (torch.float64, torch.float32):
            spread = self._states(self.count, 3).to(dtype).remainder(1.0)
            special = self._special().to(dtype)
            for name in FORMS:
                for x in (spread, special) if name in DATA else (spread[:256],):
                    values = self.ask(name, x)
                    if values is None:
                        continue
                    bad = ~torch.isfinite(values).reshape(len(x), -1).all(dim=-1)
                    if bool(bad.any()):
                        at = int(bad.nonzero()[0])
                        how = " in single precision" if dtype is torch.float32 else ""
                        raise ProblemError(
                            f"{name} of {self.name} gives {values[at].tolist()}{how} at {place(x[at])}, but must be finite "
                            "on the whole torus."
                        )

    def _special(self) -> Tensor:
        d = self.problem.dim
        corners = torch.tensor([0.0, 0.5, 0.25, 0.75], dtype=torch.float64).unsqueeze(-1).expand(4, d)
        faces = self._states(min(32, self.count), 4)
        rows = torch.arange(len(faces))
        faces[rows, rows % d] = 0.5 * (rows % 2).double()
        return torch.cat([corners, faces])

    def _periodic(self) -> None:
        x = self._odd(min(256, self.count), 5)
        whole = torch.randint(-2, 4, x.shape, generator=fixed_generator()).to(x)
        for name in DATA:
            here, there = self.ask(name, x), self.ask(name, x + whole)
            change = (here - there).abs().reshape(len(x), -1).amax(dim=-1)
            worst = int(change.nan_to_num(nan=math.inf).argmax())
            if float(change[worst]) <= SAME * float(here.abs().max()):
                continue
            raise ProblemError(
                f"{name} of {self.name} is not periodic: at {place(x[worst])} it changes by {change[worst]:.3g} when the "
                f"whole numbers {[int(k) for k in whole[worst][:8]]} are added to x, but it must have period 1 in each "
                "coordinate; x = x.remainder(1.0) first makes it so."
            )

    def _signs(self) -> None:
        """`f >= 0` and `mu0 >= 0`, at states and downhill from the least; and `f` within the bound the problem declares."""
        x = self._states(self.count, 6)
        for name in ("state_cost", "initial_density"):
            function = getattr(self.problem, name)
            values = self.ask(name, x)
            lowest = x[values.topk(min(16, len(x)), largest=False).indices]
            found = supremum(lambda at, f=function: -f(at), lowest, ascents=16, steps=40, differentiable=False)
            least, largest = -found.value, float(values.abs().max())
            if not least >= -ROUNDING * largest:
                raise ProblemError(
                    f"{name} of {self.name} is {least:.6g} at {place(found.x)}, but must be at least 0"
                    + ("; a constant added to it changes no optimal control." if name == "state_cost" else ".")
                )
            bound = self.problem.state_cost_bound
            if name == "state_cost" and bound is not None and not largest <= bound + ROUNDING * abs(largest):
                at = place(x[int(values.argmax())])
                raise ProblemError(
                    f"state_cost of {self.name} is {largest:.6g} at {at}, above its state_cost_bound = {float(bound):.6g}."
                )

    def _divergences(self) -> None:
        """What is called a divergence is one: held against differences, where those of two steps agree."""
        d, m = self.problem.dim, self.problem.control_dim
        if self.simulator or FEW * d * d * m > MOST_DIFFERENCES:
            return
        x = self._odd(FEW, 7)
        for name, source in (("drift_divergence", "drift"), ("control_divergence", "control_matrix")):
            claimed = self.ask(name, x)
            if claimed is None:
                continue
            claimed = claimed.reshape(len(x), -1)
            coarse, fine = (self._differences(source, x, step) for step in STEPS)
            size = float(torch.maximum(fine.abs(), claimed.abs()).max())
            settled = ((coarse - fine).abs() <= AGREE * size).all(dim=-1)
            off = (claimed - fine).abs().amax(dim=-1)
            wrong = settled & (off > WRONG * size)
            if 2 * int(settled.sum()) > len(x) and 2 * int(wrong.sum()) > int(settled.sum()):
                at = int((off * wrong).argmax())
                raise ProblemError(
                    f"{name} of {self.name} is {_listed(claimed[at])} at {place(x[at])}, but by differences of {source} it "
                    f"is {_listed(fine[at])}; give the divergence of {source}, or None where it is not known (as where "
                    f"{source} detaches x or leaves PyTorch, which loses its derivative)."
                )

    def _differences(self, source: str, x: Tensor, step: float) -> Tensor:
        """The divergence of each column, ``(N, columns)``, by central differences."""
        total = 0.0
        for i in range(self.problem.dim):
            moved = torch.zeros_like(x)
            moved[:, i] = step
            change = (self.ask(source, x + moved) - self.ask(source, x - moved)) / (2.0 * step)
            total = total + change.reshape(len(x), self.problem.dim, -1)[:, i]
        return total

    def _mass(self) -> None:
        if type(self.problem).initial_density is Problem.initial_density or (
            self.simulator and not self.problem._oracle.gives_mu0
        ):
            return
        found = sampled_mass(lambda x: self.ask("initial_density", x), self.problem.dim, self.count // 4)
        if found.wrong:
            raise ProblemError(
                f"initial_density of {self.name} {found.sentence}, but must integrate to 1 over the torus."
            )


_OTHER_ROWS = "is no function of the state alone, but changes with the other states or what was asked before"
_TWICE = "is no function of the state alone, but changes when it is asked again"


def _kind(x: Tensor) -> str:
    return f"{x.dtype} on {x.device.type}"


def _listed(values: Tensor) -> str:
    return f"{float(values[0]):.4g}" if len(values) == 1 else str([round(float(v), 6) for v in values[:8]])
