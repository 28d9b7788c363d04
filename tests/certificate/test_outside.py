"""What part of the discounted time is spent outside the box of a system, against what is known in closed form."""

import math

import pytest
import torch

from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated.outside import outside_note, time_outside
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.control.policies import zero_policy
from ocp_torch.problems import Circle
from support.systems import Conveyor, Swing

SETTINGS = CertificateSettings(trajectories=64, replicates=8)


@pytest.mark.parametrize(
    ("speed", "start"),
    [
        (1.0, (0.0, 1.0)),
        *(pytest.param(*p, marks=pytest.mark.nightly) for p in ((-2.0, (-0.9, 2.0)), (1.0, (2.8, 2.9)))),
    ],
)
def test_on_a_conveyor_it_is_the_discount_at_the_time_of_leaving(speed, start):
    """`s' = speed` leaves at `t = (end - s) / speed` and never comes back: the part is `E[e^{-rho t}]`."""
    system = Conveyor(speed=speed, start={"place": start})
    s = torch.linspace(*start, 100_001, dtype=torch.float64)
    time = ((3.0 if speed > 0.0 else -1.0) - s) / speed
    mass = system._density(s.unsqueeze(-1))
    exact = float(torch.trapezoid(mass * torch.exp(-system.discount * time), s))
    found = time_outside(system, zero_policy(system), SETTINGS, 0)
    assert found.value == pytest.approx(exact, abs=found.half_width(0.999))
    assert found.half_width(0.95) < 0.01 + 0.06 * exact
    (note,) = outside_note(system, found)
    assert "outside the box of place" in note


def test_a_controller_that_never_leaves_spends_no_time_there():
    system = Conveyor(start={"place": (-0.5, 2.5)})
    found = time_outside(system, lambda x: system.to_controls(torch.full_like(x, -1.0)), SETTINGS, 0)
    assert found.value < 1e-3
    assert outside_note(system, found) == []


def test_what_may_be_much_is_said_too():
    system = Conveyor()
    seen = Estimate(1e-4, 5e-3, replicates=8)
    assert seen.above > 0.01
    (note,) = outside_note(system, seen)
    assert "may spend up to 1.2 %" in note
    assert "0.01 % was seen" in note
    assert outside_note(system, Estimate(1e-4, 1e-3, replicates=8)) == []


def test_with_noise_it_is_what_brownian_motion_says():
    """From the middle of an interval, a motion of variance `s^2 t` has not left at an exponential time with probability
    `1 - 1 / cosh(L sqrt(2 rho) / s)`; once outside, it may come back: the part is below that, and not 0."""

    class Wanderer(Conveyor):
        def disturbance(self, s):
            return torch.full_like(s, 2.0).unsqueeze(-1)

    system = Wanderer(speed=0.0, start={"place": (0.9, 1.1)})
    left = 1.0 / math.cosh(2.0 * math.sqrt(2.0 * system.discount) / 2.0)
    found = time_outside(system, zero_policy(system), SETTINGS, 0)
    assert 0.5 * left - 0.05 < found.value < left + 0.05


@pytest.mark.parametrize("problem", [Circle(), Swing()])
def test_there_is_none_without_a_box_or_without_simulation(problem):
    settings = SETTINGS if isinstance(problem, Circle) else CertificateSettings(trajectories=0)
    assert time_outside(problem, zero_policy(problem), settings, 0) is None
