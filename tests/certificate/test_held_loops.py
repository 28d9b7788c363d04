"""Controllers that hold their control, simulated as such: closed forms, brute force, and what is thinned out."""

import math

import pytest
import torch

from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated import candidates, held
from ocp_torch.certificate.simulated.candidates import Candidate
from ocp_torch.certificate.simulated.outside import time_outside
from ocp_torch.certificate.simulated.performance import Simulation, starting_points
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.pace import Pace
from ocp_torch.maths.runge_kutta import MAX_DOUBLINGS
from ocp_torch.problems import Circle, Pendulum, Problem
from ocp_torch.runs.metrics.measures import simulate
from support.systems import Conveyor


class Held(HeldPolicy):
    """Any function of the state, asked every ``step`` units of time."""

    def __init__(self, problem, step: float, control, substeps: int = 1) -> None:
        super().__init__(problem, None, Pace(step, substeps))
        self.control = control

    def __call__(self, x):
        return self.control(x)


def optimal_held(problem: Circle, step: float) -> Held:
    return Held(problem, step, lambda x: problem.exact_control(x.remainder(1.0)))


def held_cost(problem: Circle, step: float) -> float:
    """`y' = u`, `u = -k y_j` from `t_j` on: `y_{j+1} = (1 - k h) y_j`, and each hold costs a multiple of `y_j^2`."""
    x = torch.tensor([[0.75]], dtype=torch.float64)
    k, rho = -float(problem.exact_control(x)) / 0.25, problem.discount
    t = torch.linspace(0.0, step, 20_001, dtype=torch.float64)
    hold = torch.trapezoid(rho * torch.exp(-rho * t) * ((1.0 - k * t).square() + 0.5 * k * k), t)
    return float(hold) / (1.0 - math.exp(-rho * step) * (1.0 - k * step) ** 2) / 12.0


@pytest.mark.nightly
@pytest.mark.parametrize("step", [0.02, 0.2, 0.9])
@pytest.mark.parametrize("variate", [False, True], ids=["plain", "with V"])
def test_on_the_circle_it_costs_what_sampled_feedback_costs(step, variate):
    problem = Circle()
    with_V = (problem.exact_value, [problem.exact_optimum] * 8) if variate else (None, None)
    perf = Simulation(problem, optimal_held(problem, step), 64, 8, 0, *with_V).run().perf
    exact = held_cost(problem, step)
    assert perf.interval(0.999)[0] < exact < perf.interval(0.999)[1]
    assert perf.half_width(0.95) < (2e-3 if variate else 0.03) * exact
    assert exact > problem.exact_optimum


@pytest.mark.nightly
def test_what_is_thinned_out_is_right_in_the_mean(monkeypatch):
    """On the pendulum, against the same starts followed to the end, and in the mean over seeds."""
    problem = Pendulum(control_limit=1.0)
    policy = Held(problem, 0.1, lambda x: (2.0 * math.pi * x[:, :1]).sin().sign(), 2)
    run = lambda seed: Simulation(problem, policy, 64, 4, seed, tolerance=1e-3).run().perf
    thinned = [run(seed) for seed in range(6)]
    monkeypatch.setattr(held, "FEWEST_FOLLOWED", 64)
    whole = run(0)
    assert abs(thinned[0].value - whole.value) < 4.0 * math.hypot(thinned[0].se, whole.se)
    mean = sum(perf.value for perf in thinned) / 6
    error = math.hypot(whole.se, *(perf.se / 6 for perf in thinned))
    assert abs(mean - whole.value) < 4.0 * error + whole.bias
    assert error < 0.05 * whole.value


def test_a_good_value_takes_most_of_the_error_and_a_bad_one_none_of_the_truth():
    problem = Circle()
    policy, exact = optimal_held(problem, 0.1), held_cost(problem, 0.1)
    bad = lambda x: (6.0 * math.pi * x).cos().sum(dim=-1)
    plain, good = (
        Simulation(problem, policy, 32, 8, 1, V, initial).run().perf
        for V, initial in ((None, None), (problem.exact_value, [problem.exact_optimum] * 8))
    )
    wild = Simulation(problem, policy, 32, 8, 1, bad, [0.0] * 8).run().perf
    assert good.se < 0.2 * plain.se
    for perf in (plain, good, wild):
        assert perf.interval(0.999)[0] < exact < perf.interval(0.999)[1]


class Stream(Problem):
    """On the circle, away from 0 towards 1/2, fast."""

    def drift(self, x):
        return 2.0 * (2.0 * math.pi * x).sin()

    def state_cost(self, x):
        return 1.0 + (2.0 * math.pi * x[:, 0]).cos()


@pytest.mark.nightly
def test_steps_within_a_hold_are_halved_where_they_are_too_long():
    problem = Stream(dim=1, discount=2.0)
    policies = [Held(problem, 0.2, lambda x: (2.0 * math.pi * x).cos(), substeps) for substeps in (1, 16)]
    long, short = (Simulation(problem, policy, 32, 4, 0, tolerance=1e-5).run().perf for policy in policies)
    assert abs(long.value - short.value) < long.bias + short.bias
    assert long.bias < 0.15 * long.se < 2e-3 * long.value


@pytest.mark.nightly
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_shorter_it_is_held_the_nearer_it_is_to_feedback(noise):
    problem = Circle(noise=noise)
    control = lambda x: -0.5 * (2.0 * math.pi * x).sin()
    feedback = Simulation(problem, control, 128, 8, 0, tolerance=1e-3).run().perf
    policies = [Held(problem, step, control) for step in (0.4, 0.02)]
    far, near = (Simulation(problem, policy, 128, 8, 0, tolerance=1e-3).run().perf for policy in policies)
    assert abs(near.value - feedback.value) < 3.0 * math.hypot(near.se, feedback.se) + 0.02 * feedback.value
    assert noise or abs(near.value - feedback.value) < 0.2 * abs(far.value - feedback.value)


def test_with_noise_it_is_what_a_plain_simulation_gives():
    problem, step, finer = Circle(noise=0.05), 0.25, 50
    policy = Held(problem, step, lambda x: -0.5 * (2.0 * math.pi * x).sin())
    perf = Simulation(problem, policy, 256, 8, 0, tolerance=1e-3).run().perf
    x, _ = starting_points(problem, 4096, 2, seed=5)
    sigma, h, cost = problem.noise(x[:1])[0, 0, 0], step / finer, 0.0
    generator = torch.Generator().manual_seed(0)
    u = policy(x)
    for k in range(round(6.0 / h)):
        u = policy(x) if k % finer == 0 else u
        rate = problem.state_cost(x) + problem.control_cost.cost(u)
        cost = cost + 2.0 * h * math.exp(-2.0 * (k + 0.5) * h) * rate
        x = x + h * u + h**0.5 * sigma * torch.randn(x.shape, generator=generator, dtype=x.dtype)
    error = math.hypot(perf.se, float(cost.std()) / len(x) ** 0.5)
    assert abs(float(cost.mean()) - perf.value) < 4.0 * error + perf.bias + 1e-4
    assert error < 0.02 * perf.value


@pytest.mark.nightly
def test_beside_a_held_control_a_worse_controller_stays_rough_and_what_is_remembered_is_not_made_again(monkeypatch):
    problem = Circle()
    efforts = []

    def simulated(problem, policy, **how):
        assert how["audited"]
        efforts.append((policy, how["trajectories"], how["doublings"]))
        return Simulation(problem, policy, **how)

    monkeypatch.setattr(candidates, "Simulation", simulated)
    held_one, away = optimal_held(problem, 0.05), lambda x: -problem.exact_control(x)
    settings = CertificateSettings(trajectories=32, replicates=4, tolerance=1e-3)
    asked = lambda policy: [(count, doublings) for one, count, doublings in efforts if one is policy]
    whole = (32, MAX_DOUBLINGS)
    at_length = lambda how, *kept: candidates.simulate_candidates(*how, candidates.first_look(*how, True, *kept))[0]
    for other, effort in ((away, [(8, 1)]), (problem.exact_control, [(8, 1), whole])):
        efforts.clear()
        both = {"value": Candidate(other, None, None), "trajectories": Candidate(held_one, None, None)}
        found = at_length((problem, both, settings, 0))
        # The exact controller is better than the held one by less than a rough simulation can tell: either is fine.
        assert asked(other) in (effort, effort[:1])
        assert asked(held_one) == [(candidates.MORE_HELD * 32, MAX_DOUBLINGS)]
    assert found["trajectories"].perf.interval(0.999)[0] < held_cost(problem, 0.05)
    efforts.clear()
    kept = {"trajectories": found["trajectories"]}
    again = at_length((problem, both, settings, 0), kept)
    assert asked(held_one) == []
    assert {name: one.perf for name, one in again.items()} == {name: one.perf for name, one in found.items()}


def test_paths_for_pictures_hold_it_too():
    """From `y = 1/4` for one time unit, with a control that is asked at 0, 1/4, ...: `y` ends at `(1 - k / 4)^4 / 4`."""
    problem = Circle()
    policy, x0 = optimal_held(problem, 0.25), torch.tensor([[0.75]], dtype=torch.float64)
    k = -float(problem.exact_control(x0)) / 0.25
    for steps in (2, 4):
        path = simulate(problem, policy, x0, 1.0, steps)
        assert path.states.shape == (steps + 1, 1, 1)
        assert float(path.states[-1]) == pytest.approx(0.5 + 0.25 * (1.0 - 0.25 * k) ** 4, abs=1e-12)
        assert path.times.tolist() == pytest.approx([i / steps for i in range(steps + 1)])


@pytest.mark.nightly
def test_time_outside_the_box_is_that_of_the_held_control():
    """It always moves right: a conveyor (see test_outside) that is moved by its control."""
    system = Conveyor(speed=0.0, start={"place": (0.0, 1.0)})
    control = lambda x: system.to_controls(torch.ones_like(x))
    settings = CertificateSettings(trajectories=64, replicates=4)
    found = time_outside(system, Held(system, 0.05, control, 2), settings, 0)
    s = torch.linspace(0.0, 1.0, 10_001, dtype=torch.float64)
    mass = system._density(s.unsqueeze(-1))
    exact = float(torch.trapezoid(mass * torch.exp(-system.discount * (3.0 - s)), s))
    assert found.value == pytest.approx(exact, abs=found.half_width(0.999) + 1e-3)
