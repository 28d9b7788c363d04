"""Which controller is handed out: of the lowest simulated performance, or of the lowest bound without simulation."""

from dataclasses import replace

import pytest
import torch

from ocp_torch import load_controller
from ocp_torch.certificate.statistics.estimate import known_of
from ocp_torch.control.policies import density_policy, occupation_density
from ocp_torch.runs.evaluate import certify_saved
from support.controllers import controllers
from support.honesty import BARE
from support.small import outcome, session, small
from support.zoo import states

SMALL = (
    "problem=circle",
    "method=pd",
    "method.value_bound=0.4",
    "trainer.steps=150",
    "certificate.trajectories=16",
    "certificate.points=512",
)


@pytest.mark.nightly
def test_of_the_lowest_bound(tmp_path):
    """Without a fitted density `G` alone bounds what a controller costs: that of `w` over the `mu` of Lemma 2."""
    trainer = small(*SMALL, "certificate.prefer=certified", "certificate.stage.steps=0")
    certificate = session(trainer, tmp_path)
    assert certificate.controller == certificate.subject == certificate.best_certified == "minimised"
    assert certificate.best_upper[0] == "G"
    assert not any(warning.startswith("G bounds OPT, but") for warning in certificate.warnings)
    controller, x = load_controller(tmp_path), states(trainer.problem, 64)
    assert controller.kind == "minimised"
    fields = controller.fields.double()
    mu = occupation_density("closed", trainer.problem, fields, controller.constants)
    expected = density_policy(lambda x: (fields.control_density(x), mu(x)), trainer.problem.control_cost)(x)
    torch.testing.assert_close(controller(x), expected, rtol=1e-5, atol=1e-6)
    perf, G = certificate.perf["minimised"], certificate.upper["G"]
    assert perf.interval(0.999)[0] <= G.interval(0.999)[1]
    assert perf.value == pytest.approx(G.value, rel=0.2)


@pytest.mark.nightly
@pytest.mark.parametrize("prefer", ["simulated", "certified"])
@pytest.mark.parametrize("kind", ["value", "density", "minimised"])
def test_what_was_handed_out_is_certified_again(kind, prefer):
    """`evaluate.py` certifies the controller in the file, also where another one of its fields would be chosen today."""
    controller = controllers("pd plain")[0]
    saved = replace(controller, kind=kind, certificate={"problem": "circle", "method": "pd"})
    certificate = certify_saved(
        saved, replace(BARE, points=64, replicates=2, trajectories=4, tolerance=0.3, prefer=prefer)
    )
    assert certificate.controller == certificate.subject == kind


@pytest.mark.nightly
@pytest.mark.parametrize("prefer", ["simulated", "certified"])
def test_gaps_are_those_of_each_controller(tmp_path, prefer):
    certificate = session(small(*SMALL, f"certificate.prefer={prefer}"), tmp_path)
    assert ("minimised" in certificate.perf) == (prefer == "certified")
    perfs = {name: perf.interval(certificate.confidence)[1] for name, perf in known_of(certificate.perf).items()}
    gaps = certificate.gap["certified_of"]
    assert gaps.keys() == perfs.keys()
    known = {name: gap for name, gap in gaps.items() if gap is not None}
    assert certificate.gap["certified"] == gaps[certificate.controller]
    if prefer == "simulated":
        assert perfs[certificate.controller] == min(perfs.values())
    elif known:
        assert gaps[certificate.controller] == min(known.values())
    for name, estimate in known_of(certificate.upper).items():
        about = certificate.about[name]
        if about is not None and certificate.counts(name):
            assert known_of(certificate.perf)[about].interval(0.999)[0] <= estimate.interval(0.999)[1]


def test_another_word_is_refused():
    assert "certificate.prefer" in outcome(*SMALL, "certificate.prefer=best")
