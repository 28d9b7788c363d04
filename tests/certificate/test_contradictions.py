"""Bounds that exclude each other: nothing counts then, and a guess that is refuted is dropped alone."""

from dataclasses import replace

import pytest

from ocp_torch.certificate import Run
from ocp_torch.certificate.certify import examined
from ocp_torch.certificate.report import table
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.runs.compare import compare
from support.looks import LOWER, certificate

RUN = Run("circle", "dual")


def with_errors(lower: Estimate, perf: Estimate, basis: str = "given", perf_lower=None):
    plain = certificate(RUN, 0.1)
    assumptions = replace(plain.assumptions, basis={"M": basis})
    shifted = Estimate(0.5 * LOWER, 0.0)
    return examined(
        replace(
            plain,
            lower={"F_M": lower, "shifted": shifted},
            perf={"value": perf, "density": None},
            perf_lower=perf_lower or {},
            assumptions=assumptions,
        )
    )


def test_a_lower_bound_above_a_performance_makes_nothing_count():
    found = with_errors(Estimate(LOWER, 1e-4, replicates=8), Estimate(0.9 * LOWER, 1e-4, 1e-4, replicates=8))
    assert "F_M" in found.contradiction
    assert "Perf (value)" in found.contradiction
    assert "sup mu*" in found.contradiction
    assert (found.best_lower, found.best_upper, found.best_perf, found.plain_gap) == (None, None, None, None)
    assert not any(found.counts(name) for name in ("F_M", "shifted", "J"))
    assert found.share == {"certified": None, "simulated": None}
    assert found.suboptimality["at_most"] is None
    assert not found.hold
    assert "nothing is certified" in table(found.to_dict())
    assert "gap, " not in table(found.to_dict())
    assert "sure" not in table(found.to_dict())
    assert found.controller == "value"  # which it is of, all the same


def test_within_their_errors_bounds_may_cross_but_then_there_is_no_gap():
    """A bound 2 % above the other, with errors of 0.4 %: intervals at 95 % are apart, at the joint level they are not."""
    low, high = Estimate(LOWER, 4e-3 * LOWER, replicates=8), Estimate(0.98 * LOWER, 1e-3 * LOWER, 0.0, replicates=8)
    found = with_errors(low, high)
    assert found.contradiction is None
    assert found.counts("F_M")
    assert (found.best_lower[0], found.gap["simulated"]) == ("F_M", None)
    assert with_errors(replace(low, se=5e-4 * LOWER), high).contradiction is not None


@pytest.mark.parametrize("exact", [0.9 * LOWER, 1.2 * LOWER])
def test_an_optimum_that_a_bound_excludes_is_a_contradiction(exact):
    plain = replace(certificate(RUN, 0.1), exact=exact)
    assert "OPT" in examined(plain).contradiction
    assert examined(replace(plain, exact=1.05 * LOWER)).contradiction is None


def test_doing_nothing_cannot_be_better_than_a_lower_bound():
    assert "zero" in certificate(RUN, 0.1, zero=0.5 * LOWER).contradiction


def test_a_bound_on_a_performance_from_below_is_held_against_what_was_simulated_of_it():
    found = lambda least: with_errors(Estimate(0.5 * LOWER, 0.0), Estimate(LOWER, 0.0, 0.0), perf_lower=least)
    assert found({"evaluation": Estimate(0.9 * LOWER, 0.0)}).contradiction is None
    wrong = found({"evaluation": Estimate(1.1 * LOWER, 0.0)})
    assert "evaluation" in wrong.contradiction
    assert "Perf (value)" in wrong.contradiction


def test_a_guess_that_is_refuted_is_dropped_and_the_rest_stands():
    found = with_errors(Estimate(2.0 * LOWER, 0.0), Estimate(LOWER, 0.0, 0.0), basis="guessed")
    assert found.contradiction is None
    assert found.gap["conditional"] is None
    assert found.best_lower[0] == "shifted"
    assert any("it is not so that sup mu* <= 1" in warning for warning in found.warnings)
    kept = with_errors(Estimate(0.9 * LOWER, 0.0), Estimate(LOWER, 0.0, 0.0), basis="guessed")
    assert kept.gap["conditional"] == pytest.approx(1.0 / 0.9 - 1.0)
    assert kept.gap["simulated"] == pytest.approx(1.0)


def test_gaps_lie_between_the_far_ends_of_intervals_by_the_quantile_that_is_used():
    low, high = Estimate(LOWER, 1e-4, replicates=4), Estimate(1.1 * LOWER, 2e-4, 1e-4, replicates=8)
    found = with_errors(low, high)
    t3, t7 = 3.182446, 2.364624  # 97.5 % quantiles of Student's t with 3 and 7 degrees of freedom
    under, over = LOWER - t3 * 1e-4, 1.1 * LOWER + t7 * 2e-4 + 1e-4
    assert found.gap["simulated"] == pytest.approx(over / under - 1.0, rel=1e-6)
    assert found.plain_gap == pytest.approx(0.1)
    assert found.to_dict()["lower"]["F_M"]["half_width"] == pytest.approx(t3 * 1e-4, rel=1e-6)


def test_the_sentence_names_what_it_takes():
    words = lambda found: next(line for line in table(found.to_dict()).splitlines() if "sure" in line)
    errors = Estimate(LOWER, 1e-5, replicates=8), Estimate(1.1 * LOWER, 1e-5, 1e-5, replicates=8)
    assert "taking sup mu* <= 1, as given" in words(with_errors(*errors))
    assert "taking sup Q is what the search found" in words(with_errors(*errors, basis="guessed"))


def test_no_list_ranks_a_contradiction(tmp_path):
    for name, gap in (("good", 0.1), ("contradictory", -0.2)):
        (tmp_path / name).mkdir()
        certificate(RUN, gap).save(tmp_path / name / "certificate.json")
    rows = compare([tmp_path]).rows
    assert [row["run"] for row in rows] == ["good", "contradictory"]
    assert rows[1]["gap_simulated"] is None
