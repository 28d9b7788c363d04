"""Where nobody gives an `M`, `F_M` takes one from the controller's density: nearer to the optimum, a guess, and used so."""

from functools import partial

import pytest
import torch

from ocp_torch.certificate import Run, StageSettings, Trained, certify_fields
from ocp_torch.certificate.contexts.trained import TrainedContext
from ocp_torch.certificate.lower.penalised import levelled
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.report import table
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.statistics.estimate import replicated_samples
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.problems import Circle
from ocp_torch.problems.constants import FROM_DENSITY, OBSERVED_ROOM, resolve_constants
from ocp_torch.problems.needs import GIVEN, GUESSED
from support import zoo
from support.formulas import ERRORS, Field

NOISE, DISCOUNT = 1e-2, 2.0
# Of the circle with that noise, by finite differences (tests/studies/test_noisy_reference.py).
OPT, SUP_MU = 0.0668854871, 1.4713
NODES = 512
SETTINGS = CertificateSettings(
    points=512,
    trajectories=32,
    ascents=8,
    occupation_states=0,  # the fitted density alone
    mollify=False,
    tolerance=1e-4,
    stage=StageSettings(steps=150, rounds=1, batch=128),
)


class Unsaid(Circle):
    """The circle by somebody who knows no bound of `mu*`, and that there is nothing narrow to scan for."""

    scan_factor = 0

    def __init__(self) -> None:
        super().__init__(discount=DISCOUNT, noise=NOISE)
        self.occupation_bound = None


def spectral() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Nodes of the circle, and differentiation on them once and twice, as matrices."""
    k = torch.fft.fftfreq(NODES, 1.0 / NODES, dtype=torch.float64)
    k[NODES // 2] = 0.0
    eye = torch.eye(NODES, dtype=torch.complex128)
    once = torch.fft.ifft(2j * torch.pi * k[:, None] * torch.fft.fft(eye, dim=0), dim=0).real
    return torch.arange(NODES, dtype=torch.float64) / NODES, once, once @ once


@pytest.fixture(scope="module")
def solved():
    """`V*`, `mu*` and `q -> Z`, `Z - L* Z / rho = q`, all at the nodes: Newton's method on the HJB equation."""
    x, once, twice = spectral()
    k = torch.arange(1, NODES // 2, dtype=torch.float64)
    f = 1.0 / 12.0 + (2.0 * torch.pi * x[:, None] * k).cos() @ (torch.pi * k).pow(
        -2
    )  # (x - 1/2)^2, by its Fourier series
    eye, V = torch.eye(NODES, dtype=torch.float64), torch.zeros(NODES, dtype=torch.float64)
    for _ in range(12):
        slope = once @ V
        slack = V - NOISE / DISCOUNT * twice @ V - f + (slope / DISCOUNT).square() / 2.0
        linear = eye - NOISE / DISCOUNT * twice + (slope / DISCOUNT**2)[:, None] * once
        V = V - torch.linalg.solve(linear, slack)
    mu = torch.linalg.solve(linear.T, torch.ones_like(V))  # the adjoint, against a uniform start
    assert float(V.mean()) == pytest.approx(OPT, rel=1e-6)
    assert float(mu.max()) == pytest.approx(SUP_MU, rel=1e-3)
    return V, mu, lambda q: torch.linalg.solve(linear, q)


def interpolated(values: torch.Tensor):
    """The trigonometric polynomial through ``values`` at the nodes."""
    c = torch.fft.rfft(values)[:-1] / NODES * torch.tensor([1.0] + [2.0] * (NODES // 2 - 1))
    k = 2.0 * torch.pi * torch.arange(len(c), dtype=torch.float64)
    return Field(lambda x: ((x.double() * k).cos() @ c.real - (x.double() * k).sin() @ c.imag).to(x))


def certificate_of(values: torch.Tensor):
    problem = Unsaid()
    trained = Trained(Fields({"value": interpolated(values)}), None, partial(PeriodicMLP, width=16, depth=2, modes=2))
    return certify_fields(problem, trained, resolve_constants(problem), SETTINGS, Run("circle", "dual"))


@pytest.mark.nightly
def test_the_density_of_the_controller_gives_a_conditional_bound_near_the_optimum(solved):
    V, *_ = solved
    wave = (2.0 * torch.pi * 3.0 * torch.arange(NODES, dtype=torch.float64) / NODES).cos()
    found = certificate_of(V + 1e-5 * wave)
    said = found.to_dict()
    M, bound = found.assumptions.M, said["lower"]["F_M"]
    assert SUP_MU < M < 1.1 * OBSERVED_ROOM * SUP_MU
    assert bound["value"] == pytest.approx(OPT, rel=2e-3)
    assert bound["value"] < OPT
    assert bound["if"] == f"sup mu* <= {M:.4g} ({FROM_DENSITY})"
    assert f"gap, if {bound['if']}: " in table(said)
    assert not bound["counts"]
    assert said["gap"]["lower_from"] == "shifted"
    assert said["lower"]["shifted"]["value"] < bound["value"]
    assert said["gap"]["conditional"] < said["gap"]["certified"]
    assert found.hold


@pytest.mark.nightly
def test_a_density_that_is_far_too_small_enters_nothing_that_counts(solved, monkeypatch):
    """`E[Z mu0] = E[q mu*]`: with `q` where `mu*` is above an `M` that is too small, `V* + t Z` has its `F_M` above `OPT`."""
    V, mu, inverse = solved
    monkeypatch.setattr(TrainedContext, "largest_density", 1.0)
    found = certificate_of(V + 0.05 * inverse((mu - OBSERVED_ROOM).clamp_min(0.0)))
    said = found.to_dict()
    assert found.assumptions.M == OBSERVED_ROOM
    assert said["lower"]["F_M"]["value"] > 1.002 * OPT
    assert not said["lower"]["F_M"]["counts"]
    assert found.best_lower[0] == "shifted"
    assert found.best_lower[1] < OPT < found.best_upper[1]
    assert said["gap"]["lower_from"] == "shifted"
    assert not any("sup mu*" in sentence for sentence in said["suboptimality"]["takes"])
    assert said["suboptimality"]["at_least"] < said["suboptimality"]["at_most"]
    sure = [line for line in table(said).splitlines() if "sure" in line]
    assert len(sure) == 1
    assert "mu*" not in sure[0]


@pytest.mark.nightly
@zoo.on(("circle rho=2", "noisy 2-d sigma(x)"))
@pytest.mark.parametrize("M", [1.7, 1e9])
def test_the_best_multiple_and_constant_are_found_and_leave_a_bound(problem, M):
    """Against other multiples and constants, the shifted bound and, where `M` is large enough, the optimum."""
    network = zoo.rough_network(problem.dim, seed=3, size=0.05)
    value = lambda x: problem.exact_value(x) + 7.0 + network(x)
    sets = replicated_samples(problem, 2048, 4, 0, divergences=False)
    shift = SampledValue(problem, value, sets).own
    found, mean = levelled(shift, M), sum(shift.initial) / len(shift.initial)
    highest = -float("inf")
    for theta in torch.linspace(0.0, 1.2, 13).tolist():
        slack = torch.cat([part.slack(theta) for part in shift.parts])
        off = (slack.unsqueeze(-1) - (c := slack.sort().values[::128])).clamp_min(0.0).mean(dim=0)
        highest = max(highest, float((theta * mean - c - M * off).max()))
    assert found.value >= shift.bound - ERRORS * found.se - 1e-9
    if M == 1e9:
        assert found.value == pytest.approx(shift.bound)
    else:
        assert highest - ERRORS * found.se - 1e-3 <= found.value <= 1.05 * highest + ERRORS * found.se
    if M >= problem.occupation_bound:
        assert found.value <= problem.exact_optimum + ERRORS * found.se


def test_a_constant_in_the_value_changes_nothing_of_the_best(solved):
    V, *_ = solved
    sets = replicated_samples(Unsaid(), 512, 2, 0, divergences=False)
    low, high = (levelled(SampledValue(Unsaid(), interpolated(V + c), sets).own, 2.0).value for c in (-0.01, 3.0))
    assert low == pytest.approx(high, abs=1e-7)


INF, NAN = float("inf"), float("nan")


@pytest.mark.parametrize(
    ("density", "M"),
    [(None, 40), (1.0, 1.2), (1.5, 1.8), (33, 39.6), (34, 40), (47, 40), (90, 108), (0.3, 40), (INF, 40), (NAN, 40)],
)
def test_only_a_guess_is_made_anew_and_only_from_what_a_density_can_be(density, M):
    constants = resolve_constants(Unsaid())
    assert constants.M == 40.0
    assert constants.informed(density).M == pytest.approx(M)
    assert constants.informed(density).basis("M") == GUESSED
    given = resolve_constants(Circle(noise=NOISE))
    assert given.informed(density) is given
    assert given.basis("M") == GIVEN
