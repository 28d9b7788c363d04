"""The augmented saddle: the truth is an equilibrium, whatever the weights; and what is left where divergences are not."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import nn

from ocp_torch.errors import InputError
from ocp_torch.fields import Fields
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.objectives import Dual, Phase, primal, saddle
from ocp_torch.objectives.saddle import AugmentedSaddle, Saddle
from ocp_torch.problems import Manufactured
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo
from support.exact import lattice

each_smooth = zoo.on(["manufactured 2-d mu0", "manufactured 1-d q=1.5", "manufactured 3-d m=2 B(x) q=1.5"])


class Function(nn.Module):
    """A field given by a formula, with a learnable multiple of a bump on top."""

    def __init__(self, formula, bump=None):
        super().__init__()
        self.formula, self.bump = formula, bump

    def forward(self, x):
        return self.formula(x) if self.bump is None else self.formula(x) + self.bump(x)


def rough(dim, seed, size, outputs, branch):
    return zoo.rough_network(dim, seed + branch, outputs, size)


def exact_fields(problem, **bumps) -> Fields:
    truth = {
        "value": problem.exact_value,
        "control_density": lambda x: problem.exact_occupation(x).unsqueeze(-1) * problem.exact_control(x),
        "log_occupation": lambda x: problem.exact_occupation(x).log(),
    }
    return Fields({name: Function(formula, bumps.get(name)) for name, formula in truth.items()})


@pytest.mark.nightly
@each_smooth
@pytest.mark.parametrize("coupling", [0.0, 1.0])
def test_no_player_gains_by_leaving_the_truth(problem, coupling):
    objective = saddle(problem, augmentation=0.5, coupling=coupling, warm_start=0.0)
    phase = Phase(resolve_constants(problem))
    samples = Samples.of(problem, scrambled_sobol(2**13, problem.dim, 3, torch.float64))
    at_truth = {k: float(v) for k, v in objective.losses(exact_fields(problem), samples, phase).items()}
    for seed in range(6):
        for size in (0.003, 0.1):
            bump = partial(rough, problem.dim, seed, size)
            away = objective.losses(exact_fields(problem, value=bump(None, 0)), samples, phase)
            assert float(away["value"]) > at_truth["value"] - 1e-5
            moved = exact_fields(problem, control_density=bump(problem.control_dim, 10), log_occupation=bump(None, 20))
            assert float(objective.losses(moved, samples, phase)["density"]) > at_truth["density"] - 1e-5


@each_smooth
def test_the_losses_at_the_truth_are_the_optimum(problem):
    objective = saddle(problem, augmentation=0.5, coupling=1.0, residual=7.0)
    phase = Phase(resolve_constants(problem))
    # The Lagrangian is 0 for either player there: what the other one pays is left out of its loss.
    samples = Samples.of(problem, scrambled_sobol(2**14, problem.dim, 3, torch.float64))
    losses = objective.losses(exact_fields(problem), samples, phase)
    assert float(losses["value"]) == pytest.approx(-0.5 * problem.exact_optimum, rel=1e-4)
    assert float(losses["density"]) == pytest.approx(0.5 * problem.exact_optimum, rel=1e-4)


def test_a_value_that_is_no_subsolution_leaves_the_density_player_bounded():
    """Against `V` above `f` the plain Lagrangian falls without end as `mu` grows; the clipped one must not."""
    problem = Manufactured(dim=2)
    objective = saddle(problem, warm_start=0.0)
    phase = Phase(resolve_constants(problem))
    samples = Samples.of(problem, scrambled_sobol(1024, 2, 3, torch.float64))
    high = lambda x: torch.full_like(x[:, 0], 50.0)
    losses = []
    for c in (0.0, 3.0, 6.0):
        fields = exact_fields(problem, value=high, log_occupation=lambda x, c=c: c + 0 * x[:, 0])
        losses.append(float(objective.losses(fields, samples, phase)["density"]))
    assert losses[0] < losses[1] < losses[2]


def test_the_density_player_rests_during_the_warm_start_and_asks_for_no_divergences():
    problem = Manufactured(dim=1)
    objective = saddle(problem, warm_start=0.5)
    before, after = (Phase(resolve_constants(problem), progress) for progress in (0.49, 0.5))
    assert not objective.needs_divergences(before)
    samples = Samples.of(problem, scrambled_sobol(64, 1, 3, torch.float64), divergences=False)
    assert set(objective.losses(exact_fields(problem), samples, before)) == {"value"}
    assert objective.needs_divergences(after)


def test_the_density_player_works_on_states_that_carry_weight_and_on_so_many_at_most():
    problem = Manufactured(dim=2)
    drawn, visited = (Samples.of(problem, scrambled_sobol(n, 2, n, torch.float64)) for n in (96, 32))
    both = [replace(drawn, weight=4 / 3 * drawn.weight), replace(visited, weight=torch.zeros_like(visited.weight))]
    batch = Samples.concatenate([replace(s, penalty_weight=torch.ones_like(s.f)) for s in both])
    fields = exact_fields(problem, value=lambda x: 0.1 * torch.sin(2 * math.pi * x[:, 0]))
    loss = lambda samples, most: saddle(problem, warm_start=0.0, density_batch=most).losses(
        fields, samples, Phase(resolve_constants(problem))
    )["density"]
    torch.testing.assert_close(loss(batch, None), loss(drawn, None))
    torch.testing.assert_close(loss(batch, 40), loss(drawn.take(slice(40)), None))
    with pytest.raises(InputError, match="method.density_batch is 0"):
        loss(batch, 0)


@pytest.mark.parametrize("coupling", [0.5, 2.0])
def test_the_coupling_is_the_value_times_the_residual_it_is_the_multiplier_of(coupling):
    """By parts, on a grid that integrates smooth functions exactly: the value player earns `c E[V r]`."""
    problem = Manufactured(dim=2, initial_contrast=0.3)
    samples = Samples.of(problem, lattice(2))
    wave = lambda x: (2.0 * math.pi * (x[:, 0] - 2.0 * x[:, 1])).cos()
    V = lambda x: problem.exact_value(x) + 0.1 * wave(x)
    w, log_mu = lambda x: 0.2 * problem.exact_control(x), lambda x: 0.3 * wave(x)
    fields = Fields({"value": Function(V), "control_density": Function(w), "log_occupation": Function(log_mu)})
    generator = Generator.of(problem, samples)
    r = generator.control_inflow(w)[1] - generator.occupation_outflow(log_mu)[1]
    phase = Phase(resolve_constants(problem))
    loss = lambda c: saddle(problem, coupling=c, warm_start=0.0).losses(fields, samples, phase)
    earned = loss(0.0)["value"] - loss(coupling)["value"]
    assert abs(float((V(samples.x) * r).mean())) > 1e-3
    torch.testing.assert_close(earned, coupling * (V(samples.x) * r).mean(), rtol=1e-6, atol=1e-12)


class WithoutDivergences(Manufactured):
    def drift_divergence(self, x):
        return None


@each_smooth
@pytest.mark.parametrize("size", [0.0, 0.01, 0.3, 5.0])
@pytest.mark.parametrize("augmentation", [0.5, 3.0])
def test_against_the_optimal_flux_no_value_is_worth_more_than_the_optimum(problem, size, augmentation):
    """Without divergences: `Psi(V; w*) + k F_M(V) <= (1 + k) OPT` for every `V`, and `V*` attains it. On a grid, exactly."""
    objective = Saddle(problem, augmentation)
    samples, phase = Samples.of(problem, lattice(problem.dim)), Phase(resolve_constants(problem))
    wave = lambda x: size * (2.0 * math.pi * x.sum(dim=-1)).sin()
    V = lambda x: problem.exact_value(x) + wave(x)
    loss = float(objective.losses(exact_fields(problem, value=wave), samples, phase)["value"])
    least = -(1.0 + augmentation) * problem.exact_optimum
    assert loss >= least - 1e-9
    if size == 0.0:
        assert loss == pytest.approx(least, rel=1e-6)
    alone = Fields({"value": Function(V)})
    F_M = -float(Dual(problem, residual=0.0).losses(alone, samples, phase)["value"])
    plain = float(Saddle(problem).losses(exact_fields(problem, value=wave), samples, phase)["value"])
    assert loss == pytest.approx(plain - augmentation * F_M, rel=1e-9)


def test_without_divergences_each_method_falls_back_to_what_needs_none_and_says_so():
    problem = WithoutDivergences(dim=2)
    for objective in (saddle(problem), primal(problem)):
        assert isinstance(objective, Saddle)
        assert not objective.needs_divergences(Phase(resolve_constants(problem)))
        assert "no divergences" in objective.notes[0]
    assert isinstance(saddle(Manufactured(dim=2)), AugmentedSaddle)
