"""What a certificate assumes, notices and reports; and that the Lagrangian bound is second-order in the errors."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from ocp_torch.certificate import Run, Trained, certify_fields
from ocp_torch.certificate.checks.assumptions import occupation_holds
from ocp_torch.certificate.statistics.estimate import replicated_samples
from ocp_torch.certificate.upper.lagrangian import closed_loop_bounds
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.problems import Circle, Manufactured
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import ESTIMATED, FROM_DENSITY, resolve_constants
from ocp_torch.problems.needs import GUESSED, SEARCHED
from ocp_torch.problems.samples import Samples
from ocp_torch.runs.build import build_trainer
from ocp_torch.training.monitor import Observer
from support import zoo
from support.formulas import Field
from support.honesty import BARE
from support.small import configured

pytestmark = pytest.mark.usefixtures("quick_composition")

CHEAP = replace(BARE, replicates=2, ascents=4, occupation_states=36, mollify=False, tolerance=5e-5)


def certificate_of(problem, constants=None, settings=CHEAP):
    trained = Trained(Fields({"value": Field(problem.exact_value)}), None, partial(PeriodicMLP, width=8, depth=1))
    return certify_fields(problem, trained, constants or resolve_constants(problem), settings, Run("test", "dual"))


@pytest.mark.nightly
@zoo.on(["manufactured 1-d q=2", "manufactured 2-d q=1.5"])
def test_the_lagrangian_bound_is_second_order_where_J_is_first(problem):
    bump_V, bump_mu = (zoo.rough_network(problem.dim, seed, size=1.0) for seed in (1, 2))

    def excess(eps):
        value = lambda x: problem.exact_value(x) + eps * bump_V(x)
        loop = ClosedLoop(problem, ValuePolicy(problem, value))
        log_mu = lambda x: problem.exact_occupation(x).log() + eps * bump_mu(x)
        samples = replicated_samples(problem, 2**12, 2, 0, divergences=False)
        found = closed_loop_bounds(loop, value, log_mu, [Samples.of(loop, s.x) for s in samples], 16, "value")
        return found.lagrangian.value - problem.exact_optimum, found.J.value - problem.exact_optimum

    (large, J_large), (small, J_small) = excess(2e-2), excess(1e-2)
    assert 3.2 < large / small < 5.0
    assert 1.6 < J_large / J_small < 2.6
    assert 0.0 < small < J_small


@pytest.mark.nightly
def test_an_M_below_sup_mu_is_noticed_and_its_bound_left_out():
    problem = Manufactured(dim=1)
    certificate = certificate_of(problem, resolve_constants(problem, occupation_bound=0.5 * problem.occupation_bound))
    assert certificate.lower["F_M"].value > 0
    assert certificate.gap["lower_from"] == "shifted"
    assert not certificate.assumptions.hold
    assert any("F_M is not used" in warning for warning in certificate.warnings)


def test_an_unbounded_occupation_density_is_noticed():
    certificate = certificate_of(Circle(discount=0.8))
    assert certificate.gap["lower_from"] == "shifted"
    assert not certificate.counts("F_M")
    assert any("unbounded" in warning for warning in certificate.warnings)


class Anonymous(Manufactured):
    """The same problem by somebody who knows none of its bounds."""

    def __init__(self, **options):
        super().__init__(**options)
        self.occupation_bound = self.control_bound = self.value_bound = self.state_cost_bound = None


def test_what_nobody_knows_is_estimated_with_a_warning():
    constants = resolve_constants(Anonymous(dim=1, contrast=0.9, seed=3))
    assert set(constants.sources.values()) == {ESTIMATED}
    assert len(constants.warnings) == 3
    assert constants.C_V >= Manufactured(dim=1, contrast=0.9, seed=3).value_bound * 0.9
    assert (constants.basis("M"), constants.basis("C_V")) == (GUESSED, SEARCHED)


@pytest.mark.nightly
def test_a_guessed_M_makes_a_conditional_bound_that_enters_nothing_else():
    problem = Anonymous(dim=1, contrast=0.9, seed=3)
    certificate = certificate_of(problem)
    assert certificate.gap["lower_from"] == "shifted"
    assert certificate.hold
    said = certificate.to_dict()
    assert said["lower"]["F_M"] | {"rests_on": {"M": "guessed"}, "counts": False} == said["lower"]["F_M"]
    assert said["lower"]["F_M"]["if"] == f"sup mu* <= {certificate.assumptions.M:.4g} ({FROM_DENSITY})"
    assert said["lower"]["shifted"]["counts"]
    # It is shown where it says more than what counts (see test_conditional.py).
    more = said["lower"]["F_M"]["interval"][0] > said["lower"]["shifted"]["interval"][0]
    assert (said["gap"]["conditional"] is not None) == more
    assert any("a guess: no gap that counts uses it" in warning for warning in said["warnings"])


@pytest.mark.nightly
def test_a_guess_that_the_controller_s_density_refutes_makes_no_bound_at_all():
    problem = Anonymous(dim=1, contrast=0.9, seed=3)
    certificate = certificate_of(problem, replace(resolve_constants(problem), M=1.1))
    assert certificate.assumptions.estimated_sup_occupation == pytest.approx(1.9, rel=0.05)
    assert certificate.gap["conditional"] is None
    assert certificate.gap["lower_from"] == "shifted"


@pytest.mark.nightly
@pytest.mark.parametrize("basis", ["given", "guessed"])
def test_an_M_that_was_held_against_nothing_makes_nothing_count(basis):
    problem = Anonymous(dim=1)
    given = 10.0 if basis == "given" else None
    constants = resolve_constants(problem, occupation_bound=given)
    blind = replace(CHEAP, occupation_states=0)
    assert not certificate_of(problem, constants, blind).counts("F_M")
    assert certificate_of(problem, constants).counts("F_M") == (basis == "given")


@pytest.mark.parametrize(("times", "believed"), [(0.97, False), (1.0, False), (1.05, False), (1.2, True), (5.0, True)])
@pytest.mark.parametrize("reached", [1.01, 1.9, 40.0])
def test_an_M_that_the_density_comes_close_to_is_not_believed(reached, times, believed):
    """Trained with an `M` that is too small, a controller keeps its density just below it."""
    problem = Anonymous(dim=1)
    constants = resolve_constants(problem, times * reached, value_bound=1.0, control_bound=1.0)
    assert occupation_holds(problem, constants, reached)[0] is believed


def rounds_of(*overrides: str):
    trainer = build_trainer(
        configured("experiment=debug", "problem=circle", "method=dual", "trainer.steps=8", *overrides)
    )
    trainer.fit(Observer())
    return trainer


@pytest.mark.nightly
def test_another_round_twice_as_long_starts_only_while_the_gap_is_not_good():
    assert rounds_of().step == 8
    assert rounds_of("trainer.rounds=2", "trainer.good_gap=1e9").step == 8
    longer = rounds_of("trainer.rounds=2", "trainer.good_gap=1e-9")
    assert (longer.step, longer.state.round) == (24, 1)


@pytest.mark.nightly
def test_a_run_in_its_second_round_resumes_bitwise(tmp_path):
    overrides = ("trainer.rounds=2", "trainer.good_gap=1e-9", "trainer.checkpoint_every=13")
    whole = rounds_of(*overrides)
    stopped = build_trainer(
        configured("experiment=debug", "problem=circle", "method=dual", "trainer.steps=8", *overrides)
    )
    saved = tmp_path / "last.pt"

    class StopAt13(Observer):
        def stepped(self, trainer, report, log):
            if trainer.step == 14:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped.fit(StopAt13(), saved)
    resumed = build_trainer(
        configured("experiment=debug", "problem=circle", "method=dual", "trainer.steps=8", *overrides)
    )
    resumed.resume(saved)
    assert (resumed.step, resumed.state.round) == (13, 1)
    resumed.fit(Observer())
    for left, right in zip(whole.averaged_fields.parameters(), resumed.averaged_fields.parameters(), strict=True):
        assert torch.equal(left, right)
