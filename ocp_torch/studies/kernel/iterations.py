"""The paper's two iterations, single-pass: stochastic gradient (equations 7 and 12) and mirror-prox (18 and 19)."""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch

from ocp_torch.errors import InputError, require_choice, require_integer, require_number
from ocp_torch.fields.fields import CONTROL_DENSITY, VALUE, Fields
from ocp_torch.fields.sobolev import SobolevFeatures
from ocp_torch.maths.sampling import UniformSampler
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.studies.kernel.expansions import BernoulliKernel, FeatureExpansion, KernelExpansion
from ocp_torch.studies.kernel.rules import RULES, Datum

# States whose data and features are computed together: vectorised, and small enough for the cache.
BLOCK = 256


class Iteration:
    """One method on one problem, for all ``seeds`` at once, with uniform averaging.

    ``features`` gives the truncated form; ``kernel`` and ``capacity`` (states kept) give the exact one. ``radius`` is that
    of the balls, `None` for no projection. ``n`` counts steps, ``samples`` states drawn by each run. Raises `InputError` for
    the primal with drift.
    """

    def __init__(
        self,
        problem: Problem,
        method: str,
        constants: Constants,
        seeds: Iterable[int],
        features: SobolevFeatures | None = None,
        kernel: BernoulliKernel | None = None,
        capacity: int = 0,
        radius: float | None = None,
    ) -> None:
        if method == "primal" and not problem.driftless:
            raise InputError("the primal's kernel iteration needs a problem without drift (Lemma 2); use dual or pd.")
        if features is not None and kernel is None:
            make: Callable = partial(FeatureExpansion, features.double())
        elif kernel is not None and features is None:
            make = partial(KernelExpansion, kernel, problem.dim, capacity)
        else:
            raise InputError("an iteration needs either features or a kernel.")
        seeds = tuple(seeds)
        self.problem, self.method, self.n, self.samples = problem, method, 0, 0
        self.rule = RULES[method](problem, constants)
        self._data = stream(problem, seeds, features, self.rule.needs_divergences)
        outputs = {VALUE: 1, CONTROL_DENSITY: problem.control_dim}
        self.expansions: dict[str, Any] = {n: make(len(seeds), outputs[n], radius) for n in self.rule.fields}

    def advance(self, steps: np.ndarray) -> None:
        """Make a step of each of these sizes: mirror-prox for the game, stochastic gradient otherwise.

        Stochastic gradient is `V_n = V_{n-1} + gamma dH(V_{n-1}, x_n)`, its average that of the iterates before each step.
        Mirror-prox looks ahead with one sample, then steps from where it began with the derivative there on another one; its
        average is that of the look-ahead points.
        """
        for gamma in steps:
            marks = None
            if self.method == "pd":
                marks = {name: e.mark() for name, e in self.expansions.items()}
                self._move(gamma)
            for expansion in self.expansions.values():
                expansion.visit()
            self._move(gamma, marks)
            self.n += 1

    def _move(self, gamma: float, marks: dict[str, Any] | None = None) -> None:
        """Move each field in its improving direction at a fresh sample, from where it is or from its mark."""
        datum = next(self._data)
        self.samples += 1
        directions = self.rule(datum, {name: e.jet(datum) for name, e in self.expansions.items()})
        for name, expansion in self.expansions.items():
            if marks is not None:
                expansion.restore(marks[name])
            expansion.move(gamma * directions[name], datum)

    def fields(self, run: int) -> Fields:
        """The averaged iterates of one run of the truncated form as networks."""
        return Fields({name: e.field(run, name == VALUE) for name, e in self.expansions.items()})


@torch.no_grad()
def stream(
    problem: Problem, seeds: tuple[int, ...], features: SobolevFeatures | None, divergences: bool
) -> Iterator[Datum]:
    """Independent uniform states without end, in float64, one stream per seed: those a trainer with batch 1 draws."""
    samplers = [UniformSampler(problem.dim, seed, torch.float64) for seed in seeds]
    while True:
        x = torch.stack([sampler.draw(BLOCK) for sampler in samplers], dim=1).flatten(0, 1)
        samples = Samples.of(problem, x, divergences=divergences)
        jets = None if features is None else features.jets(x)
        columns: tuple[Any, ...] = (samples.x, samples.f, samples.a, samples.B, samples.mu0, samples.div_B, jets)
        arrays = [None if c is None else c.reshape(BLOCK, len(seeds), *c.shape[1:]).numpy() for c in columns]
        for i in range(BLOCK):
            row: list[Any] = [None if column is None else column[i] for column in arrays]
            yield Datum(*row)


def step_sizes(
    initial: float, count: int, kind: str = "constant", decay: float = 0.75, every: int = 20000, exponent: float = 0.5
) -> np.ndarray:
    """``initial`` times 1 (``constant``), ``decay`` to the number of whole ``every`` moves made (``decay``; the paper's 25 %
    every 20,000), `n^-exponent` throughout a run of `n` moves (``horizon``, Theorems 2 to 4) or `k^-exponent` at move `k`
    (``power``); ``(count,)``."""
    require_choice("kind", kind, ("constant", "decay", "horizon", "power"))
    require_number("initial", initial, above=0.0)
    moves = np.arange(1, require_integer("count", count, 1) + 1)
    factors = {
        "constant": lambda: np.ones(count),
        "decay": lambda: decay ** ((moves - 1) // every),
        "horizon": lambda: np.full(count, float(count) ** -exponent),
        "power": lambda: moves**-exponent,
    }
    return initial * factors[kind]()
