"""The constants bound what they are said to bound, whatever the problem declares of itself."""

import math

import pytest
import torch

from ocp_torch.errors import InputError
from ocp_torch.problems import Problem
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import resolve_constants, state_cost_supremum
from ocp_torch.problems.needs import GIVEN
from support import zoo
from support.exact import ROUNDING, exact_slack

QUADRATIC = tuple(name for name in zoo.EXACT if "q=1" not in name)


@zoo.on(QUADRATIC)
def test_the_value_bound_holds_for_controllers_that_are_not_quite_optimal_too(problem):
    """With `q = 2` a mistake `e` of constant size costs `|e|^2 / 2` more from every state: `V^u = V* + |e|^2 / 2`."""
    dearer = 0.01 * problem.value_bound
    mistake = math.sqrt(2.0 * dearer / problem.control_dim)
    loop = ClosedLoop(problem, lambda x: problem.exact_control(x) + mistake)
    loop.exact_value = lambda x: problem.exact_value(x) + dearer
    x = zoo.states(problem, 200, off_kinks=True)
    torch.testing.assert_close(exact_slack(loop, x), torch.zeros(len(x), dtype=x.dtype), **ROUNDING)
    assert resolve_constants(problem).C_V >= problem.value_bound + dearer


@zoo.on(zoo.FEW)
def test_constants_that_are_configured_are_used_as_they_are(problem):
    given = dict(occupation_bound=3.0, value_bound=0.7, control_bound=0.9)
    found = resolve_constants(problem, **given)
    assert (found.M, found.C_V, found.C_u) == tuple(given.values())


class Declared(Problem):
    """`0 <= f <= 2` on the circle, and what the problem says of `sup f`."""

    scan_factor = 1

    def __init__(self, bound: float | None) -> None:
        super().__init__(dim=1)
        self.state_cost_bound = bound

    def state_cost(self, x):
        return 1.0 + (2.0 * math.pi * (x[:, 0] - 0.3)).cos()


@pytest.mark.parametrize("size", [None, 0.0, 0.1])
def test_noise_that_is_0_wherever_it_is_asked_is_told_but_kept(size):
    class Gusts(Declared):
        def noise(self, x):
            return None if size is None else size * (x.remainder(1.0) > 0.9).to(x).unsqueeze(-1)

    problem = Gusts(2.0)
    told = [note for note in resolve_constants(problem).warnings if "is 0 at all of 4,096 states" in note]
    assert len(told) == (size == 0.0)
    assert all(note.startswith("noise is 0 at all") and "must give None" in note for note in told)
    assert problem.noisy == (size is not None)


@pytest.mark.parametrize("declared", [None, 1e-3, 1.0, 1.99, 2.0, 2.5, 100.0])
def test_no_state_costs_more_than_the_supremum_whatever_is_declared(declared):
    problem = Declared(declared)
    found = state_cost_supremum(problem)
    assert found >= 2.0 - 1e-9
    assert resolve_constants(problem).C_V == found
    if declared is not None and declared >= 2.0:
        assert found == declared


@pytest.mark.parametrize("declared", [None, 1.0, 2.0, 2.5])
def test_what_is_said_of_the_value_bound_is_where_it_comes_from(declared):
    found = resolve_constants(Declared(declared))
    (said,) = (note for note in found.warnings if note.startswith("C_V is not known"))
    (control,) = (note for note in found.warnings if note.startswith("C_u is not known"))
    kept = declared is not None and declared >= 2.0
    assert found.C_V == pytest.approx(declared if kept else 1.05 * 2.0)
    assert ("the problem's state_cost_bound" in said) == ("a declared sup f" in control) == kept
    assert ("1.05 times the largest state cost met" in said) == ("a sampled sup f" in control) == (not kept)


def test_what_a_class_declares_in_its_body_is_taken():
    """And what it sets before `Problem.__init__` is called."""

    class Declared(Problem):
        occupation_bound, state_cost_bound = 3.0, 1.0

        def __init__(self):
            self.control_bound = 2.0
            super().__init__(1)

        def state_cost(self, x):
            return torch.ones_like(x[:, 0])

    problem = Declared()
    assert (problem.occupation_bound, problem.state_cost_bound, problem.control_bound) == (3.0, 1.0, 2.0)
    found = resolve_constants(problem)
    assert (found.M, found.C_u, found.basis("M")) == (3.0, 2.0, GIVEN)


@pytest.mark.parametrize(
    ("cost", "declared", "says"),
    [
        (0.0, {}, r"^the state cost of .*Even is 0 at all states that were tried, .*; it must be above 0 somewhere\.$"),
        (1e30, {}, r"^the state cost of .*Even is 1.05e\+30, but must be a number of at most 1e\+30 in size\.$"),
        (1.0, {"occupation_bound": -3.0}, r"^occupation_bound of .*Even is -3, but must be above 0\.$"),
        (1.0, {"value_bound": 0.0}, r"^value_bound of .*Even is 0, but must be above 0\.$"),
    ],
)
def test_what_cannot_be_a_constant_is_named_as_the_user_wrote_it(cost, declared, says):
    Even = type("Even", (Problem,), {"state_cost": lambda self, x: torch.full_like(x[:, 0], cost), **declared})
    with pytest.raises(InputError, match=says):
        resolve_constants(Even(1))
