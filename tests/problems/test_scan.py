"""Narrow features of a problem's data are found by scanning, and suprema looked for there."""

import math

import pytest
import torch

from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.statistics.estimate import replicated_samples
from ocp_torch.problems import Circle, Problem
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.scan import odd_states
from support.adversarial import short_way


class Needle(Problem):
    """`dx = a + B u` where one of `f`, `a`, `B` has a needle of ``radius`` and size 0.3 within its usual range."""

    def __init__(self, where: str, dim: int, radius: float) -> None:
        super().__init__(dim=dim)
        self.where, self.radius = where, radius
        self.centre = torch.linspace(0.31, 0.77, dim, dtype=torch.float64)

    def needle(self, x, name):
        r = short_way(x, self.centre).norm(dim=-1) / self.radius
        return torch.where(r < 1.0, -0.3 * (1.0 - r.square()).square(), 0.0) * (name == self.where)

    def state_cost(self, x):
        return 1.0 + (2.0 * math.pi * x[:, 0]).cos() + self.needle(x, "f")

    def drift(self, x):
        return (2.0 * math.pi * x).cos() + self.needle(x, "a").unsqueeze(-1)

    def control_matrix(self, x):
        return torch.diag_embed(1.0 + 0.5 * (2.0 * math.pi * x).sin() + self.needle(x, "B").unsqueeze(-1))


@pytest.mark.nightly
@pytest.mark.parametrize("where", ["f", "a", "B"])
@pytest.mark.parametrize(("dim", "radius"), [(1, 1e-4), (2, 4e-3), (4, 0.06)])
def test_a_needle_within_the_usual_range_of_the_data_is_found(where, dim, radius):
    problem = Needle(where, dim, radius)
    found = odd_states(problem, 2**20, seed=3)
    assert float(short_way(found, problem.centre).norm(dim=-1).min()) < radius


class Rugged(Problem):
    """Many wells and peaks, or those turned upside down."""

    def __init__(self, seed: int, sign: float) -> None:
        super().__init__(dim=1)
        generator = torch.Generator().manual_seed(seed)
        self.sizes, self.phases = (torch.rand(12, generator=generator, dtype=torch.float64) for _ in range(2))
        self.sign = sign

    def state_cost(self, x):
        waves = 2.0 * math.pi * torch.arange(1, 13).to(x)
        return 12.0 + self.sign * ((waves * (x + self.phases)).cos() * self.sizes).sum(dim=-1)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(5))
def test_the_lowest_and_the_highest_state_of_all_are_found(seed, sign):
    problem, everywhere = Rugged(seed, sign), torch.linspace(0.0, 1.0, 2**16, dtype=torch.float64).unsqueeze(-1)
    f, found = problem.state_cost(everywhere), problem.state_cost(odd_states(problem, 2**12, seed=0))
    assert float(found.min()) == pytest.approx(float(f.min()), abs=1e-6)
    assert float(found.max()) == pytest.approx(float(f.max()), abs=1e-6)


@pytest.mark.nightly
def test_a_supremum_that_only_a_scan_meets_is_used():
    problem = Needle("f", 2, 1e-3)
    V = lambda x: 1e-3 * (2.0 * math.pi * x).sin().sum(dim=-1)
    sets = replicated_samples(problem, 64, 2, seed=0, divergences=False)
    odd = odd_states(problem, 2**21, seed=0)
    blind, seeing = (SampledValue(problem, V, sets, ascents=4, odd=states) for states in (None, odd))
    centre = problem.centre.unsqueeze(0)
    # At the bottom of the needle V is about 0 and the conjugate hardly anything, so the slack is about -f.
    assert seeing.own.largest.value >= float(-problem.state_cost(centre)) - 0.02
    # A state that takes the bound away joins the search as well.
    assert seeing.own.largest.points >= blind.own.largest.points + len(odd)


def test_the_package_s_own_problems_are_not_scanned_but_what_derives_from_them_is():
    class Mine(Circle):
        pass

    assert (Circle().scan_factor, Mine().scan_factor) == (0, 32)
    assert len(odd_states(Circle(), 0, seed=0)) == 0
    assert resolve_constants(Circle()).basis("M") == "given"
