"""What could make a certificate lie: each gets true bounds, or a clear refusal."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from ocp_torch.certificate.checks.wellposed import check_problem
from ocp_torch.certificate.statistics.estimate import replicated_samples
from ocp_torch.control.policies import NETWORK
from ocp_torch.errors import InputError
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.problems import Circle, Manufactured
from ocp_torch.problems.constants import resolve_constants
from support import honesty, zoo
from support.honesty import BARE

CHEAP = replace(BARE, points=256, replicates=4)
LOOKING = replace(CHEAP, occupation_states=24)  # for the density, too


def certified(problem, occupation=None, constants=None, seed=0, settings=CHEAP, **formulas):
    return honesty.certified(problem, settings, seed, constants, occupation, **formulas)


def assert_true(certificate, optimum):
    """Every bound the gap may use is on its side of the optimum, but for chance."""
    for side, name in ((certificate.lower, certificate.best_lower), (certificate.upper, certificate.best_upper)):
        if name is not None:
            low, high = side[name[0]].interval(0.999)
            assert low <= optimum if side is certificate.lower else high >= optimum
    for perf in certificate.perf.values():
        if perf is not None and perf.finite:
            assert perf.interval(0.999)[1] >= optimum
    found = certificate.suboptimality
    if found["at_most"] is not None and found["at_least"] is not None:
        assert found["at_least"] <= found["at_most"]


@pytest.mark.parametrize("constant", [-3.0, 0.0, 0.05, 40.0])
def test_a_constant_value(constant):
    problem = Circle()
    certificate = certified(problem, value=lambda x: torch.full_like(x[:, 0], constant))
    assert_true(certificate, problem.exact_optimum)
    # No slope, no control: nothing moves, and everybody pays the mean cost.
    assert certificate.perf["value"].value == pytest.approx(1.0 / 12.0, rel=0.15)
    for estimate in (certificate.perf["value"], certificate.baseline["zero"]):
        low, high = estimate.interval(0.999)
        assert low <= 1.0 / 12.0 <= high


@pytest.mark.nightly
@pytest.mark.parametrize("size", [1e-3, 0.1])
@zoo.on(("circle rho=2", "manufactured 2-d q=1.5"))
def test_the_optimal_value_with_noise(problem, size):
    noise = zoo.rough_network(problem.dim, seed=1, size=size)
    certificate = certified(problem, value=lambda x: problem.exact_value(x) + noise(x))
    assert_true(certificate, problem.exact_optimum)


@pytest.mark.nightly
def test_an_untrained_network():
    problem = Manufactured(dim=2)
    fields = Fields.build(problem, ("value", "control_density", "log_occupation"), partial(PeriodicMLP, width=8), 3)
    assert_true(certified(problem, NETWORK, **fields.networks), problem.exact_optimum)


@pytest.mark.nightly
def test_no_flux_at_all():
    problem = Manufactured(dim=1)
    certificate = certified(problem, NETWORK, control_density=lambda x: 0.0 * x, log_occupation=lambda x: 0.0 * x[:, 0])
    assert_true(certificate, problem.exact_optimum)
    assert certificate.gap["certified"] is None


@pytest.mark.parametrize("flux", [0.0, 0.1])
def test_a_density_that_is_zero_on_a_region(flux):
    problem = Manufactured(dim=1)
    empty = lambda x: torch.where(x[:, 0].remainder(1.0) < 0.3, -torch.inf, 0.0)
    certificate = certified(problem, NETWORK, control_density=lambda x: torch.full_like(x, flux), log_occupation=empty)
    assert_true(certificate, problem.exact_optimum)
    assert any("mu is 0" in w for w in certificate.warnings)


def test_a_controller_that_leaves_its_bound():
    problem = Circle()
    certificate = certified(problem, value=problem.exact_value, constants=resolve_constants(problem, control_bound=0.1))
    assert any("beyond C_u" in w for w in certificate.warnings)
    assert_true(certificate, problem.exact_optimum)


class Negative(Manufactured):
    """The same problem with a constant taken off its cost once it is made."""

    taken = 0.0

    def __init__(self, **options) -> None:
        super().__init__(**options)
        self.taken = 0.3

    def state_cost(self, x):
        return super().state_cost(x) - self.taken


@pytest.mark.nightly
def test_a_cost_that_is_negative_somewhere():
    problem = Negative(dim=1)
    fields = Fields.build(problem, ("control_density", "log_occupation"), partial(PeriodicMLP, width=8), 3)
    certificate = certified(problem, NETWORK, **fields.networks)
    assert not certificate.assumptions.hold
    assert certificate.best_upper is None
    assert any("f >= 0" in w for w in certificate.warnings)


class Aperiodic(Circle):
    def state_cost(self, x):
        return x[:, 0].square()


class Seam(Circle):
    def __init__(self) -> None:
        super().__init__()
        self.exact_optimum = None  # that of another cost

    def state_cost(self, x):
        return x[:, 0].remainder(1.0)


class Striped(Circle):
    """Noise that jumps where the coordinate passes from 1 to 0, or whose sign alone does: the law is then the same."""

    def __init__(self, sign: bool = False) -> None:
        self.sign = sign
        super().__init__()

    def noise(self, x):
        part = x.remainder(1.0)
        return (0.1 * torch.where(part < 0.5, 1.0, -1.0) if self.sign else 0.1 * (1.0 + part)).unsqueeze(-1)


def test_noise_that_jumps_at_the_seam_spoils_what_takes_its_divergence():
    looked = lambda problem: check_problem(problem, replicated_samples(problem, 64, 2, 0, False))
    jumps = looked(Striped())
    assert not jumps.smooth_seam
    assert any(w.startswith("noise jumps by") and "bounds that take its divergence" in w for w in jumps.warnings)
    assert looked(Striped(sign=True)).warnings == []


class Heavy(Circle):
    def initial_density(self, x):
        return torch.full_like(x[:, 0], 1.5)


class Signed(Circle):
    def initial_density(self, x):
        return 1.0 + 1.5 * (2.0 * torch.pi * x[:, 0]).cos()


@pytest.mark.parametrize(
    ("problem", "words"),
    [(Aperiodic(), "not periodic"), (Heavy(), "integrates to 1.5"), (Signed(), "must not be negative")],
    ids=["aperiodic", "heavy", "signed"],
)
def test_what_is_no_problem_on_the_torus_gets_no_bound(problem, words):
    certificate = certified(problem, value=lambda x: 0.0 * x[:, 0])
    assert not certificate.assumptions.hold
    assert (certificate.best_lower, certificate.best_upper, certificate.best_perf) == (None, None, None)
    assert any(words in w for w in certificate.warnings)
    assert certificate.gap["simulated"] is None


def test_a_cost_that_jumps_at_the_seam_is_said_and_allowed():
    certificate = certified(Seam(), value=lambda x: 0.0 * x[:, 0])
    assert certificate.best_lower is not None
    assert any("passes from 1 to 0" in w for w in certificate.warnings)


class Dipped(Circle):
    """Costs less than nothing in a hole that no sampled state meets."""

    def state_cost(self, x):
        away = (x[:, 0] - 0.37) - (x[:, 0] - 0.37).round()
        return 0.5 + super().state_cost(x) - 3.0 * (1.0 - (away / 1e-5).square()).clamp_min(0.0).square()


def test_a_narrow_hole_below_zero_is_met_by_the_scan():
    certificate = certified(Dipped(), value=lambda x: 0.0 * x[:, 0])
    assert not certificate.assumptions.cost_holds
    assert any("the state cost falls to -" in w for w in certificate.warnings)


class Odd(Circle):
    """A drift that is 0 at the seam, as smooth as can be."""

    def __init__(self, size: float = 1.0) -> None:
        super().__init__()
        self.size = size

    def drift(self, x):
        return -self.size * (2.0 * torch.pi * x).sin()


class SeamDrift(Circle):
    """Jumps at the seam by a ten-thousandth of its largest value."""

    def drift(self, x):
        return (2.0 * torch.pi * x).sin() + 1e-4 * x.remainder(1.0)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_function_that_is_zero_at_the_seam_does_not_jump_there(size):
    problem = Odd(size)
    posed = check_problem(problem, replicated_samples(problem, 256, 2, 0, divergences=False))
    assert posed.smooth_seam
    assert posed.warnings == []


def test_a_small_jump_of_the_drift_at_the_seam_is_seen():
    problem = SeamDrift()
    posed = check_problem(problem, replicated_samples(problem, 256, 2, 0, divergences=False))
    assert not posed.smooth_seam


def test_weights_that_are_not_numbers():
    network = PeriodicMLP(1, width=4, depth=1)
    torch.nn.init.constant_(network.head.weight, torch.nan)
    with pytest.raises(InputError, match="not finite"):
        certified(Circle(), value=network)


class Hidden(Circle):
    """A circle whose author does not know how far its occupation density reaches."""

    def __init__(self, discount: float = 2.0) -> None:
        super().__init__(discount)
        self.true_sup, self.occupation_bound = self.occupation_bound, None


@pytest.mark.parametrize(
    ("discount", "seed"),
    [pytest.param(1.05, 0, marks=pytest.mark.nightly), pytest.param(1.2, 7, marks=pytest.mark.nightly), (2.0, 0)],
)
def test_half_of_sup_mu_is_caught_on_a_problem_that_does_not_know_it(discount, seed):
    problem = Hidden(discount)
    half = resolve_constants(problem, occupation_bound=0.5 * problem.true_sup)
    certificate = certified(problem, constants=half, seed=seed, settings=LOOKING, value=problem.exact_value)
    assert certificate.gap["lower_from"] == "shifted"
    assert not certificate.assumptions.hold
    assert any("F_M is not used" in w for w in certificate.warnings)


def test_twice_sup_mu_is_believed():
    problem = Hidden(2.0)
    certificate = certified(
        problem,
        constants=resolve_constants(problem, occupation_bound=2.0 * problem.true_sup),
        settings=LOOKING,
        value=problem.exact_value,
    )
    assert certificate.assumptions.occupation_holds
    assert certificate.assumptions.estimated_sup_occupation == pytest.approx(problem.true_sup, rel=0.02)


@pytest.mark.nightly
def test_an_unbounded_density_is_caught_without_being_told():
    problem = Hidden(0.8)
    constants = resolve_constants(problem, occupation_bound=50.0)
    certificate = certified(problem, constants=constants, settings=LOOKING, value=problem.exact_value)
    assert not certificate.assumptions.occupation_holds
    assert certificate.to_dict()["assumptions"]["estimated_sup_occupation"] is None


class TooLarge(Manufactured):
    """Declares a sup mu* far below the true one."""

    def __init__(self, **options) -> None:
        super().__init__(**options)
        self.occupation_bound = 1.05

    def exact_occupation(self, x):
        return None


@pytest.mark.nightly
def test_a_declared_sup_mu_that_the_controller_exceeds_is_not_believed():
    problem = TooLarge(dim=1, contrast=0.9)
    assert not certified(problem, settings=LOOKING, value=problem.exact_value).assumptions.occupation_holds
