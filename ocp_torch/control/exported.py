"""The functions of a controller that are exported: `u`, `V` and `grad V` at a batch of states, on the torus or in units."""

import copy
from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.control.described import problem_name
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.policies import ValuePolicy, trained_policies
from ocp_torch.errors import InputError, require_choice
from ocp_torch.export import CONTROL
from ocp_torch.fields import Fields
from ocp_torch.maths import jets
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.physical.system import System

VALUE, GRADIENT = "value", "gradient"
TORUS, PHYSICAL = "torus", "physical"
EXAMPLE_STATES = 16  # a function is traced on the first, and compared at the others with what was traced

Outputs = dict[str, Tensor]


def coordinates_of(problem: Problem, asked: str | None) -> str:
    """``asked``, or by default physical units where ``problem`` has them. Raises `InputError` where it has none."""
    units = isinstance(problem, System)
    if asked is None:
        return PHYSICAL if units else TORUS
    chosen = require_choice("coordinates", asked, (TORUS, PHYSICAL))
    if chosen == PHYSICAL and not units:
        raise InputError(
            f"coordinates is physical, but the problem {problem_name(problem)} has no units; choose torus."
        )
    return chosen


def example_states(problem: Problem, coordinates: str) -> Tensor:
    """Random states ``(K, d)`` in ``coordinates``, the same in every call."""
    x = torch.rand(EXAMPLE_STATES, problem.dim, dtype=torch.float64, generator=fixed_generator())
    return problem.from_torus(x) if coordinates == PHYSICAL and isinstance(problem, System) else x


def about(problem: Problem, coordinates: str) -> str:
    """One line on the contents of an exported file."""
    places = f"states on the torus, {problem.dim} coordinates in turns"
    if coordinates == PHYSICAL and problem.measures is not None:
        places = problem.measures.text
    return (
        f"A controller of the problem {problem_name(problem)}, its value function and the gradient of that; {places}."
    )


def exported_function(
    problem: Problem, fields: Fields, kind: str, occupation: str | None, constants: Constants, coordinates: str
) -> Callable[[Tensor], Outputs]:
    """States ``(N, d)`` to ``control`` ``(N, m)`` and, where the controller holds a `V`, its ``value`` ``(N,)`` and
    ``gradient`` ``(N, d)``, in float64. In physical units a state beyond the box is taken for the nearest one in it.
    All is NaN where a coordinate is, or an angle is infinite."""
    fields = copy.deepcopy(fields).to("cpu").double()
    policy = trained_policies(occupation, problem, fields, constants, every=True)[kind]
    field = policy.value if isinstance(policy, ValuePolicy | HeldPolicy) else fields.value

    def found_at(x: Tensor) -> Outputs:
        if field is None:
            return {CONTROL: policy(x)}
        V = jets.jet(field, x)
        own = isinstance(policy, ValuePolicy)
        u = policy.control(problem.control_matrix(x), V) if own else policy(x)  # type: ignore[attr-defined]
        return {CONTROL: u, VALUE: V.value, GRADIENT: V.gradient}

    def on_torus(x: Tensor) -> Outputs:
        # 0, but NaN where a coordinate is: a branch of a controller may lose that, and answer as if nothing were broken.
        broken = x.clamp(0.0, 0.0).floor().sum(dim=-1, keepdim=True)
        return {name: y + (broken if y.ndim > 1 else broken[:, 0]) for name, y in found_at(x).items()}

    def in_units(s: Tensor) -> Outputs:
        assert isinstance(problem, System)  # `coordinates_of` has seen to it
        chart = problem.chart
        found = on_torus(chart.turns(chart.nearest(s)).remainder(1.0))
        found[CONTROL] = problem.from_controls(found[CONTROL])
        if GRADIENT in found:
            found[GRADIENT] = found[GRADIENT] / chart.lengths(s)
        return found

    function = in_units if coordinates == PHYSICAL else lambda x: on_torus(x.remainder(1.0))

    @torch.no_grad()
    def detached(states: Tensor) -> Outputs:
        return function(states)

    return detached
