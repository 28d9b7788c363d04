"""Densities on boxes: they tile the torus, their points follow them, and weighted means are integrals whatever was fitted."""

from dataclasses import replace

import pytest
import torch

from ocp_torch.errors import InputError
from ocp_torch.maths.boxes import Boxes, fitted
from ocp_torch.maths.sampling import ImportanceSampler, scrambled_sobol

UNIFORM = 0.3


def bump(x):
    """A needle of radius 0.05 on a slope."""
    return 20.0 * (-((x - 0.3) / 0.05).square().sum(dim=-1)).exp() + x[:, 0]


def boxes_of(dim, score=bump, count=8192):
    x = scrambled_sobol(count, dim, 1, torch.float64)
    return fitted(x, torch.ones(count, dtype=torch.float64), score(x), UNIFORM)


@pytest.mark.parametrize("dim", [1, 2, 4])
def test_boxes_tile_the_torus_and_weights_are_one_over_the_density(dim):
    boxes = boxes_of(dim)
    boxes.require_density(dim)
    assert len(boxes.leaves) > 4
    x, weight = boxes.place(scrambled_sobol(5000, dim, 2, torch.float64))
    torch.testing.assert_close(1.0 / weight, boxes.density(x))
    assert float(weight.max()) <= 1.0 / UNIFORM + 1e-12
    assert float(weight.min()) < 0.9
    assert float(boxes.density(scrambled_sobol(2**14, dim, 3, torch.float64)).mean()) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("dim", [1, 2, 4])
def test_weighted_means_are_integrals_whatever_the_scores_were(dim):
    """Of `prod_j (1 + cos(2 pi x_j) / 2)`, which is 1, and of `x_0^2`; within four standard errors of independent states."""
    noisy = torch.Generator().manual_seed(0)
    for score in (bump, lambda x: torch.rand(len(x), generator=noisy, dtype=torch.float64).pow(8)):
        u = torch.rand(200_000, dim, generator=noisy, dtype=torch.float64)
        x, weight = boxes_of(dim, score).place(u)
        for values, truth in (((1.0 + 0.5 * (2.0 * torch.pi * x).cos()).prod(dim=-1), 1.0), (x[:, 0] ** 2, 1.0 / 3.0)):
            terms = weight * values
            assert abs(float(terms.mean()) - truth) < 4.0 * float(terms.std()) / len(u) ** 0.5


def test_in_one_dimension_the_second_moment_is_near_its_least():
    """`int g^2 / p >= (int |g|)^2` for every density; without an even part boxes come near that, from a pool of their own."""
    grid = (torch.arange(100_000, dtype=torch.float64)[:, None] + 0.5) / 100_000
    g = bump(grid)
    x = scrambled_sobol(8192, 1, 1, torch.float64)
    boxes, weight = Boxes.whole(1), torch.ones(8192, dtype=torch.float64)
    for _ in range(2):
        x, weight = boxes.place(scrambled_sobol(8192, 1, 1, torch.float64))
        boxes = fitted(x, weight, bump(x), 1e-3)
    inner = grid[1:-1]  # rounding may put the ends of a box into none
    moment = float((bump(inner).square() / boxes.density(inner)).mean())
    assert float(g.mean() ** 2) <= moment < 1.1 * float(g.mean() ** 2) < 0.5 * float(g.square().mean())


def test_even_points_stay_even():
    """As many of `2^k` Sobol points in each box as its probability says, but for the two at its ends."""
    boxes = boxes_of(1)
    x, _ = boxes.place(scrambled_sobol(1024, 1, 5, torch.float64))
    low, size, wanted = boxes.low[boxes.leaves], boxes.size[boxes.leaves], 1024 * boxes.probability[boxes.leaves]
    inside = ((x[:, None] >= low) & (x[:, None] < low + size)).all(dim=-1).sum(dim=0)
    assert float((inside - wanted).abs().max()) <= 2.0


@pytest.mark.parametrize("score", [0.0, float("nan"), float("inf")])
def test_scores_that_say_nothing_give_the_uniform_density(score):
    boxes = boxes_of(2, lambda x: torch.full_like(x[:, 0], score))
    assert len(boxes.leaves) == 1
    assert torch.equal(boxes.weight, torch.ones(1, dtype=torch.float64))


def test_a_sampler_goes_on_bitwise_and_never_mixes_pool_and_batches():
    def drawn(sampler, count):
        found = []
        for _ in range(count):
            if sampler.due:
                x, weight = sampler.pool()
                sampler.learn(x, weight, bump(x))
            found.append(torch.cat([part.reshape(16, -1) for part in sampler.draw_weighted(16)], dim=1))
        return torch.stack(found)

    make = lambda: ImportanceSampler(2, 0, torch.float32, every=3, pool=500)
    whole = drawn(make(), 12)
    assert bool((whole[:3, :, 2] == 1.0).all())
    assert not bool((whole[3:, :, 2] == 1.0).all())
    for stop in (1, 3, 5, 6):
        sampler, again = make(), make()
        drawn(sampler, stop)
        again.load_state_dict(sampler.state_dict())
        assert torch.equal(drawn(again, 12 - stop), whole[stop:])
    pool = make().pool()[0]
    assert not {*map(tuple, pool.tolist())} & {*map(tuple, whole[..., :2].flatten(0, 1).tolist())}


def test_boxes_that_are_no_density_are_refused():
    boxes = boxes_of(2)
    wrong = (
        replace(boxes, probability=boxes.probability * 0.9),
        replace(boxes, probability=boxes.probability.float()),
        replace(boxes, probability=torch.where(boxes.axis == 0, boxes.probability, 0.1)),
        replace(boxes, low=boxes.low + 0.1),
        replace(boxes, size=boxes.size[:, :1]),
        replace(boxes, size=boxes.size * float("nan")),
        replace(boxes, children=boxes.children.flip(0)),
        replace(boxes, children=boxes.children + 10**6),
        replace(boxes, axis=boxes.axis + 5),
    )
    for state in wrong:
        with pytest.raises(InputError, match="no density of 2 coordinates"):
            state.require_density(2)
    with pytest.raises(InputError, match="no density of 3 coordinates"):
        boxes.require_density(3)
