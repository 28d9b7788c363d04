"""Importance sampling: integrands and scores against their definitions; losses and gradients unbiased for every method."""

from functools import partial

import pytest
import torch

from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.maths.sampling import ImportanceSampler, scrambled_sobol
from ocp_torch.objectives import METHODS, Phase
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.training import importance
from ocp_torch.training.batches import Batches
from ocp_torch.training.importance import integrands, scores
from support import zoo

WAYS = {
    "dual": ("circle rho=2", METHODS["dual"]),
    "primal": ("circle rho=2", METHODS["primal"]),
    "pd": ("circle rho=2", partial(METHODS["pd"], density_batch=128)),
    "pd, plain": ("circle rho=2", partial(METHODS["pd"], augmentation=0.0)),
    "dual, drift": ("arm n=2", METHODS["dual"]),
    "dual, noise": (zoo.NOISY[0], METHODS["dual"]),
    "pd, noise": (zoo.NOISY[0], METHODS["pd"]),
}


def build(way, size=256, visited=0.0):
    name, method = WAYS[way]
    problem = zoo.build(name)
    objective, phase = method(problem=problem), Phase(resolve_constants(problem))
    network = partial(PeriodicMLP, width=12)
    fields = Fields.build(problem, objective.fields, network, 3).double()
    sampler = ImportanceSampler(problem.dim, 0, torch.float64, every=1, pool=2000)
    return Batches(problem, fields, objective, sampler, size, 0, visited), phase


def gradients(batches, samples, phase):
    """Each player's loss, and its gradient by the player's own weights, as one vector a player."""
    objective, fields = batches.objective, batches.fields
    found = {}
    for player, loss in objective.losses(fields, samples, phase).items():
        own = fields.parameters_of(objective.players[player])
        parts = torch.autograd.grad(loss, own, retain_graph=True, allow_unused=True, materialize_grads=True)
        found[player] = torch.cat([loss.detach().reshape(1), *(p.flatten() for p in parts)])
    return found


@pytest.mark.parametrize("way", WAYS)
def test_integrands_are_what_the_losses_are_the_mean_of(way):
    batches, phase = build(way)
    samples = batches.problem.samples(zoo.states(batches.problem, 128))
    losses = batches.objective.losses(batches.fields, samples, phase)
    parts = integrands(batches.objective, batches.fields, samples, phase)
    assert parts.keys() == losses.keys()
    for player, loss in losses.items():
        torch.testing.assert_close(parts[player].mean(), loss.detach())
    one = samples.take(slice(7, 8))
    alone = batches.objective.losses(batches.fields, one, phase)
    for player, loss in alone.items():
        torch.testing.assert_close(parts[player][7], loss.detach())


@pytest.mark.parametrize("way", ["dual", "primal", "dual, noise"])
def test_scores_are_proportional_to_the_gradients_of_single_states(way, monkeypatch):
    monkeypatch.setattr(importance, "DIRECTIONS", 400)
    monkeypatch.setattr(importance, "STEP_LENGTH", 1e-5)
    batches, phase = build(way)
    samples = batches.problem.samples(zoo.states(batches.problem, 60))
    before = [p.clone() for p in batches.fields.parameters()]
    found = scores(batches.objective, batches.fields, samples, phase, torch.Generator().manual_seed(0))
    single = [gradients(batches, samples.take(slice(i, i + 1)), phase) for i in range(60)]
    norms = torch.stack([next(iter(g.values()))[1:].norm() for g in single])
    ratio = found / norms
    assert float((ratio / ratio.mean() - 1.0).abs().max()) < 0.2  # 400 directions give a norm to 4 % or so
    assert all(torch.equal(p, q) for p, q in zip(before, batches.fields.parameters(), strict=True))


@pytest.mark.nightly
@pytest.mark.parametrize("way", WAYS)
def test_losses_and_gradients_are_unbiased(way):
    """Means over batches against a batch of many even states: all entries together, in units of their standard errors."""
    batches, phase = build(way)
    batches.draw(phase)
    batches.draw(phase)
    batches.sampler.every = 10**9
    boxes = batches.sampler.boxes
    assert len(boxes.leaves) > 1
    assert float(boxes.weight[boxes.leaves].max()) <= 2.0 + 1e-12
    sets = [gradients(batches, batches.draw(phase), phase) for _ in range(60)]
    batches.objective.density_batch = None
    exact = gradients(
        batches, batches.problem.samples(scrambled_sobol(2**15, batches.problem.dim, 9, torch.float64)), phase
    )
    for player, truth in exact.items():
        drawn = torch.stack([s[player] for s in sets])
        error = (drawn.mean(dim=0) - truth).norm()
        expected = (drawn.var(dim=0).sum() / len(sets)).sqrt()
        assert float(error) < 3.0 * float(expected) + 1e-3 * float(truth.norm())


@pytest.mark.nightly
def test_visited_states_keep_their_part():
    batches, phase = build("dual, drift", visited=0.25)
    means = []
    for _ in range(60):
        samples = batches.draw(phase)
        means.append(samples.mean(samples.f))
    assert int((samples.weight == 0.0).sum()) == 64
    assert float(samples.penalty_weight.max()) <= 2.0 + 1e-12
    means, states = torch.stack(means), scrambled_sobol(2**14, 2, 9, torch.float64)
    truth = float(batches.problem.state_cost(states).mean())
    assert abs(float(means.mean()) - truth) < 4.0 * float(means.std()) / 60**0.5 + 1e-3 * truth


def test_fields_that_are_not_finite_leave_the_density_uniform():
    batches, phase = build("dual")
    with torch.no_grad():
        next(batches.fields.parameters()).fill_(float("nan"))
    for _ in range(3):
        assert bool((batches.draw(phase).weight == 1.0).all())
