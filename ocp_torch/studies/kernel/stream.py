"""Samples one state at a time, for several independent runs at once: the same states a trainer with batch 1 draws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ocp_torch.fields.sobolev import SobolevFeatures
from ocp_torch.maths.sampling import UniformSampler
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# States whose data and features are computed together: vectorised, and small enough for the cache.
BLOCK = 256


@dataclass(frozen=True)
class Datum:
    """A problem's data at one state for each of `R` runs, and there the jets of the features, if there are any."""

    x: np.ndarray  # (R, d)
    f: np.ndarray  # (R,)
    a: np.ndarray  # (R, d)
    B: np.ndarray  # (R, d, m)
    mu0: np.ndarray  # (R,)
    div_B: Any  # (R, m); None where no rule reads them
    jets: Any  # (R, 1 + d, F); None without features


class Stream:
    """`next(stream)` is a fresh `Datum`: independent uniform states, in float64, one stream per seed."""

    def __init__(
        self, problem: Problem, seeds: tuple[int, ...], features: SobolevFeatures | None, divergences: bool
    ) -> None:
        self.problem, self.features, self.divergences = problem, features, divergences
        self.samplers = [UniformSampler(problem.dim, seed, torch.float64) for seed in seeds]
        self._data = self._draw()

    def __next__(self) -> Datum:
        return next(self._data)

    @torch.no_grad()
    def _draw(self) -> Iterator[Datum]:
        runs = len(self.samplers)
        while True:
            x = torch.stack([sampler.draw(BLOCK) for sampler in self.samplers], dim=1).flatten(0, 1)
            samples = Samples.of(self.problem, x, divergences=self.divergences)
            jets = None if self.features is None else self.features.jets(x)
            columns: tuple[Any, ...] = (samples.x, samples.f, samples.a, samples.B, samples.mu0, samples.div_B, jets)
            arrays = [None if c is None else c.reshape(BLOCK, runs, *c.shape[1:]).numpy() for c in columns]
            for i in range(BLOCK):
                row: list[Any] = [None if column is None else column[i] for column in arrays]
                yield Datum(*row)
