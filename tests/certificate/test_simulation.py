"""Simulated closed loops: order of convergence, exact performances, control variates and occupation densities."""

import math
import threading
from functools import partial

import numpy as np
import pytest
import torch

from ocp_torch.certificate import CertificateSettings
from ocp_torch.certificate.simulated import candidates
from ocp_torch.certificate.simulated.backward import backward_flow, settled_occupation
from ocp_torch.certificate.simulated.candidates import Candidate, first_look, simulate_candidates
from ocp_torch.certificate.simulated.performance import SIMULATION_REPLICATE, Simulation, starting_points
from ocp_torch.compute import threads as cores
from ocp_torch.compute.threads import in_pieces
from ocp_torch.control.policies import ValuePolicy, zero_policy
from ocp_torch.errors import InputError, call
from ocp_torch.maths.runge_kutta import discounted_integral, refined
from ocp_torch.maths.sampling import evaluation_points
from ocp_torch.problems import Circle, Pendulum, Problem
from ocp_torch.training.evaluator import QUICK
from support import zoo

TURN = 2.0 * math.pi


def test_the_integrator_has_order_four():
    """`dx/dt = sin(2 pi x)/pi`, so `tan(pi x_t) = e^{2t} tan(pi x_0)`; the rate `W - W' dx/dt / rho` integrates to
    `W(x_0) - e^{-rho T} W(x_T)`, whatever `W`; here `W = sin(2 pi x) + cos(4 pi x)`."""
    rho, horizon = 1.5, 2.0
    W = lambda x: (TURN * x).sin() + (2.0 * TURN * x).cos()
    slope = lambda x: TURN * (TURN * x).cos() - 2.0 * TURN * (2.0 * TURN * x).sin()

    def dynamics(x):
        velocity = (TURN * x).sin() / math.pi
        return velocity, (W(x) - slope(x) * velocity / rho).squeeze(-1)

    x0 = torch.linspace(0.02, 0.45, 20, dtype=torch.float64).unsqueeze(-1)
    end = torch.atan(math.exp(2.0 * horizon) * torch.tan(math.pi * x0)) / math.pi
    exact = (W(x0) - math.exp(-rho * horizon) * W(end)).squeeze(-1)
    steps = np.array([16, 32, 64, 128])
    errors = []
    for n in steps:
        total, reached = discounted_integral(dynamics, x0, rho, horizon, int(n))
        errors.append([float((total - exact).abs().max()), float((reached - end).abs().max())])
    for kind in np.array(errors).T:
        order = -np.polyfit(np.log(steps), np.log(kind), 1)[0]
        assert order == pytest.approx(4.0, abs=0.25)


def test_end_states_are_wrapped_onto_the_torus():
    x0 = torch.tensor([[0.25], [0.75]], dtype=torch.float64)
    _, end = discounted_integral(lambda x: (torch.ones_like(x), x[:, 0]), x0, 1.0, 2.5, 10)
    torch.testing.assert_close(end, torch.tensor([[0.75], [0.25]], dtype=torch.float64))


def wrong_policy(problem):
    """The exact controller with a periodic mistake of size 0.4 in every component."""
    mistake = lambda x: 0.4 * (TURN * x[:, :1] + torch.arange(problem.control_dim).to(x)).sin()
    return lambda x: problem.exact_control(x) + mistake(x)


@pytest.mark.nightly
@zoo.on((*zoo.FEW_SMOOTH, "manufactured 1-d q=1.2", "manufactured 2-d q=1.5", "manufactured 3-d interaction=3"))
def test_the_exact_controller_performs_at_the_optimum(problem):
    perf = Simulation(problem, problem.exact_control, trajectories=64, replicates=8, seed=0).run().perf
    assert abs(perf.value - problem.exact_optimum) <= 4.0 * perf.se + perf.bias
    # An error bar that covers everything proves nothing; paths with noise scatter more.
    assert 4.0 * perf.se + perf.bias < (0.05 if problem.noisy else 0.02) * problem.exact_optimum


@zoo.on(zoo.KINKED)
def test_the_exact_controller_performs_at_the_optimum_with_kinks(problem):
    perf = Simulation(problem, problem.exact_control, trajectories=64, replicates=8, seed=0).run().perf
    assert abs(perf.value - problem.exact_optimum) <= 4.0 * perf.se + perf.bias
    assert 4.0 * perf.se + perf.bias < 0.05 * problem.exact_optimum


@zoo.on(zoo.SMOOTH)
def test_the_exact_value_as_control_variate_leaves_nothing_to_simulate(problem):
    """Its Bellman slack under the exact controller is zero, so `E[V* mu0]` alone is the answer."""
    simulated = Simulation(
        problem, problem.exact_control, 8, 2, seed=0, value=problem.exact_value, initial=[problem.exact_optimum] * 2
    ).run()
    assert simulated.perf.value == pytest.approx(problem.exact_optimum, rel=1e-10)
    assert simulated.perf.se + simulated.perf.bias < 1e-10
    starts = torch.cat([evaluation_points(8, problem.dim, SIMULATION_REPLICATE + r, seed=0) for r in range(2)])
    assert simulated.largest_value == pytest.approx(float(problem.exact_value(starts).max()), rel=1e-10)


@pytest.mark.nightly
@pytest.mark.usefixtures("any_variate")
@zoo.on(("manufactured 2-d mu0", "swing"))
def test_a_control_variate_does_not_change_the_answer(problem):
    """Any smooth value function will do, and any controller: from the same starts nothing but the bias is left."""
    network = zoo.rough_network(problem.dim, seed=2, size=0.03)
    policy = wrong_policy(problem) if problem.exact_optimum else lambda x: 0.5 * (TURN * x[:, :1]).sin()
    starts = [evaluation_points(8, problem.dim, SIMULATION_REPLICATE + r, seed=0) for r in range(2)]
    initial = [float((network(x) * problem.initial_density(x)).mean()) for x in starts]
    plain = Simulation(problem, policy, trajectories=8, replicates=2, seed=0).run().perf
    varied = Simulation(problem, policy, 8, 2, seed=0, value=network, initial=initial).run().perf
    assert abs(plain.value - varied.value) <= plain.bias + varied.bias
    assert plain.bias + varied.bias < 1e-3 * plain.value
    assert varied.se == pytest.approx(plain.se, rel=0.05)


@pytest.mark.nightly
@zoo.on(("manufactured 1-d q=2", "manufactured 2-d mu0", "manufactured 2-d B(x)", "manufactured 3-d m=2"))
def test_a_controller_loses_half_its_squared_distance_from_the_optimal_one(problem):
    """`Perf(u) - OPT = E_{mu^u} |u - u*|^2 / 2` for `q = 2` and smooth `V*`; the right side simulated by itself."""
    policy = wrong_policy(problem)
    perf = Simulation(problem, policy, trajectories=64, replicates=8, seed=0).run().perf
    half_square = lambda x: 0.5 * (policy(x) - problem.exact_control(x)).square().sum(dim=-1)
    x0 = torch.cat([evaluation_points(64, problem.dim, r, seed=7) for r in range(8)])
    dynamics = lambda x: (problem.velocity(x, policy(x)), half_square(x))
    losses, _ = discounted_integral(dynamics, x0, problem.discount, 12.0 / problem.discount, 200)
    per_set = (problem.initial_density(x0) * losses).reshape(8, -1).mean(dim=1)
    loss, error = float(per_set.mean()), float(per_set.std()) / math.sqrt(8.0)
    allowed = 4.0 * math.hypot(perf.se, error) + perf.bias
    assert abs(perf.value - problem.exact_optimum - loss) <= allowed
    assert allowed < 0.2 * loss


@zoo.on(zoo.QUIET)
def test_the_occupation_density_along_the_exact_flow_is_the_exact_one(problem):
    """Truncation leaves `e^{-12}`, below 1e-5, of it."""
    x = zoo.states(problem, 16, seed=4)
    flow, start = backward_flow(problem, problem.exact_control), torch.cat([x, torch.zeros_like(x[:, :1])], dim=-1)
    found, _ = discounted_integral(flow, start, problem.discount, 12.0 / problem.discount, 100)
    torch.testing.assert_close(found, problem.exact_occupation(x), rtol=1e-4, atol=1e-4)


@zoo.on(("noisy 1-d", "noisy 2-d sigma(x)"))
def test_with_noise_the_occupation_density_is_the_mean_over_paths(problem):
    """A lower estimate: less two standard errors of 64 paths, of about a tenth each."""
    x = zoo.states(problem, 24, seed=4)
    found, exact = settled_occupation(problem, problem.exact_control, x), problem.exact_occupation(x)
    assert bool((found <= 1.05 * exact).all())
    assert float((found / exact).mean()) > 0.7


@pytest.mark.usefixtures("any_variate")
@pytest.mark.nightly
@zoo.on(("noisy 1-d", "noisy 2-d degenerate"))
@pytest.mark.parametrize("horizon", ["truncated", "random"])
def test_any_control_variate_gives_the_performance_with_noise(problem, horizon):
    """`Perf = E[V mu0] - E int rho e^{-rho t} Q_u` for a rough `V`, by Ito's formula; of 6 intervals 2 may miss."""
    value, missed = zoo.rough_network(problem.dim, seed=1, size=0.05), 0
    x = zoo.states(problem, 2**16, seed=5)
    initial = [float((value(x) * problem.initial_density(x)).mean())] * 4
    for seed in range(6):
        found = (
            Simulation(
                problem,
                problem.exact_control,
                32,
                4,
                seed,
                value=value,
                initial=initial,
                horizon=horizon,
                tolerance=3e-3,
            )
            .run()
            .perf
        )
        low, high = found.interval(0.95)
        missed += not low <= problem.exact_optimum <= high
        assert high - low < (0.2 if horizon == "truncated" else 0.6) * problem.exact_optimum
    assert missed <= 2


@pytest.mark.nightly
@zoo.on(zoo.QUIET[:2])
def test_what_the_truncation_leaves_out_is_within_the_bias(problem):
    """From the very starts the exact controller costs what `V*` says; steps so fine that only the tail is missing."""
    found = Simulation(problem, problem.exact_control, 4, 2, seed=0, tolerance=1e-9).run().perf
    x0, mass = starting_points(problem, 4, 2, seed=0)
    missing = float((mass * problem.exact_value(x0)).mean()) - found.value
    assert 1e-6 * found.value < missing <= found.bias < 1e-4 * found.value


@zoo.on(("torus 2-d chain", "circle rho=4"))
def test_a_system_at_rest_costs_what_its_states_cost_but_for_the_tail(problem):
    rest = lambda x: torch.zeros(len(x), problem.control_dim, dtype=x.dtype)
    found = Simulation(problem, rest, 4, 2, seed=0, tolerance=1e-9).run().perf
    x0, mass = starting_points(problem, 4, 2, seed=0)
    missing = float((mass * problem.state_cost(x0)).mean()) - found.value
    assert 1e-6 * found.value < missing <= found.bias < 1e-4 * found.value


class Even(Problem):
    """Costs 1 everywhere, with noise."""

    def __init__(self) -> None:
        super().__init__(1, 1, noise=0.02)

    def state_cost(self, x):
        return torch.ones_like(x[:, 0])

    def drift(self, x):
        return torch.zeros_like(x)

    def control_matrix(self, x):
        return torch.ones_like(x).unsqueeze(-1)


def test_what_the_truncation_leaves_out_is_within_the_bias_with_noise(monkeypatch):
    for name in ("SMALLEST_TAIL", "LARGEST_TAIL"):  # much more than the steps' own error
        monkeypatch.setattr(f"ocp_torch.certificate.simulated.performance.{name}", 0.05)
    problem = Even()
    found = Simulation(problem, lambda x: torch.zeros_like(x), 8, 2, seed=0, tolerance=1e-7).run().perf
    assert 0.01 < 1.0 - found.value <= found.bias < 0.1
    given = Simulation(
        problem, lambda x: torch.zeros_like(x), 8, 2, seed=0, value=lambda x: 1.0 + 0.0 * x[:, 0], initial=[1.0] * 2
    ).run()
    assert given.perf.value == pytest.approx(1.0, abs=1e-12)


class Step(Problem):
    """A system at rest that costs 1 below ``edge`` and 0 above, and a wave of mean ``slope``: `edge + slope` in the mean."""

    def __init__(self, edge: float, slope: float):
        super().__init__(dim=1)
        self.edge, self.slope = edge, slope

    def state_cost(self, x):
        return (x[:, 0] < self.edge).to(x) + self.slope * (1.0 + torch.sin(2.0 * math.pi * x[:, 0]))


@pytest.mark.nightly
@zoo.on(("manufactured 2-d q=1.5", "noisy 1-d"))
def test_a_density_followed_back_on_several_cores_is_the_same(problem, monkeypatch):
    """To the bit whatever the number of cores, and to rounding that of all states at once."""
    monkeypatch.setattr("ocp_torch.certificate.simulated.backward.in_pieces", partial(in_pieces, size=32))
    x = zoo.states(problem, 48)

    def found(cores: int, together: bool):
        monkeypatch.setattr("ocp_torch.compute.threads.cores", lambda: cores)
        return settled_occupation(problem, problem.exact_control, x, 12, together)

    assert torch.equal(found(1, True), found(2, True))
    # Velocities that differ by 1e-16 are divided by `DIFFERENCE`.
    torch.testing.assert_close(found(2, True), found(2, False), rtol=1e-6, atol=1e-9)


@pytest.mark.nightly
@pytest.mark.parametrize(("slope", "starts"), [(0.0, 16), (0.2, 64)])
def test_intervals_cover_the_cost_of_a_jump_however_alike_the_replicates(slope, starts):
    """The start of the stratum with the edge nearly always falls on one side. At 5 % no more than 9 of 80 may miss."""
    problem = Step(math.floor(0.4 * starts) / starts + 0.13 / starts, slope)
    rest = lambda x: torch.zeros(len(x), 1, dtype=x.dtype)
    missed = 0
    for seed in range(80):
        low, high = Simulation(problem, rest, starts, 8, seed=seed).run().perf.interval(0.95)
        missed += not low <= problem.edge + slope <= high
    assert missed <= 9


@pytest.mark.parametrize("order", [0.5, 1, 2, 4])
def test_a_standard_error_spares_halvings_and_hides_no_error(order):
    """Results `1 + c n^-order`, of which the mean's error is known: it stays below the bias, and below the tolerance but
    for the order 1/2, where halvings run out."""
    sizes = torch.linspace(0.0, 4.0, 200, dtype=torch.float64)
    tolerance, taken = 0.1, []

    def integrate(rows, steps):
        taken.append(len(rows) * steps)
        return 1.0 + sizes[rows] * steps ** -float(order), torch.zeros(len(rows), 1, dtype=torch.float64)

    def run(standard_error):
        taken.clear()
        generator = torch.Generator().manual_seed(0)
        result, _, bias, _ = refined(
            integrate, torch.ones_like(sizes), 4, tolerance, generator, lambda results: standard_error
        )
        return float(result.mean()) - 1.0, bias, sum(taken)

    (error, bias, work), (noisy_error, noisy_bias, noisy_work) = run(0.0), run(10.0)
    assert error <= noisy_error
    assert noisy_error <= tolerance or order < 1
    assert error <= bias
    assert noisy_error <= noisy_bias
    assert noisy_work < work if order == 1 else noisy_work <= work


@pytest.mark.parametrize(("jump", "finest"), [(10.0, 16), (1000.0, 64)])
def test_one_trajectory_that_hardly_counts_is_not_halved_any_more(jump, finest):
    """The others change by nearly the tolerance; it changes by so many times that at each halving, less by a third each."""
    tolerance, taken, count = 0.1, [], 1000

    def integrate(rows, steps):
        taken.append(steps)
        size = torch.where(rows == 0, jump * (2.0 / 3.0) ** math.log2(steps), 0.8 / steps).double()
        return 3.0 * tolerance * size, torch.zeros(len(rows), 1, dtype=torch.float64)

    found = refined(integrate, torch.ones(count).double(), 4, tolerance, torch.Generator().manual_seed(1))
    result, _, bias, _ = found
    assert max(taken) == finest
    assert abs(float(result.mean())) <= bias


def test_what_rounds_is_audited_however_fine_the_steps_of_all_trajectories_are():
    rounding, sizes = 0.01, torch.linspace(1e6, 2e6, 200, dtype=torch.float64)

    def by(off):
        end = torch.zeros(len(sizes), 1, dtype=torch.float64)
        return lambda rows, steps: (1.0 + off + sizes[rows] * float(steps) ** -8, end[rows])

    how = torch.ones_like(sizes), 4, 1e-3, torch.Generator().manual_seed(0), lambda results: 0.0
    result, _, bias, _ = refined(by(rounding), *how, by(0.0))
    assert float(result.mean()) - 1.0 == pytest.approx(rounding, rel=0.2)
    assert rounding <= bias < 1.5 * rounding
    assert refined(by(rounding), *how)[2] < 0.2 * rounding
    asked = []

    def counted(rows, steps):
        asked.append(steps)
        return by(rounding)(rows, steps)

    plain, _, seen, _ = refined(counted, *how, by(0.0), audited=0)
    assert torch.equal(plain, result)
    assert 0.0 < seen < 0.2 * rounding
    assert asked == [2, 4, *(2**k for k in range(3, 3 + len(asked) - 2))]  # halvings alone


def test_only_looks_go_without_audits():
    assert CertificateSettings().audited
    assert not QUICK.audited
    with pytest.raises(InputError, match="audited"):
        call(CertificateSettings, "certificate", {"audited": False})


def test_looks_halve_their_steps_less_often(monkeypatch):
    problem, asked = Circle(), []

    def simulated(*given, **how):
        asked.append(how["doublings"])
        return Simulation(*given, **how)

    monkeypatch.setattr(candidates, "Simulation", simulated)
    own = {"own": Candidate(problem.exact_control, None, None)}
    for settings in (QUICK, CertificateSettings(trajectories=2, replicates=2)):
        simulate_candidates(problem, own, settings, 0, first_look(problem, own, settings, 0, best_only=True))
    looks, _, claims, _ = asked  # each beside doing nothing, which is rough
    assert 0 < looks < claims


@pytest.mark.nightly
def test_rounding_is_in_the_bias_of_a_look_too():
    problem, error = zoo.Manufactured(dim=1), 1e-6
    rounded = lambda x: problem.exact_control(x) * (1.0 + error)
    how = dict(tolerance=1e-3, rounded=(rounded, None))
    run = lambda **given: Simulation(problem, problem.exact_control, 64, 4, 0, **how, **given).run().perf
    look, exact = (
        run(audited=False),
        Simulation(problem, problem.exact_control, 64, 4, 0, tolerance=1e-3).run().perf,
    )
    assert look.bias > abs(look.value - exact.value) > 0.0
    assert look.bias <= run().bias + 1e-5


def rounded_perf(problem, rounded, policy):
    """Of ``policy``, with ``rounded`` in its place; and of ``policy`` alone."""
    run = lambda other: Simulation(problem, policy, 64, 4, 0, tolerance=1e-3, rounded=other).run().perf
    return run(None if rounded is None else (rounded, None)), run(None)


@pytest.mark.parametrize("noise", [0.0, pytest.param(0.02, marks=pytest.mark.nightly)])
def test_a_rounded_controller_takes_the_place_of_one_that_it_agrees_with(noise):
    problem, asked = zoo.Manufactured(dim=1, noise=noise), []

    def rounded(x):
        asked.append(len(x))
        return problem.exact_control(x.float().double())

    single, double = rounded_perf(problem, rounded, problem.exact_control)
    assert sum(asked) > 1000
    assert single.value == pytest.approx(double.value, rel=1e-6)
    assert single.bias < 1.2 * double.bias + 1e-6


@pytest.mark.nightly
@pytest.mark.parametrize("noise", [0.0, pytest.param(0.02, marks=pytest.mark.nightly)])
def test_where_it_differs_along_the_way_the_bias_says_by_how_much(noise):
    """It is another controller wherever no trajectory starts."""
    problem = zoo.Manufactured(dim=1, noise=noise)
    starts = starting_points(problem, 64, 4, seed=0)[0]

    def rounded(x):
        u = problem.exact_control(x)
        return u if x.shape == starts.shape and torch.equal(x, starts) else 0.5 * u

    found, exact = rounded_perf(problem, rounded, problem.exact_control)
    assert found.value != exact.value
    assert abs(found.value - exact.value) > 4.0 * exact.bias
    assert abs(found.value - exact.value) <= found.bias


@pytest.mark.parametrize("noise", [0.0, pytest.param(0.02, marks=pytest.mark.nightly)])
def test_a_rounded_controller_that_differs_at_the_starts_is_not_used(noise):
    problem = zoo.Manufactured(dim=1, noise=noise)
    found, exact = rounded_perf(problem, lambda x: problem.exact_control(x) + 1e-2, problem.exact_control)
    assert found == exact


def test_trajectories_are_the_same_on_one_core_and_on_several(monkeypatch):
    problem, found = zoo.Circle(), []
    for count in (1, 3):
        monkeypatch.setattr(cores, "cores", lambda count=count: count)
        threads = set()

        def rounded(x, threads=threads):
            threads.add(threading.current_thread())
            return problem.exact_control(x)

        found.append(Simulation(problem, problem.exact_control, 600, 4, 0, rounded=(rounded, None)).run())
        assert (len(threads) > 1) == (count > 1)
    assert found[0].perf == found[1].perf
    assert torch.equal(found[0].end_states, found[1].end_states)


@pytest.mark.parametrize("name", ["manufactured 2-d q=2", "circle rho=2"])
def test_the_density_is_the_same_with_differences_and_with_derivatives_of_a_controller_that_knows_its_own(name):
    problem = zoo.build(name)
    policy, x = ValuePolicy(problem, zoo.rough_network(problem.dim, 3, size=0.05)), zoo.states(problem, 40)
    known, differences = (settled_occupation(problem, p, x) for p in (policy, lambda at: policy(at)))
    torch.testing.assert_close(known, differences, rtol=1e-5, atol=1e-7)


def test_with_noise_the_estimated_density_is_a_number_where_paths_scatter_widely():
    """Beyond the cut-off of the pendulum's velocity paths grow by factors of all sizes: their mean shows no trend."""
    problem = Pendulum(noise=1e-3)
    policy = lambda x: 0.3 * torch.sin(2.0 * math.pi * x[:, :1])
    found = settled_occupation(problem, policy, zoo.states(problem, 48))
    assert bool(torch.isfinite(found).all())
    assert bool((found >= 0.0).all())


@pytest.mark.nightly
@zoo.on(("manufactured 2-d mu0", "noisy 1-d"))
@pytest.mark.parametrize(("size", "used"), [(0.003, True), (3.0, False)])
def test_a_value_whose_slack_is_as_large_as_the_cost_is_no_control_variate(problem, size, used):
    """Then what is found is what is found without any, to the last bit."""
    rough = zoo.rough_network(problem.dim, seed=2, size=size)
    value = lambda x: problem.exact_value(x) + rough(x)
    plain, varied = (
        Simulation(problem, problem.exact_control, 16, 2, 0, V, initial, tolerance=1e-2).run().perf
        for V, initial in ((None, None), (value, [problem.exact_optimum] * 2))
    )
    assert (varied != plain) == used


class Spinning(Problem):
    """`dx_1/dt = 0`, `dx_2/dt = 1 + 40 (x_1 > 0.95)`: a few trajectories go round much faster than the others."""

    def __init__(self):
        super().__init__(dim=2)
        self.asked = []

    def state_cost(self, x):
        return 1.0 + (TURN * x[:, 1]).cos() * (1.0 + x[:, 0])

    def drift(self, x):
        self.asked.append(len(x))
        return torch.stack([torch.zeros_like(x[:, 0]), 1.0 + 40.0 * (x[:, 0] > 0.95)], dim=-1)

    def control_matrix(self, x):
        return x.new_zeros(len(x), 2, 1)


@pytest.mark.nightly
def test_a_few_fast_trajectories_take_finer_steps_and_the_others_none(monkeypatch):
    """`rho int e^{-rho t} cos(2 pi (y + v t)) dt = (rho^2 cos - rho w sin)(2 pi y) / (rho^2 + w^2)`, `w = 2 pi v`."""
    problem = Spinning()
    found, work = [], []
    for mostly in (0.9, 1.0):
        monkeypatch.setattr("ocp_torch.certificate.simulated.steps.TYPICAL_PART", mostly)
        problem.asked.clear()
        found.append(Simulation(problem, zero_policy(problem), 64, 8, 0, tolerance=1e-3).run().perf)
        work.append(sum(problem.asked))
    x, mass = starting_points(problem, 64, 8, 0)
    rho, w = problem.discount, TURN * (1.0 + 40.0 * (x[:, 0] > 0.95))
    wave = (rho**2 * (TURN * x[:, 1]).cos() - rho * w * (TURN * x[:, 1]).sin()) / (rho**2 + w**2)
    exact = float((mass * (1.0 + (1.0 + x[:, 0]) * wave)).mean())
    for perf in found:
        assert abs(perf.value - exact) <= perf.bias
        assert perf.bias < 0.01 * exact
    assert work[0] < 0.5 * work[1]


def test_paths_that_are_very_long_are_fewer_and_agree_with_the_time_average(monkeypatch):
    """A constant speed of 1 and a discount of .02: what a path costs is nearly the mean of the cost along the circle."""
    problem = Circle(discount=0.02)
    taken = []
    count = lambda *how, **rest: taken.append(how[1:3]) or starting_points(*how, **rest)
    monkeypatch.setattr("ocp_torch.certificate.simulated.performance.starting_points", count)
    monkeypatch.setattr("ocp_torch.certificate.simulated.performance.MOST_STEPS", 2.0e4)
    found = Simulation(problem, lambda x: torch.ones_like(x), 256, 2, seed=0, tolerance=1e-3).run().perf
    assert taken[0] == (256, 2)
    assert taken[-1][0] < 16
    x = torch.linspace(0.0, 1.0, 4097, dtype=torch.float64)[:-1].unsqueeze(1)
    mean = float(problem.state_cost(x).mean()) + float(problem.control_cost.cost(torch.ones(1, 1, dtype=torch.float64)))
    assert found.value == pytest.approx(mean, rel=0.02)
