"""The numerical section's recipes: all on the circle with `rho = 2`, `M = 2`, `C_V = 2`, regularity 2, from zero."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocp_torch.studies.kernel import step_sizes

DISCOUNT, OCCUPATION_BOUND, VALUE_BOUND = 2.0, 2.0, 2.0


@dataclass(frozen=True)
class Recipe:
    """``looks`` are the step counts at which the averages are measured, ``drawn`` those at which they are drawn, and
    ``tabled`` those the table of numbers has. ``numbers`` are the method's own, in the order of the keys of
    `figures.LABELS`; ``known`` is what an independent re-implementation found, in per cent of `OPT`, as ranges over seeds.
    """

    method: str
    section: str
    numbers: tuple[str, ...]
    step: float
    schedule: str
    looks: tuple[int, ...]
    drawn: tuple[int, ...]
    tabled: tuple[int, ...]
    known: dict[tuple[int, str], tuple[float, float]]

    @property
    def steps(self) -> int:
        return self.looks[-1]

    @property
    def sizes(self) -> np.ndarray:
        """The step size of each step."""
        return step_sizes(self.step, self.steps, self.schedule)


SHORT = (200, 500, 1000, 2000, 5000, 10000, 15000, 20000)

RECIPES = {
    "dual": Recipe(
        "dual",
        "4.4",
        ("F_M", "value"),
        5e-4,
        "constant",
        SHORT,
        drawn=(500, 2000, 5000, 20000),
        tabled=(5000, 20000),
        known={
            (5000, "F_M"): (-5.6, -5.3),
            (20000, "F_M"): (-2.6, -2.5),
            (5000, "value"): (2.1, 2.1),
            (20000, "value"): (0.9, 0.9),
        },
    ),
    "primal": Recipe(
        "primal",
        "5.6",
        ("G", "density"),
        2e-3,
        "constant",
        SHORT,
        drawn=(500, 2000, 5000, 20000),
        tabled=(5000, 20000),
        known={(5000, "G"): (0.6, 0.9), (20000, "G"): (0.17, 0.20)},
    ),
    "pd": Recipe(
        "pd",
        "6.3",
        ("F_M", "J", "G", "value", "density"),
        1e-3,
        "decay",
        (2000, 5000, 10000, 20000, 50000, 100000, 150000, 200000),
        drawn=(2000, 20000, 100000, 200000),
        tabled=(200000,),
        known={
            (200000, "G"): (0.7, 0.9),
            (200000, "F_M"): (-13.0, -10.0),
            (200000, "J"): (84.0, 93.0),
            (200000, "density"): (0.0, 0.1),
            (200000, "value"): (0.8, 0.9),
        },
    ),
}
