"""The control that is best for a whole step: against brute force, in the limit of no step, and within its limits."""

import math

import pytest
import torch

from ocp_torch.certificate.checks.observed import largest_jump
from ocp_torch.control.greedy import HeldPolicy, farthest, kept, solved
from ocp_torch.control.pace import RESPONSE_PART, Pace
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.fields import PeriodicMLP
from ocp_torch.fields.fields import typical_sizes
from ocp_torch.problems import Acrobot, Circle, Manufactured, Pendubot, Pendulum, Quadrotor, Satellite
from ocp_torch.problems.control_limit import BoxLimitedCost, LimitedCost
from ocp_torch.problems.starts import drawn_starts
from support.zoo import NATURAL, Swing, on, states

SWING = Pendulum(control_limit=1.0)


def bumpy(problem, seed: int):
    """A random smooth `V` in the units of ``problem``."""
    torch.manual_seed(seed)
    return PeriodicMLP(problem.dim, width=16, depth=2, modes=2, scale=20.0).double().requires_grad_(False)


def paid(problem, V, pace, x, u):
    """What a step costs, and `V` after it, over the part of the discount that passes."""
    after = V(x + pace.move(problem, x, u)) / (problem.discount * pace.step)
    return problem.control_cost.cost(u) + after


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("problem", [SWING, Pendulum(), Pendulum(exponent=1.5)], ids=["limit", "free", "q = 1.5"])
def test_it_beats_the_control_for_an_instant_and_comes_near_to_the_best_of_all(problem, seed):
    V, x, pace = bumpy(problem, seed), states(problem, 64), Pace(0.08, 2)
    u, pointwise = HeldPolicy(problem, V, pace)(x).detach(), ValuePolicy(problem, V)(x).detach()
    reach = min(problem.control_cost.reach, 3.0 * float(pointwise.abs().max()))
    best = torch.stack(
        [paid(problem, V, pace, x, torch.full_like(u, float(c))) for c in torch.linspace(-reach, reach, 401)]
    ).amin(dim=0)
    lost = [float((paid(problem, V, pace, x, c) - best).clamp_min(0.0).mean()) for c in (u, pointwise)]
    assert lost[0] < 0.5 * lost[1]


@pytest.mark.parametrize("seed", range(4))
def test_within_a_limit_neither_its_ends_nor_nothing_are_better(seed):
    V, x, pace = bumpy(SWING, seed), states(SWING, 256), Pace(0.08, 2)
    u = HeldPolicy(SWING, V, pace)(x).detach()
    for c in (-1.0, 0.0, 1.0):
        assert (paid(SWING, V, pace, x, u) <= paid(SWING, V, pace, x, torch.full_like(u, c)) + 1e-9).all()


class Pushed(Manufactured):
    """Nothing moves by itself."""

    def drift(self, x):
        return torch.zeros_like(x)


def test_of_a_quadratic_value_it_is_the_best_of_several_controls():
    """With the same `B` everywhere: `(rho I + h B'HB) u = -B'H y` at `y` from the least value."""
    problem, pace = Pushed(dim=3, control_dim=2), Pace(0.05, 1)
    H = torch.tensor([[9.0, 2.0, 0.0], [2.0, 1.0, 0.3], [0.0, 0.3, 4.0]]).double()
    x = 0.5 + 0.1 * (states(problem, 64) - 0.5)
    V = lambda z: 0.5 * ((z - 0.5) @ H * (z - 0.5)).sum(dim=-1)
    B = problem.control_matrix(x)
    A = problem.discount * torch.eye(2).double() + pace.step * B.mT @ H @ B
    expected = -torch.linalg.solve(A, (B.mT @ H @ (x - 0.5).unsqueeze(-1))).squeeze(-1)
    torch.testing.assert_close(HeldPolicy(problem, V, pace)(x), expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("problem", [Quadrotor(), Satellite()], ids=["quadrotor", "satellite"])
def test_of_several_controls_it_comes_nearer_to_the_best_than_one_part_of_all(problem, seed, monkeypatch):
    V, x, pace = bumpy(problem, seed), states(problem, 256), Pace.of(problem)
    policy = HeldPolicy(problem, V, pace)
    u = policy(x).detach()
    monkeypatch.setattr(HeldPolicy, "_apart", lambda self, x, u, part, *_: part)
    together = policy(x).detach()
    cost, before = paid(problem, V, pace, x, u), paid(problem, V, pace, x, together)
    assert (cost <= before + 1e-9 * before.abs()).all()
    assert (cost < before - 1e-6).double().mean() > 0.05  # mostly the limit is best
    sides = torch.tensor(problem.control_cost.sides, dtype=torch.float64)
    assert (u.abs() <= sides * (1.0 + 1e-12)).all()


def test_systems_are_solved_where_they_are_positive_definite():
    draw = torch.randn(200, 3, 3, generator=torch.Generator().manual_seed(0)).double()
    A, b = draw + draw.mT + 2.0 * torch.eye(3), draw[:, 0]
    steps, definite = solved([list(row.unbind(-1)) for row in A.unbind(-2)], list(b.unbind(-1)))
    assert torch.equal(definite, torch.linalg.eigvalsh(A)[:, 0] > 0.0)
    assert 10 < int(definite.sum()) < 190
    found = torch.stack(steps, dim=-1)[definite]
    torch.testing.assert_close(found, torch.linalg.solve(A[definite], b[definite]), rtol=1e-6, atol=1e-9)


def test_its_jumps_are_found_so_that_no_bound_rests_on_its_divergence():
    policy = HeldPolicy(SWING, bumpy(SWING, 0), Pace.of(SWING))
    assert largest_jump(policy, SWING.dim, problem=SWING).what == "controller"


def test_the_farthest_controls_in_a_direction():
    u = torch.tensor([[0.3, -0.4], [0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(farthest(LimitedCost(2.0, 2.0), u), torch.tensor([[1.2, -1.6], [0.0, 0.0]]).double())
    torch.testing.assert_close(
        farthest(BoxLimitedCost(2.0, [3.0, 0.5]), u), torch.tensor([[3.0, -0.5], [0.0, 0.0]]).double()
    )


@on(NATURAL)
def test_without_time_it_is_the_control_for_an_instant(problem):
    V, x = bumpy(problem, 0), states(problem, 32)
    expected = ValuePolicy(problem, V)(x).detach()
    errors = [float((HeldPolicy(problem, V, Pace(h, 1))(x).detach() - expected).abs().max()) for h in (1e-5, 1e-6)]
    size = float(expected.abs().max())
    assert errors[1] < 0.2 * errors[0] + 1e-9 * size
    assert errors[1] < 0.01 * size


def test_a_limit_holds():
    u = HeldPolicy(SWING, lambda x: 1e6 * (2.0 * math.pi * x).sin().sum(dim=-1), Pace.of(SWING))(
        states(SWING, 512)
    ).detach()
    assert float(u.abs().max()) <= 1.0 + 1e-9
    assert float(u.abs().max()) > 0.9


@pytest.mark.parametrize("q", [2.0, 1.5, 1.1])
def test_what_is_kept_of_a_control_minimises_a_price_and_a_slope_that_changes_evenly(q):
    generator = torch.Generator().manual_seed(0)
    draw = lambda: torch.rand(200, dtype=torch.float64, generator=generator)
    cost, start = draw(), 2.0 * draw() - 1.5
    end = start + 4.0 * draw()
    s = torch.linspace(0.0, 1.0, 20_001, dtype=torch.float64)[:, None]
    of = lambda s: s**q * cost + s * start + 0.5 * s**2 * (end - start)
    assert (of(kept(q, cost, start, end)) <= of(s).amin(dim=0) + 1e-7).all()


def test_the_pace_of_a_problem_is_measured_once(monkeypatch):
    problem = Circle()
    first = Pace.of(problem)
    monkeypatch.setattr(Pace, "_measured", None)
    assert Pace.of(problem) is first
    assert first.with_step(3.0 * first.step).substeps == 3 * first.substeps
    assert first.with_step(0.1 * first.step).substeps == first.substeps


class Faster(Swing):
    """`Swing` in a unit of time that is ``times`` as long."""

    def __init__(self, times: float) -> None:
        super().__init__(discount=2.0 * times)
        self.times = times

    def drift(self, x):
        return self.times * super().drift(x)

    def control_matrix(self, x):
        return self.times * super().control_matrix(x)


def test_the_pace_knows_no_unit_of_time():
    for times in (1.0, 10.0, 1e-3):
        found = Pace.of(Faster(times))
        assert found.step * times == pytest.approx(Pace.of(Swing()).step, rel=1e-6)
        assert found.substeps == Pace.of(Swing()).substeps


@pytest.mark.parametrize("problem", [Acrobot(), Pendubot()], ids=lambda p: type(p).__name__)
def test_a_control_is_held_for_a_fifth_of_the_time_in_which_a_system_answers(problem):
    """Where neither the discount nor the way of a step is shorter; eigenvalues by autograd."""
    x, size = drawn_starts(problem, 256, 1), typical_sizes(problem)[1]
    pushed = lambda u: lambda z: problem.velocity(z.unsqueeze(0), z.new_full((1, 1), u))[0]
    found = [torch.func.jacrev(pushed(size * (-1.0) ** i))(y) for i, y in enumerate(x)]
    fastest = torch.linalg.eigvals(torch.stack(found)).abs().amax(dim=-1)
    assert Pace.of(problem).step * float(fastest.quantile(0.9)) == pytest.approx(RESPONSE_PART, rel=0.25)
