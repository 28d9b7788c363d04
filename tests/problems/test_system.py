"""Problems in physical units: what the package makes of them on the torus, and the mistakes it tells."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch import Angle, Interval, Points, System
from ocp_torch.errors import InputError
from ocp_torch.maths.jets import diffusion_divergences, divergence
from ocp_torch.maths.mixtures import effective_part
from ocp_torch.problems import Pendulum, Problem
from ocp_torch.problems.checks.check import check_once
from ocp_torch.problems.physical.chart import Chart, smooth_step
from ocp_torch.problems.physical.start import start_density
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.starts import initial_points
from support import zoo
from support.systems import Cart, Conveyor, Swing

CLOSE = dict(rtol=1e-10, atol=1e-12)
DATA = ("f", "a", "B", "noise", "div_a", "div_B", "div_D", "div_div_D")
BOX = [Interval("place", -1.0, 3.0, "m"), Angle("turn"), Interval("speed", 2.0, 5.0, "m/s", margin=0.5)]


def inside(system, x):
    return x[~system.chart.outside(system.from_torus(x))]


@pytest.mark.parametrize("torque_noise", [0.0, 0.4])
def test_the_pendulum_in_physical_units_is_the_one_written_by_hand(torque_noise):
    """All data in the box, and the dynamics beyond it too."""
    system, by_hand = Swing(torque_noise=torque_noise), Pendulum(torque_noise=torque_noise)
    x = zoo.states(by_hand, 1000)
    ours, theirs = Samples.of(system, x), Samples.of(by_hand, x)
    box = ~system.chart.outside(system.from_torus(x))
    torch.testing.assert_close(ours.f[box], theirs.f[box], **CLOSE)
    for name in DATA[1:]:
        if getattr(theirs, name) is not None:
            torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), **CLOSE)


@pytest.mark.parametrize("make", [lambda: Swing(torque_noise=0.3), Cart], ids=["swing", "cart"])
def test_one_evaluation_gives_what_the_methods_and_autograd_through_them_do(make):
    system = make()
    x = zoo.states(system, 300)
    data = Samples.of(system, x)
    for name, value in (("a", system.drift(x)), ("B", system.control_matrix(x)), ("div_a", system.drift_divergence(x))):
        torch.testing.assert_close(getattr(data, name), value, **CLOSE)
    torch.testing.assert_close(data.div_B, Problem.control_divergence(system, x), **CLOSE)
    torch.testing.assert_close(data.div_a, divergence(system.drift, x), **CLOSE)
    for found, expected in zip((data.div_D, data.div_div_D), diffusion_divergences(system.noise, x), strict=True):
        torch.testing.assert_close(found, expected, **CLOSE)


def test_what_is_put_in_the_place_of_one_of_the_methods_is_what_samples_hold():
    """As a divergence that autograd cannot find, or none where it is not known."""

    class Numeric(Cart):
        def dynamics(self, s):
            return tuple(part.detach() for part in super().dynamics(s))

        def drift_divergence(self, x):
            return Cart().drift_divergence(x)

        def control_divergence(self, x):
            return None

    x = zoo.states(Cart(), 50)
    data, expected = Samples.of(Numeric(), x), Samples.of(Cart(), x)
    for name in ("a", "B", "div_a"):
        torch.testing.assert_close(getattr(data, name), getattr(expected, name), **CLOSE)
    assert data.div_B is None


@pytest.mark.nightly
def test_the_flow_on_the_torus_is_the_flow_in_physical_units():
    """The same controls take the same states as far, by Runge and Kutta's method in either, as long as the box holds them."""
    system = Cart(noisy=False)
    s = torch.tensor([[0.3, 0.2, 0.5], [-0.5, 3.0, 1.0]], dtype=torch.float64)
    x, u = system.to_torus(s), torch.tensor([[0.7, -0.4], [-0.2, 0.9]], dtype=torch.float64)

    def physical(s):
        a, B = system.dynamics(s)
        return a + torch.einsum("ndm,nm->nd", B, u)

    def run(rate, y, steps=400, time=0.4):
        h = time / steps
        for _ in range(steps):
            k1 = rate(y)
            k2 = rate(y + 0.5 * h * k1)
            k3 = rate(y + 0.5 * h * k2)
            y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(y + h * k3))
        return y

    end = run(physical, s)
    assert not system.chart.outside(end).any()
    there = run(lambda x: system.velocity(x, system.to_controls(u)), x)
    off = system.to_torus(end) - there
    assert float((off - off.round()).abs().max()) < 1e-9
    torch.testing.assert_close(system.from_controls(system.to_controls(u)), u)
    # And it costs the same.
    price = 0.5 * (0.5 * u[:, 0].square() + 2.0 * u[:, 1].square())
    torch.testing.assert_close(system.control_cost.cost(system.to_controls(u)), price, **CLOSE)
    torch.testing.assert_close(system.state_cost(x), system.cost(s), **CLOSE)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (lambda: Swing(torque_noise=0.3), lambda: Swing(turn=360.0, torque=5.0, torque_noise=0.3)),
        (Cart, lambda: Cart(metre=100.0, newton=0.01)),
        (Cart, lambda: Cart(metre=1e-3, newton=7.0)),
    ],
    ids=["degrees", "centimetres", "kilometres"],
)
def test_units_change_nothing_but_the_labels(one, other):
    """The problem on the torus is the same, whatever units it is written in."""
    one, other = one(), other()
    x = zoo.states(one, 200)
    ours, theirs = Samples.of(one, x), Samples.of(other, x)
    for name in (*DATA, "mu0"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), **CLOSE)


def test_states_come_back_from_physical_units_and_beyond_a_seam_there_are_none():
    system = Cart()
    x = zoo.states(system, 500)
    off = system.to_torus(system.from_torus(x)) - x
    assert float((off - off.round()).abs().max()) < 1e-14
    s = system.from_torus(x)
    whole = s + torch.tensor([0.0, 6.0 * math.pi, 0.0], dtype=torch.float64)
    off = system.to_torus(whole) - x
    assert float((off - off.round()).abs().max()) < 1e-14
    with pytest.raises(InputError, match=r"trolley is 3 m, beyond the seam of the model at -2.8 and 2.8"):
        system.to_torus(torch.tensor([[3.0, 0.0, 0.0]]))


def test_the_cut_off_is_1_in_the_box_0_at_the_seams_and_twice_differentiable():
    chart = Chart(tuple(BOX))
    s = torch.tensor([[0.0, 1.0, 3.0], [3.0, 1.0, 5.0], [3.5, 1.0, 3.0], [0.0, 1.0, 6.5], [3.25, 1.0, 5.75]]).double()
    assert chart.cut(s).tolist() == pytest.approx([1.0, 1.0, 0.0, 0.0, 0.25])
    # Across the end of the box and the seam: value, slope and curvature go on without a jump.
    along = lambda t: chart.cut(torch.stack([t, torch.zeros_like(t), torch.full_like(t, 3.0)], dim=-1))
    for place in (3.0, 3.5):
        h = 1e-4
        t = place + h * torch.arange(-3.0, 4.0, dtype=torch.float64)
        values = along(t)
        assert float(values.diff().abs().max()) < 1e-4
        assert float((values.diff(n=2) / h**2).abs().max()) < 0.2  # (60 / 0.5^2) 3 h / 0.5
    chi, slope = chart.cut_with_slope(s := s + 0.01)
    torch.testing.assert_close(chi, chart.cut(s))
    s.requires_grad_(True)
    torch.testing.assert_close(slope, torch.autograd.grad(chart.cut(s).sum(), s)[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rounding_takes_a_smooth_step_out_of_the_unit_interval_nowhere(dtype):
    near = torch.logspace(-12, -1, 20000, dtype=dtype)  # the ends, where terms cancel
    step = smooth_step(torch.cat([torch.linspace(-0.1, 1.1, 20001, dtype=dtype), near, 1.0 - near]))
    assert float(step.min()) == 0.0
    assert float(step.max()) == 1.0


def test_nothing_moves_at_a_seam_and_a_state_there_costs_the_largest_cost_in_the_box():
    system = Cart(failure_cost=None)
    x = zoo.states(system, 200)
    x[:100, 0], x[100:, 2] = 0.5, 0.5
    data = Samples.of(system, x)
    for name in ("a", "B", "noise", "div_a", "div_D"):
        assert float(getattr(data, name).abs().max()) < 1e-12
    assert data.f.tolist() == pytest.approx([4.0 + 2.0 + 0.1 * 49.0] * 200, rel=1e-3)
    assert Samples.of(Cart(failure_cost=3.0), x).f.tolist() == pytest.approx([3.0] * 200)


def ranges():
    """Ranges inside `BOX`, from a hundred-thousandth of it to all of it."""
    part = st.tuples(st.floats(0.0, 1.0), st.floats(1e-5, 1.0))
    return st.tuples(part, part, part)


@settings(max_examples=25)
@given(ranges(), st.sets(st.integers(0, 2), min_size=1))
def test_starts_in_ranges_have_mass_1_and_none_of_it_outside(parts, named):
    chart = Chart(tuple(BOX))
    ends, start = [(-1.0, 3.0), (-2.0, 4.0), (2.0, 5.0)], {}
    for i in named:
        (low, high), (place, width) = ends[i], parts[i]
        size = width * (high - low)
        first = low + place * (high - low - size)
        start[BOX[i].name] = (first, first + size)
    density = start_density(chart, start)
    # The mass of a product, coordinate by coordinate, by the trapezoidal rule from edge to edge.
    s = torch.tensor([[1.0, 1.0, 3.5]], dtype=torch.float64)
    for i in named:
        s[0, i] = sum(start[BOX[i].name]) / 2.0
    mass, top = 1.0, float(density(s))
    for i, c in enumerate(BOX):
        low, high = start.get(c.name, ends[i])
        if isinstance(c, Angle) and c.name not in start:
            mass *= c.length
            continue
        grid = s.repeat(4001, 1)
        grid[:, i] = torch.linspace(low, high, 4001, dtype=torch.float64)
        mass *= float(torch.trapezoid(density(grid), grid[:, i])) / top
    assert mass * top == pytest.approx(1.0, rel=1e-5)
    x = torch.rand(4000, 3, dtype=torch.float64)
    s = chart.from_torus(x)
    found = density(s)
    assert bool((found >= 0.0).all())
    assert float(found[chart.outside(s)].max()) == 0.0


@pytest.mark.nightly
@pytest.mark.parametrize(
    "start",
    [
        None,
        {"place": (-0.5, 0.5)},
        Points([[0.0, 3.1, 3.0], [1.0, 0.0, 4.0]], [0.5, 0.4, 0.6]),
        lambda s: (
            (-0.5 * ((s - s.new_tensor([1.0, 0.0, 3.5])) / s.new_tensor([0.3, 9.0, 0.2])).square())
            .exp()[:, ::2]
            .prod(-1)
        ),
    ],
    ids=["box", "range", "points", "function"],
)
def test_every_kind_of_start_has_mass_1(start):
    chart = Chart(tuple(BOX))
    density = start_density(chart, start)
    # The rectangle rule on a torus of 96^3 states.
    axis = (torch.arange(96, dtype=torch.float64) + 0.5) / 96
    x = torch.cartesian_prod(axis, axis, axis)
    s = chart.from_torus(x)
    values = density(s)
    assert float(values.mean() * chart.length.prod()) == pytest.approx(1.0, abs=2e-3)
    assert float(values.min()) >= 0.0 == float(values[chart.outside(s)].max())


SAYS = {
    "swapped": (lambda: Interval("v", 8, -8), r"v goes from 8 to -8, but low must be below high \(swapped\?\)"),
    "not finite": (lambda: Interval("v", -math.inf, 8), "the low end of v is -inf, but must be a finite number"),
    "margin": (lambda: Interval("v", -8, 8, margin=0.0), "the margin of v is 0, but must be at least 1e-06"),
    "unit": (lambda: Interval("v", -8, 8, "furlongs/s"), "of which 'furlongs' is no unit known here"),
    "unit of an angle": (lambda: Angle("v", unit="m"), "the period of v is missing; give it, in m"),
    "unit of a control": (
        lambda: Swing().__class__.__mro__[1]([Angle("a")], ["push [Newtons]"]),
        "'Newtons' is no unit",
    ),
    "name": (lambda: Angle(""), "the name of a coordinate is '', but must be a word or two"),
    "twice": (lambda: System([Angle("a"), Angle("a")], ["u"]), "two coordinates are called 'a'"),
    "none": (lambda: System([], ["u"]), r"coordinates are \[\], but must be a list of Angle"),
    "weight": (lambda: Swing(control_weight=-1.0), "problem.control_weight is -1.0, but must be 0 or more"),
    "no weight": (lambda: Swing(control_weight=0.0), "problem.control_weight is 0, but must be above 0"),
    "weights": (lambda: Cart(exponent=1.5), r"must be the same for all controls with problem.exponent = 1.5"),
    "limit": (lambda: Cart(control_limit=1.0), "the weights of the controls differ; give a list of 2 limits"),
    "start": (
        lambda: begun({"velocity": (-9, 9)}),
        r"start has velocity from -9 to 9 rad/s, which is not inside the box",
    ),
    "swapped start": (lambda: begun({"velocity": (3, -3)}), r"low must be below high \(swapped\?\)"),
    "start's name": (
        lambda: begun({"velocit": (3, -3)}),
        r"must name coordinates: angle, velocity \(did you mean 'velocity'",
    ),
    "points": (
        lambda: begun(Points([[0.0, 7.5]], [0.1, 1.0])),
        "start has velocity from 6.5 to 8.5 rad/s, which is not",
    ),
    "function": (lambda: begun(lambda s: 1.0 + 0.0 * s[:, 0]), r"% of start is outside the box"),
    "nowhere": (lambda: begun(lambda s: 0.0 * s[:, 0]), "is 0 at all states of the box"),
    "negative": (lambda: begun(lambda s: -1.0 + 0.0 * s[:, 0]), "is below 0, but must be at least 0"),
    "no number": (lambda: begun(lambda s: math.nan * s[:, 0]), "density given as start is not finite"),
    "other": (lambda: begun(3), "start is 3, but must be ranges"),
}


def begun(start):
    system = Swing(start=start)
    return system.initial_density(zoo.states(system, 3))


@pytest.mark.parametrize("name", SAYS)
def test_a_mistake_is_told_in_one_sentence(name):
    make, says = SAYS[name]
    with pytest.raises(InputError, match=says):
        make()


@pytest.mark.parametrize(
    "unit", ["", "rad/s", "m/s^2", "m/s²", "N m", "kg m^2", "1/s", "V", "deg", "%", "mA", "rad/s/s", "kt/yr", "EUR/day"]
)
def test_units_people_write_are_read(unit):
    assert Interval("v", 0, 1, unit).unit == unit


def test_a_unit_of_ones_own_stands_in_the_name():
    assert Interval("queue (cars)", 0, 80).label == "queue (cars)"


def test_weight_and_limit_may_be_of_controls_in_units_of_nominal_ones():
    """Two engines that cost 1/q at 5 N and at 0.2 N, and push the one five times that, together."""
    q, nominal = 1.5, [5.0, 0.2]
    arms = [Angle("a"), Angle("b")]
    named = System(arms, ["u [N]", "v [N]"], exponent=q, control_limit=1.2, control_weight=2.0, nominal_control=nominal)
    u = torch.tensor([[3.0, 0.1]], dtype=torch.float64)
    parts = u / torch.tensor(nominal).double()
    v = named.to_controls(u)
    torch.testing.assert_close(named.control_cost.cost(v), 2.0 * parts.norm(dim=-1) ** q / q)
    torch.testing.assert_close(named.from_controls(v), u)
    assert named.control_limit == pytest.approx(1.2 * 2.0 ** (1.0 / q))


def test_a_limit_and_a_weight_are_in_the_unit_of_the_control():
    system = Swing(control_limit=2.0)
    assert system.control_limit == pytest.approx(1.0)
    assert system.from_controls(torch.tensor([[1.0]])).item() == pytest.approx(2.0)
    # What makes the object again is what was given.
    again = type(system)(**system.parameters)
    assert again.control_limit == system.control_limit
    cubic = Swing(exponent=1.5, control_weight=8.0)
    assert float(cubic.control_cost.cost(cubic.to_controls(torch.tensor([[2.0]])))) == pytest.approx(
        8.0 * 2.0**1.5 / 1.5
    )


@pytest.mark.parametrize("make", [Swing, Cart, Conveyor, lambda: Swing(turn=360.0, start={"angle": (170, 190)})])
def test_a_sound_system_passes_the_checks_of_users_problems(make):
    check_once(make())


@pytest.mark.parametrize(
    "start",
    [
        None,
        {"trolley": (-1e-3, 1e-3), "pole": (3.1, 3.3), "spin": (0.0, 1e-4)},
        Points([[0.3, 1.0, 2.0], [-1.0, 3.1, 0.0]], [1e-2, 0.3, 1e-3]),
    ],
    ids=["box", "narrow", "points"],
)
def test_starts_however_narrow_are_drawn_where_they_are(start):
    """Trajectories carry all the mass of `mu0`, and their weights are about the same."""
    system = Cart(start=start)
    x, weight = initial_points(system, 4096, 0, 0)
    assert float(weight.mean()) == pytest.approx(1.0, abs=0.02)
    assert effective_part(weight) > 0.3
    assert not system.outside(x)[weight > 0.0].any()
