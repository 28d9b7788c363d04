"""The numbers a method is judged by at one moment: bounds and performances of its fields, as certificates compute them."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn

from ocp_torch.certificate import BOUNDS, LOWER, UPPER, CertificateSettings, Run, StageSettings
from ocp_torch.certificate.estimate import replicated_samples
from ocp_torch.certificate.simulated.performance import simulate_performance
from ocp_torch.certificate.trained import Trained
from ocp_torch.certificate.trained_context import TrainedContext
from ocp_torch.certificate.upper.density import DensityBounds
from ocp_torch.control.policies import Policy
from ocp_torch.errors import InputError
from ocp_torch.fields.fields import Fields
from ocp_torch.maths.jets import Field
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# Integrals and simulations of one measurement: enough for 0.02 % on a curve, and beyond one dimension where there is a V.
POINTS, TRAJECTORIES, REPLICATES, TOLERANCE = 2048, 256, 2, 2e-4
ASCENTS = 8  # from the worst states, in search of a supremum: a quarter of what a certificate takes
# In one dimension a policy is simulated from a table of so many states, with straight lines between them: more
# trajectories cost nothing then, and a policy that is steep where they part needs them.
TABLE, ON_THE_CIRCLE = 2**14, 2048


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured(TrainedContext):
    """A context as cheap as can be: the same ``sets`` for every bound, which are not drawn anew where few states carry a
    mean, no simulation, and none of the checks."""

    sets: list[Samples]
    settings: CertificateSettings = CertificateSettings(
        ascents=ASCENTS, trajectories=0, occupation_states=0, mollify=False, stage=StageSettings(steps=0)
    )
    run: Run = Run("measured", "measured")

    odd = None

    @property
    def wide(self) -> list[Samples]:
        return self.sets

    few = wide

    @cached_property
    def densities(self) -> DensityBounds | None:
        return self.densities_on(self.few) if self.has_densities else None


class Judge:
    """Measures fields on states fixed by ``seed`` that no training sampler draws."""

    def __init__(self, problem: Problem, constants: Constants, seed: int = 0, effort: int = 1) -> None:
        self.problem, self.constants, self.seed, self.effort = problem, constants, seed, effort
        self.sets: list[Samples] = replicated_samples(
            problem, effort * POINTS, REPLICATES, seed, divergences=problem.gives_divergences
        )

    @torch.no_grad()
    def __call__(self, fields: Fields, occupation: str | None, perf: bool = True) -> dict[str, float]:
        """The values of the listed bounds on `OPT` that ``fields`` give, `F_M`, `shifted`, `J` and `G` among them, and with
        ``perf`` of the controllers' performances, `value` and `density`, all by their keys in `certificate.json`."""
        trained = Trained(fields, occupation, nn.Identity)  # nothing is fitted, so that no network is made
        context = Measured(problem=self.problem, constants=self.constants, trained=trained, sets=self.sets)
        listed = [bound for bound in BOUNDS if bound.side in (LOWER, UPPER) and bound.applies(context)]
        found = {bound.name: bound.evaluate(context) for bound in listed}
        numbers = {name: estimate.value for name, estimate in found.items() if estimate is not None}
        if perf:
            initial = None if context.sampled_value is None else context.sampled_value.initial
            for name, policy in context.policies.items():
                numbers[name] = self.performance(policy, context.value, initial)
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
