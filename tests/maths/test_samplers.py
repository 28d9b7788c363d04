"""Training states: in `[0, 1)`, the same however they are drawn, continued bitwise, and never met by an evaluation."""

import pytest
import torch

from ocp_torch.maths import sampling as samplers
from ocp_torch.maths.sampling import SobolSampler, UniformSampler, evaluation_points, scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed

each_sampler = pytest.mark.parametrize("make", [UniformSampler, SobolSampler])
each_precision = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def rows(x: torch.Tensor) -> set[tuple[float, ...]]:
    return set(map(tuple, x.double().tolist()))


@each_sampler
@each_precision
def test_states_fill_the_unit_cube_uniformly(make, dtype):
    x = make(3, seed=0, dtype=dtype).draw(2**14)
    assert x.shape == (2**14, 3)
    assert x.dtype == dtype
    assert (x >= 0.0).all()
    assert (x < 1.0).all()
    # Four standard errors of independent draws: means of x and x^2 are 1/2 and 1/3, and coordinates are uncorrelated.
    error = 4.0 / 2**7
    torch.testing.assert_close(x.mean(dim=0).double(), torch.full((3,), 0.5).double(), rtol=0.0, atol=0.29 * error)
    second = (x.T @ x / len(x)).double()
    torch.testing.assert_close(
        second, torch.full((3, 3), 0.25).double() + torch.eye(3) / 12.0, rtol=0.0, atol=0.3 * error
    )


class NearlyOne:
    """A Sobol engine whose points are the largest ones it can draw."""

    def __init__(self, dim, **_):
        self.dim = dim

    def draw(self, count, dtype):
        return torch.full((count, self.dim), 1.0 - 2.0**-30, dtype=dtype)


def test_a_single_precision_state_is_never_one(monkeypatch):
    monkeypatch.setattr(samplers, "SobolEngine", NearlyOne)
    drawn = [SobolSampler(2, 0, torch.float32).draw(4), scrambled_sobol(4, 2, 0, torch.float32)]
    for x in drawn:
        assert ((x >= 0.0) & (x < 1.0)).all()
    assert (scrambled_sobol(4, 2, 0, torch.float64) > 0.999).all()


@each_sampler
def test_training_and_evaluation_states_are_disjoint(make):
    training = rows(torch.cat([make(2, seed, torch.float64).draw(5000) for seed in (0, 1)]))
    evaluation = rows(torch.cat([evaluation_points(4096, 2, r, seed) for r in (0, 1, 1000) for seed in (0, 1)]))
    assert len(training) == 10000
    assert len(evaluation) == 6 * 4096
    assert not training & evaluation


def test_branches_of_the_seed_tree_are_distinct():
    seeds = [derive_seed(seed, *path) for seed in range(5) for path in ((0,), (1,), (0, 0), (0, 1), (1, 0), (1, 1))]
    assert len(set(seeds)) == len(seeds)
    assert derive_seed(3, Branch.VISITS, 4) == derive_seed(3, Branch.VISITS, 4)


@each_sampler
def test_the_seed_decides_the_states(make):
    first, again, other = (make(2, seed, torch.float64).draw(50) for seed in (5, 5, 6))
    assert torch.equal(first, again)
    assert not rows(first) & rows(other)


@each_sampler
@each_precision
def test_a_reloaded_sampler_continues_bitwise_across_the_blocks(make, dtype, monkeypatch):
    """200 states of a sequence scrambled anew every 64, interrupted at each place in turn."""
    monkeypatch.setattr(samplers, "SOBOL_BLOCK", 64)
    whole = make(2, 0, dtype).draw(200)
    for stop in (0, 1, 63, 64, 65, 130):
        sampler = make(2, 0, dtype)
        assert torch.equal(sampler.draw(stop) if stop else whole[:0], whole[:stop])
        state = sampler.state_dict()
        rest = sampler.draw(200 - stop)
        resumed = make(2, 0, dtype)
        resumed.draw(17)
        resumed.load_state_dict(state)
        assert torch.equal(rest, whole[stop:])
        assert torch.equal(resumed.draw(200 - stop), rest)


@each_sampler
@pytest.mark.parametrize("chunks", [(100,) * 6, (1, 63, 64, 65, 7, 400), (599, 1)])
def test_the_size_of_the_draws_does_not_matter(make, chunks, monkeypatch):
    monkeypatch.setattr(samplers, "SOBOL_BLOCK", 64)
    sampler = make(3, 2, torch.float32)
    assert torch.equal(torch.cat([sampler.draw(n) for n in chunks]), make(3, 2, torch.float32).draw(600))


def test_a_sobol_stream_goes_on_past_what_is_buffered_and_never_repeats_itself(monkeypatch):
    """Blocks of 10,000 are more than one engine draw; another block is another scrambling, not the same points."""
    monkeypatch.setattr(samplers, "SOBOL_BLOCK", 10_000)
    sampler = SobolSampler(2, 0, torch.float64)
    x = torch.cat([sampler.draw(777) for _ in range(33)])
    assert len(rows(x)) == len(x)
    engine = scrambled_sobol(10_000, 2, derive_seed(0, Branch.TRAINING, 1), torch.float64)
    assert torch.equal(x[10_000:20_000], engine)


@each_precision
def test_points_made_on_a_device_are_those_of_the_engine(dtype, device):
    """From anywhere in a scrambling, to its end."""
    drawn, made = (SobolSampler(5, 3, dtype) for _ in range(2))
    x = drawn.draw(samplers.SOBOL_BLOCK)
    for position, count in ((0, 1), (0, 7), (1000, 24), (samplers.SOBOL_BLOCK - 9, 9)):
        found = made._made(0, position, count, device)
        assert found.device.type == device.type
        assert torch.equal(found.cpu(), x[position : position + count])


def test_a_device_draws_the_same_states_however_many(device, monkeypatch):
    monkeypatch.setattr(samplers, "SOBOL_BLOCK", 64)
    monkeypatch.setattr(samplers, "ON_GPU_FROM", 60)
    here, there = (SobolSampler(2, 1, torch.float32) for _ in range(2))
    for count in (10, 50, 130, 3):
        assert torch.equal(there.draw(count, device).cpu(), here.draw(count))
    assert here.state_dict() == there.state_dict()
