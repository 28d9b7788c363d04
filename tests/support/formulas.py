"""Fields in closed form where networks are expected, and rough networks in all roles."""

from __future__ import annotations

import torch

from ocp_torch.fields import Fields
from ocp_torch.problems import Problem
from support import zoo

# Eight scramblings: beyond six standard errors no sampling noise is left to blame.
ERRORS = 6.0


class Field(torch.nn.Module):
    """A field from a formula, with a weight so that it has a precision."""

    def __init__(self, formula):
        super().__init__()
        self.formula, self.weight = formula, torch.nn.Parameter(torch.zeros(()))

    def forward(self, x):
        return self.formula(x) + self.weight


class Exactly(torch.nn.Module):
    """A field in closed form where a network is expected, in the precision of what comes in."""

    def __init__(self, function):
        super().__init__()
        self.function, self.none = function, torch.nn.Parameter(torch.zeros(()))

    def forward(self, x):
        return self.function(x) + 0.0 * self.none

    def __deepcopy__(self, memo):
        return Exactly(self.function)


def random_fields(problem: Problem, seed: int, size: float = 1.0) -> Fields:
    forms = {"value": None, "control_density": problem.control_dim, "log_occupation": None}
    return Fields({k: zoo.rough_network(problem.dim, seed + i, m, size) for i, (k, m) in enumerate(forms.items())})
