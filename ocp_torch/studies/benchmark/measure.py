"""The numbers a method is judged by at one moment: bounds and performances of its fields, as certificates compute them."""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.certificate.certify import in_float64
from ocp_torch.certificate.estimate import replicated_samples
from ocp_torch.certificate.sides import lower_side, upper_side
from ocp_torch.certificate.simulated.performance import simulate_performance
from ocp_torch.control.policies import Policy, admissible_density, occupation_density, trained_policies
from ocp_torch.errors import InputError
from ocp_torch.fields.fields import Fields
from ocp_torch.maths.jets import Field
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# Integrals and simulations of one measurement: enough for 0.02 % on a curve, and beyond one dimension where there is a V.
POINTS, TRAJECTORIES, REPLICATES, TOLERANCE = 2048, 256, 2, 2e-4
# In one dimension a policy is simulated from a table of so many states, with straight lines between them: more
# trajectories cost nothing then, and a policy that is steep where they part needs them.
TABLE, ON_THE_CIRCLE = 2**14, 2048


class Judge:
    """Measures fields on states fixed by ``seed`` that no training sampler draws."""

    def __init__(self, problem: Problem, constants: Constants, seed: int = 0, effort: int = 1) -> None:
        self.problem, self.constants, self.seed, self.effort = problem, constants, seed, effort
        self.sets: list[Samples] = replicated_samples(
            problem, effort * POINTS, REPLICATES, seed, divergences=problem.gives_divergences
        )

    @torch.no_grad()
    def __call__(self, fields: Fields, occupation: str | None, perf: bool = True) -> dict[str, float]:
        """`F_M` and `shifted` (with `V`), `J` and, without drift, `G` (with `w`), and the performances that can be had.

        The keys are those of `certificate.json`: `F_M`, `shifted`, `J`, `G`, `value`, `density`.
        """
        problem, constants, fields = self.problem, self.constants, in_float64(fields)
        numbers: dict[str, float] = {}
        initial = None
        if fields.value is not None:
            lower = lower_side(problem, fields.value, self.sets, constants.M, ascents=8)
            initial = lower.initial
            numbers |= {"F_M": lower.F_M.value, "shifted": lower.shifted.value}
        if fields.control_density is not None and problem.gives_divergences:
            mu = occupation_density(occupation, problem, fields, constants)
            w = admissible_density(occupation, problem, fields, constants)
            J, G, *_ = upper_side(problem, w, mu, self.sets, constants.C_V)
            numbers |= {"J": J.value} | ({"G": G.value} if G is not None else {})
        if perf:
            for name, policy in trained_policies(occupation, problem, fields, constants).items():
                numbers[name] = self.performance(policy, fields.value, initial)
        return numbers

    def performance(self, policy: Policy, value: Field | None = None, initial: list[float] | None = None) -> float:
        """`Perf` of a policy, by simulation; beyond one dimension ``value`` is the control variate."""
        count = TRAJECTORIES
        if self.problem.dim == 1:
            policy, value, initial, count = tabulated(policy, TABLE), None, None, ON_THE_CIRCLE
        simulated = simulate_performance(
            self.problem, policy, self.effort * count, REPLICATES, self.seed, value, initial, tolerance=TOLERANCE
        )
        return simulated.perf.value


def tabulated(policy: Policy, count: int) -> Policy:
    """``policy`` on the circle at ``count`` equidistant states, periodic and linear between them: as cheap as it gets."""
    table = policy(torch.arange(count, dtype=torch.float64).unsqueeze(-1) / count)

    def look_up(x: Tensor) -> Tensor:
        place = count * x.remainder(1.0)
        index = place.floor().long()[:, 0]
        part = place - place.floor()
        return torch.lerp(table[index % count], table[(index + 1) % count], part)

    return look_up


def relative(number: float, optimum: float | None) -> float:
    """``number`` relative to `OPT`, in per cent. Raises `InputError` where `OPT` is not known."""
    if optimum is None:
        raise InputError("this problem's optimum is not known, so nothing can be said relative to it.")
    return 100.0 * (number / optimum - 1.0)
