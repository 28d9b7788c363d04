"""Where `mu*` is unbounded: what training aims at, and when it notices."""

import math
from dataclasses import replace
from functools import partial

import pytest

from ocp_torch.fields import VALUE, Fields, PeriodicMLP
from ocp_torch.maths.jets import jet
from ocp_torch.objectives import Dual, Phase
from ocp_torch.objectives.objective import LATER_RESIDUAL
from ocp_torch.problems import Arm, Circle, Torus
from ocp_torch.problems.constants import OCCUPATION_WEIGHT, resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.training.budgets import DENSITY_BATCH, fill
from ocp_torch.training.monitor import Observer
from support import zoo
from support.small import small


def test_which_problems_are_known_to_be_unbounded():
    """The torus contracts faster than it forgets from a small discount on."""
    assert resolve_constants(Arm()).unbounded
    assert resolve_constants(Arm()).M == OCCUPATION_WEIGHT
    assert resolve_constants(Torus(2, discount=0.5)).unbounded
    assert not resolve_constants(Torus(2)).unbounded
    assert not resolve_constants(Circle()).unbounded


def test_the_weight_of_the_slack_grows_along_a_round():
    """`loss = -E[V mu0] + M E[max(Q, 0)]`, so two values of the loss give the weight."""
    problem = zoo.build("arm n=2")
    constants = resolve_constants(problem)
    fields = Fields.build(problem, (VALUE,), partial(PeriodicMLP, width=16), 0).double()
    samples = Samples.of(problem, zoo.states(problem, 500), divergences=False)
    V = jet(fields.value, samples.x)
    slack = Generator.of(problem, samples).hjb_slack(V)
    violation, started = float(slack.clamp_min(0.0).mean()), float((V.value * samples.mu0).mean())
    weights = {}
    for unbounded in (True, False):
        objective = Dual(problem, residual=0.0)
        for progress in (0.0, 0.35, 0.7, 1.0):
            phase = Phase(replace(constants, unbounded=unbounded), progress)
            loss = float(objective.losses(fields, samples, phase)["value"])
            weights[unbounded, progress] = (loss + started) / violation
    M = constants.M
    for progress, expected in ((0.0, M / 20.0), (0.35, M / math.sqrt(20.0)), (0.7, M), (1.0, M)):
        assert weights[True, progress] == pytest.approx(expected, rel=1e-6)
        assert weights[False, progress] == pytest.approx(M, rel=1e-6)


@pytest.mark.parametrize("residual", [0.0, 0.3])
def test_the_squared_slack_weighs_more_once_a_round_is_over(residual):
    """Two losses, at the same states and weight of the hinge, differ by multiples of `residual / s E[Q^2]`; where `M` is
    known, and in the paper's dual, by nothing."""
    problem = zoo.build("arm n=2")
    constants = resolve_constants(problem)
    fields = Fields.build(problem, (VALUE,), partial(PeriodicMLP, width=16), 0).double()
    samples = Samples.of(problem, zoo.states(problem, 500), divergences=False)
    slack = Generator.of(problem, samples).hjb_slack(jet(fields.value, samples.x))
    square = residual / float(fields.value.scale) * float(slack.square().mean())
    for unbounded in (True, False):
        phase = Phase(replace(constants, unbounded=unbounded), 0.5)
        first, later = (
            float(Dual(problem, residual=residual).losses(fields, samples, replace(phase, later=later))["value"])
            for later in (False, True)
        )
        assert later - first == pytest.approx((LATER_RESIDUAL - 1.0) * square if unbounded else 0.0, abs=1e-9)
        assert (phase.form == replace(phase, later=True).form) is not unbounded  # a replay of one is none of the other


def test_a_run_tells_its_losses_that_a_round_is_over():
    trainer = small("problem=arm", "method=dual", "trainer.steps=2", "trainer.rounds=2")
    trainer.evaluator.reaches = lambda gap, run: False
    seen, ask = [], trainer.objective.losses
    trainer.objective.losses = lambda fields, samples, phase: seen.append(phase.later) or ask(fields, samples, phase)
    trainer.fit(Observer())
    assert seen == [False] * 2 + [True] * 4


def test_the_worst_state_wants_a_smooth_network():
    """Without products in any dimension, with or without noise, and waves for each pair of coordinates but hardly more;
    averages of smooth problems in many dimensions want products."""
    for dim in (1, 2, 3, 5, 8, 16):
        for noisy in (False, True):
            sizes = PeriodicMLP.defaults(dim, worst_state=True, noisy=noisy)
            assert not sizes["gated"]
            assert sizes["activation"] == "silu"
            assert math.comb(dim, 2) <= sizes["waves"] <= 128
    assert PeriodicMLP.defaults(5)["gated"]


def test_default_sizes_follow():
    defaults = lambda problem: fill(
        {"model": {"name": "mlp"}, "trainer": {}, "optimizer": {}, "certificate": {}}, problem
    )
    bounded, unbounded = defaults(Torus(2)), defaults(Arm())
    assert unbounded["trainer"]["batch"] > bounded["trainer"]["batch"]
    assert unbounded["model"]["waves"] > bounded["model"]["waves"]


def test_the_larger_batch_is_not_for_the_density_player_unless_the_user_chose_it():
    config = {"model": {"name": "mlp"}, "optimizer": {}, "certificate": {}, "method": {"name": "pd"}}
    given = lambda problem, trainer: fill({**config, "trainer": trainer}, problem)["method"].get("density_batch")
    assert given(Arm(), {}) == DENSITY_BATCH
    assert given(Arm(), {"batch": 4096}) is None
    assert given(Torus(2), {}) is None
