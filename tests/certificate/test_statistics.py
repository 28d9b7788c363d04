"""Intervals: Student's t against tables, and how often they cover the truth."""

import math
from dataclasses import replace

import pytest
import torch

from ocp_torch.certificate import CertificateSettings, Run
from ocp_torch.certificate.statistics.estimate import Estimate, t_factor
from ocp_torch.errors import InputError
from ocp_torch.maths.sampling import evaluation_points
from support.looks import certificate

TURN = 2.0 * math.pi
# Two-sided, from the usual tables.
TABLE = {(1, 0.95): 12.7062, (2, 0.95): 4.30265, (3, 0.99): 5.84091, (4, 0.5): 0.740697, (7, 0.9): 1.89458}
TABLE |= {(7, 0.95): 2.36462, (9, 0.998): 4.29681, (30, 0.95): 2.04227, (120, 0.99): 2.61742}


@pytest.mark.parametrize(("degrees", "level"), TABLE)
def test_quantiles_are_those_of_the_tables(degrees, level):
    assert t_factor(level, degrees) == pytest.approx(TABLE[degrees, level], rel=2e-6)


def test_many_degrees_of_freedom_are_normal():
    assert t_factor(0.95, 10**4) == pytest.approx(1.959964, rel=2e-4)


@pytest.mark.parametrize(("level", "degrees"), [(0.0, 7), (1.0, 7), (math.nan, 7), (0.95, 0)])
def test_impossible_levels_and_degrees_are_refused(level, degrees):
    with pytest.raises(InputError):
        t_factor(level, degrees)


@pytest.mark.parametrize("level", [0.0, 1.0, "high"])
def test_an_impossible_confidence_is_refused_by_name(level):
    with pytest.raises(InputError, match="certificate.confidence"):
        CertificateSettings(confidence=level)


def test_an_interval_is_t_standard_errors_and_all_of_the_bias():
    estimate = Estimate.of([1.0, 2.0, 3.0], bias=0.5)
    half = t_factor(0.9, 2) * 1.0 / math.sqrt(3.0) + 0.5
    assert estimate.interval(0.9) == pytest.approx((2.0 - half, 2.0 + half))
    assert Estimate(1.0, 0.0).interval(0.95) == (1.0, 1.0)


def test_what_is_said_of_the_suboptimality_holds_jointly_whatever_the_number_of_controllers():
    """Ten controllers of equal cost, one known to the last digit: the smallest upper end of the others tends to be low."""
    normal = torch.Generator().manual_seed(0)
    truth, controllers, wrong = 1.0, 10, 0
    plain = certificate(Run("circle", "dual"), 0.1)
    drawn = 1.0 + 0.01 * torch.randn(400, controllers, 8, generator=normal, dtype=torch.float64)
    for lower, *others in drawn.tolist():
        perf = {f"{i}": Estimate.of(values) for i, values in enumerate(others)}
        perf["mine"] = Estimate(truth, 0.0)
        said = replace(plain, lower={"F_M": Estimate.of(lower)}, perf=perf, subject="mine").suboptimality
        wrong += not said["at_least"] <= 0.0 <= said["at_most"]
    # A true level of 95 % is missed this often once in a hundred.
    assert wrong <= 0.05 * 400 + 2.33 * math.sqrt(0.05 * 0.95 * 400)


def V(y):
    return 0.06 - 0.05 * (TURN * y).cos() + 0.02 * (2 * TURN * y).sin()


def slack(y):
    """Of `V` on the circle."""
    slope = TURN * (0.05 * (TURN * y).sin() + 0.04 * (2 * TURN * y).cos())
    return V(y) - (y - 0.5) ** 2 + (slope / 2.0) ** 2 / 2.0


# A penalised bound in one and in two coordinates: smooth, but for the hinge and the kink of f.
INTEGRANDS = {
    "F_M": (1, lambda x: V(x[:, 0]) - 1.6 * slack(x[:, 0]).clamp_min(0.0)),
    "F_M 2-d": (
        2,
        lambda x: (
            V(x[:, 0]) * (1.0 + 0.5 * (TURN * (x[:, 0] + 2.0 * x[:, 1])).sin())
            - 1.6 * (slack(x[:, 0]) + 0.03 * (TURN * (x[:, 1] - x[:, 0])).sin()).clamp_min(0.0)
        ),
    ),
}


@pytest.mark.nightly
@pytest.mark.parametrize("name", INTEGRANDS)
def test_intervals_cover_as_often_as_they_claim(name):
    """400 repetitions: a true coverage of 95 % is missed by more than 2.5 % once in fifty."""
    dim, integrand = INTEGRANDS[name]
    side = {1: 10**5, 2: 10**3}[dim]
    line = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    truth = float(integrand(torch.cartesian_prod(*[line] * dim).reshape(-1, dim)).mean())
    hits = 0
    for seed in range(400):
        low, high = Estimate.of(
            [float(integrand(evaluation_points(64, dim, r, seed)).mean()) for r in range(8)]
        ).interval(0.95)
        hits += low <= truth <= high
    assert 0.925 <= hits / 400 <= 0.975
