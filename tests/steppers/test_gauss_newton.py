"""Gauss-Newton steps: each against its formula with a Jacobian that is written down, and where they lead."""

import copy
import math

import pytest
import torch

from ocp_torch.fields import PeriodicMLP
from ocp_torch.maths.jets import reverse_jet
from ocp_torch.problems import Manufactured, Torus
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers import gauss_newton
from ocp_torch.steppers.gauss_newton import DAMPING, MOMENTUM, GaussNewton, refined


def slack_of(problem):
    return lambda samples, V: Generator.of(problem, samples).hjb_slack(V)


def draw_of(problem, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(count, also=None):
        x = torch.rand(count, problem.dim, generator=generator, dtype=torch.float64)
        return Samples.of(problem, x if also is None else torch.cat([also, x])[:count])

    return draw


def network(dim, **form):
    torch.manual_seed(0)
    made = PeriodicMLP(dim, modes=2, width=24, activation="tanh", **form)
    torch.nn.init.normal_(made.head.weight, std=0.3)
    return made


@pytest.mark.parametrize(("dim", "gated", "damping"), [(2, False, DAMPING[2]), (3, True, DAMPING[math.inf])])
def test_steps_are_those_of_the_formula(dim, gated, damping):
    problem = Manufactured(dim=dim, exponent=1.7)
    field, draw = network(dim, depth=2, gated=gated).double().requires_grad_(False), draw_of(problem)
    stepper, before = GaussNewton(field, slack_of(problem)), None
    for _ in range(3):
        samples, weights = draw(20), [p.clone().requires_grad_(True) for p in field.parameters()]
        apply = lambda x, at=weights: torch.func.functional_call(
            field, dict(zip(dict(field.named_parameters()), at, strict=True)), x
        )
        residual = slack_of(problem)(samples, reverse_jet(apply, samples.x))
        rows = [torch.autograd.grad(r, weights, retain_graph=True, materialize_grads=True) for r in residual]
        J = torch.stack([torch.cat([g.flatten() for g in row]) for row in rows])
        phi = torch.zeros(J.shape[1], dtype=J.dtype) if before is None else MOMENTUM * before
        gram = J @ J.T
        gram.diagonal().add_(damping * gram.diagonal().mean())
        wanted = phi + J.T @ torch.linalg.solve(gram, residual.detach() - J @ phi)
        assert stepper.step(samples) == pytest.approx(float(residual.detach().square().mean().sqrt()), rel=1e-10)
        before = torch.cat([(w - p).flatten() for w, p in zip(weights, field.parameters(), strict=True)]).detach()
        torch.testing.assert_close(before, wanted, rtol=1e-4, atol=1e-4 * float(wanted.abs().max()))


def fitted(problem):
    """A network that is about where training leaves it."""
    made, x = network(problem.dim, waves=4), torch.rand(512, problem.dim)
    wanted = problem.exact_value(x.double()).float()
    fit = torch.optim.LBFGS(made.parameters(), max_iter=60, line_search_fn="strong_wolfe")

    def closure():
        fit.zero_grad()
        off = (made(x) - wanted).square().mean()
        off.backward()
        return off

    fit.step(closure)
    return made


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.nightly)])
def test_a_smooth_solution_is_found_to_many_digits(seed):
    problem = Manufactured(dim=1, seed=seed)
    start, draw = fitted(problem), draw_of(problem)
    found = refined(start, slack_of(problem), draw, steps=40)
    assert found is not None
    assert next(found.network.parameters()).dtype == torch.float32
    assert found.residual < 1e-3
    y = torch.rand(4096, 1, dtype=torch.float64)
    error = lambda of: float((of.double()(y) - problem.exact_value(y)).abs().max())
    assert error(found.network) < 0.1 * error(start)


@pytest.mark.parametrize("case", ["a kink", "not at all", "told to stop"])
def test_where_steps_do_not_help_there_are_none(case):
    problem = Torus(dim=1) if case == "a kink" else Manufactured(dim=1)
    start, told = fitted(problem), []
    kept = [p.clone() for p in start.parameters()]
    stop = lambda: told.append(0) is not None or (case == "told to stop" and len(told) > 2)
    steps = {"a kink": 20, "not at all": 0, "told to stop": 20}[case]
    assert refined(start, slack_of(problem), draw_of(problem), steps, stop=stop) is None
    assert all(torch.equal(p, k) for p, k in zip(start.parameters(), kept, strict=True))
    assert len(told) == 3 or case != "told to stop"


def test_steps_end_where_the_residual_is_small_enough_and_where_it_stays_as_it_is(monkeypatch):
    problem, sizes = Manufactured(dim=1), []
    start, draw = fitted(problem), draw_of(problem)
    step = GaussNewton.step
    monkeypatch.setattr(GaussNewton, "step", lambda self, samples: sizes.append(step(self, samples)) or sizes[-1])
    assert refined(start, slack_of(problem), draw, steps=40, enough=1e-3) is not None
    assert sizes[-1] < 1e-3 <= min(sizes[:-1])
    monkeypatch.setattr(GaussNewton, "step", lambda self, samples: sizes.append(1.0) or 1.0)
    monkeypatch.setattr(gauss_newton, "LARGEST_GROWTH", torch.inf)
    sizes.clear()
    assert refined(start, lambda samples, V: torch.ones_like(V.value), draw, steps=40) is None
    assert len(sizes) == gauss_newton.CHECKED_STEP + 1
    monkeypatch.setattr(gauss_newton, "FALLEN_TO", torch.inf)
    sizes.clear()
    assert refined(start, lambda samples, V: torch.ones_like(V.value), draw, steps=40) is None
    assert len(sizes) == gauss_newton.CHECKED_STEP + 2


def test_states_that_are_all_alike_and_numbers_that_are_none_end_the_steps(monkeypatch):
    problem = Manufactured(dim=1)
    monkeypatch.setattr(gauss_newton, "DAMPING", {1: -1.0})  # no positive definite system
    assert (
        GaussNewton(network(1).double().requires_grad_(False), slack_of(problem)).step(draw_of(problem)(8)) == torch.inf
    )
    assert refined(network(1), slack_of(problem), draw_of(problem), steps=4) is None


@pytest.mark.parametrize("small", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_the_worst_states_are_among_those_of_the_last_steps_until_none_is_bad(small, monkeypatch):
    problem, stepped, asked = Manufactured(dim=1), [], []
    start, draw, bad = fitted(problem), draw_of(problem), torch.tensor([[0.25], [0.75]], dtype=torch.float64)
    step = GaussNewton.step
    monkeypatch.setattr(GaussNewton, "step", lambda self, samples: stepped.append(samples.x) or step(self, samples))

    def worst(network):
        assert next(network.parameters()).dtype == torch.float64
        asked.append(len(stepped))
        return bad, 0.0 if small else 1.0

    found = refined(start, slack_of(problem), draw, 20, enough=1e-9, worst=worst)
    assert found is not None
    rounds = 0 if small else gauss_newton.ROUNDS
    assert asked == [20 + k * gauss_newton.ROUND_STEPS for k in range(rounds + 1)]
    assert len(stepped) == 20 + rounds * gauss_newton.ROUND_STEPS
    assert all(torch.equal(x[:2], bad) for x in stepped[20:])
    assert not any(torch.equal(x[:2], bad) for x in stepped[:20])


def test_steps_on_worst_states_that_give_no_number_or_are_told_to_stop_leave_all_as_it_was(monkeypatch):
    problem = Manufactured(dim=1)
    start, draw = fitted(problem), draw_of(problem)
    worst = lambda network: (torch.full((2, 1), 0.25, dtype=torch.float64), 1.0)
    count = []
    stop = lambda: count.append(0) is not None or len(count) > 5
    assert refined(start, slack_of(problem), draw, 4, stop=stop, worst=worst) is None
    assert len(count) == 6
    step = GaussNewton.step
    odd = lambda self, samples: torch.inf if float(samples.x[0]) == 0.25 else step(self, samples)
    monkeypatch.setattr(GaussNewton, "step", odd)
    assert refined(start, slack_of(problem), draw, 4, worst=worst) is None


@pytest.mark.nightly
def test_the_best_of_all_rounds_on_worst_states_is_kept(monkeypatch):
    """Here the second, after which the mean is no worse than before and the largest slack much smaller."""
    problem, rounds = Manufactured(dim=1), []
    largest = iter([1.0, 0.1, 1e-3, 0.2])

    def worst(network):
        rounds.append(copy.deepcopy(network.state_dict()))
        return torch.full((2, 1), 0.25, dtype=torch.float64), next(largest)

    monkeypatch.setattr(gauss_newton, "ROUNDS", 3)
    found = refined(fitted(problem), slack_of(problem), draw_of(problem), 20, worst=worst)
    assert all(torch.equal(p, rounds[2][name].to(p)) for name, p in found.network.state_dict().items())
    assert len(rounds) == 4


@pytest.mark.nightly
def test_steps_on_worst_states_that_spoil_the_rest_are_taken_back(monkeypatch):
    problem = Manufactured(dim=1)
    start, step = fitted(problem), GaussNewton.step
    worst = lambda network: (torch.full((2, 1), 0.25, dtype=torch.float64), 1.0)

    def spoiling(self, samples):
        if float(samples.x[0]) == 0.25:
            self.network.head.weight.mul_(1.5)
            return 1.0
        return step(self, samples)

    monkeypatch.setattr(GaussNewton, "step", spoiling)
    plain, found = (refined(start, slack_of(problem), draw_of(problem), 20, worst=w) for w in (None, worst))
    assert found.residual == plain.residual
    for one, other in zip(found.network.parameters(), plain.network.parameters(), strict=True):
        assert torch.equal(one, other)
