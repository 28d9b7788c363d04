"""What a loss knows of time is in the phase it is given: an objective has no clock, and a run leaves it as it was."""

import copy
from dataclasses import FrozenInstanceError, replace

import pytest
import torch

from ocp_torch.objectives import Phase
from ocp_torch.problems.samples import Samples
from ocp_torch.training.monitor import Observer
from support.bits import differences
from support.small import METHODS, small

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")

# With and without a known M, and with drift; the density player of pd moves from 0.6 on.
PROBLEMS = (("problem=circle",), ("problem=arm",), ("problem=manufactured", "problem.dim=2"))


def plain(value):
    """What can be compared of an attribute of an objective."""
    return {k: plain(v) for k, v in vars(value).items()} if hasattr(value, "__dict__") else copy.deepcopy(value)


@pytest.mark.parametrize("problem", PROBLEMS, ids=" ".join)
@pytest.mark.parametrize("method", METHODS)
def test_the_same_phase_gives_the_same_losses_whatever_was_asked_in_between(method, problem):
    if method == "primal, mu closed" and problem != PROBLEMS[0]:
        return
    trainer = small(*METHODS[method], *problem)
    objective, constants = trainer.objective, trainer.constants
    x = torch.rand(32, trainer.problem.dim, generator=torch.Generator().manual_seed(0))
    samples = Samples.of(trainer.problem, x)
    phases = [Phase(constants, progress) for progress in (0.0, 0.3, 0.6, 1.0)]
    phases.append(Phase(replace(constants, M=2.0 * constants.M, C_V=2.0 * constants.C_V)))
    asked = lambda: [(objective.losses(trainer.fields, samples, p), objective.needs_divergences(p)) for p in phases]
    first = asked()
    assert differences(first, asked()) == []
    assert differences(list(reversed(first)), [*map(tuple, reversed(asked()))]) == []
    assert first[-1][0].keys() == set(objective.players)
    with pytest.raises(FrozenInstanceError):
        phases[0].progress = 1.0


@pytest.mark.parametrize("method", METHODS)
def test_a_run_changes_nothing_of_its_objective(method):
    trainer = small(*METHODS[method], "trainer.steps=10", "trainer.rounds=2")
    trainer.evaluator.reaches = lambda gap, run: False  # its controllers after a few steps take long to simulate
    before = plain(trainer.objective)
    trainer.fit(Observer())
    assert plain(trainer.objective) == before
    assert not any(isinstance(value, Phase) for value in before.values())


@pytest.mark.parametrize("delay", [0.0, 0.5, 0.6, 1.0])
def test_rounds_are_counted_as_a_loop_over_all_steps_counts_them(delay):
    settings, k, moves, begin = replace(small().settings, steps=7, rounds=3), 0, 0, 0
    for step in range(settings.end(2)):
        if step == settings.end(k):
            k, begin = k + 1, step
        assert settings.round_at(step) == k
        assert settings.part_done(step, k) == pytest.approx((step - begin) / (7 * 2**k))
        assert settings.moves(step, k, delay) == moves
        moves += settings.part_done(step, k) >= delay
    assert settings.round_at(settings.end(2)) == 2
