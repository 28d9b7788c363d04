"""The paper's two iterations, single-pass: stochastic gradient (equations 7 and 12) and mirror-prox (18 and 19)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch

from ocp_torch.errors import InputError
from ocp_torch.fields.fields import CONTROL_DENSITY, VALUE, Fields
from ocp_torch.fields.sobolev import SobolevFeatures
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.studies.kernel.bernoulli import BernoulliKernel
from ocp_torch.studies.kernel.expansions import FeatureExpansion, KernelExpansion
from ocp_torch.studies.kernel.rules import RULES
from ocp_torch.studies.kernel.stream import Datum, Stream


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
        if (features is None) == (kernel is None):
            raise InputError("an iteration needs either features or a kernel.")
        seeds = tuple(seeds)
        self.method, self.n, self.samples = method, 0, 0
        self.rule = RULES[method](problem, constants)
        features = None if features is None else features.double()
        self.stream = Stream(problem, seeds, features, self.rule.needs_divergences)
        outputs = {VALUE: 1, CONTROL_DENSITY: problem.control_dim}
        self.expansions: dict[str, FeatureExpansion | KernelExpansion] = {}
        for name in self.rule.fields:
            if features is not None:
                self.expansions[name] = FeatureExpansion(features, len(seeds), outputs[name], radius)
            elif kernel is not None:
                form = problem.dim, len(seeds), outputs[name], capacity, radius
                self.expansions[name] = KernelExpansion(kernel, *form)

    @property
    def advance(self) -> Callable[[np.ndarray], None]:
        """The method's own iteration: mirror-prox for the game, stochastic gradient otherwise."""
        return (lambda steps: mirror_prox(self, steps)) if self.method == "pd" else (lambda steps: sgd(self, steps))

    @torch.no_grad()
    def fields(self, run: int, **seen_by) -> Fields:
        """The averaged iterates of one run as networks; the exact form wants the ``features`` to be seen by."""
        return Fields({name: e.field(run, name == VALUE, **seen_by) for name, e in self.expansions.items()})


def sgd(iteration: Iteration, steps: np.ndarray) -> None:
    """`V_n = V_{n-1} + gamma dH(V_{n-1}, x_n)`; the average is over the iterates before each step."""
    expansions = iteration.expansions.values()
    for gamma in steps:
        datum, improvement = _derivative(iteration)
        for expansion, direction in zip(expansions, improvement, strict=True):
            expansion.visit()
            expansion.move(gamma * direction, datum)
        iteration.n += 1


def mirror_prox(iteration: Iteration, steps: np.ndarray) -> None:
    """Look ahead with one sample, then step from where it began with the derivative there on another one.

    The average is over the look-ahead points.
    """
    expansions = iteration.expansions.values()
    for gamma in steps:
        marks = [e.mark() for e in expansions]
        datum, improvement = _derivative(iteration)
        for expansion, direction in zip(expansions, improvement, strict=True):
            expansion.move(gamma * direction, datum)
            expansion.visit()
        datum, improvement = _derivative(iteration)
        for expansion, direction, mark in zip(expansions, improvement, marks, strict=True):
            expansion.restore(mark)
            expansion.move(gamma * direction, datum)
        iteration.n += 1


def _derivative(iteration: Iteration) -> tuple[Datum, list[np.ndarray]]:
    """A fresh sample, and there the improving direction of each field."""
    datum = next(iteration.stream)
    iteration.samples += 1
    step = iteration.rule(datum, {name: e.jet(datum) for name, e in iteration.expansions.items()})
    return datum, [step[name] for name in iteration.expansions]
