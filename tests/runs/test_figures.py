"""What the figures of a run show, and what they leave out."""

from dataclasses import replace

import pytest
import torch

from ocp_torch.certificate import Run
from ocp_torch.runs import finish
from ocp_torch.runs.figures import FieldFigures, interval_figure
from ocp_torch.runs.report.bracket import bracket
from support.looks import certificate
from support.small import session, small

pytestmark = pytest.mark.usefixtures("quick_composition")


def names(said: dict) -> set[str]:
    return {label.get_text() for label in interval_figure(said).axes[0].get_yticklabels()}


def test_a_bound_that_does_not_count_is_in_no_picture():
    said = certificate(Run("circle", "dual"), gap=0.1, certified=0.2).to_dict()
    assert {"F_M ≤ OPT", "≤ lagrangian"} <= names(said)
    assert "F_M ≤ OPT" in bracket(said)
    said["lower"]["F_M"]["counts"] = False
    assert "F_M ≤ OPT" not in names(said)
    assert "F_M ≤ OPT" not in bracket(said)
    # A guess may be right: the page shows it, as one that does not count.
    said["lower"]["F_M"]["if"] = "sup mu* <= 3"
    assert "F_M ≤ OPT" not in names(said)
    assert "F_M ≤ OPT" in bracket(said)


@pytest.mark.nightly
def test_the_density_drawn_is_that_fitted_to_the_controller_handed_out(tmp_path, monkeypatch):
    trainer, seen = small("method=pd", "certificate.stage.steps=10"), []
    drawn = FieldFigures.figures
    monkeypatch.setattr(
        finish, "FieldFigures", lambda *given, **named: seen.append(FieldFigures(*given, **named)) or seen[-1]
    )
    monkeypatch.setattr(FieldFigures, "figures", lambda shown: drawn(replace(shown, quick=True)))
    found = session(trainer, tmp_path)
    (last,) = (shown for shown in seen if not shown.quick)
    x = torch.linspace(0.0, 1.0, 50, dtype=torch.float64).unsqueeze(1)
    assert last.kind == found.controller
    assert found.occupation is not None
    torch.testing.assert_close(last.quantities()["occupation"]["learned"](x), found.occupation(x))
    players = replace(last, fitted=None).quantities()["occupation"]["learned"](x)
    assert not torch.allclose(players, found.occupation(x), rtol=1e-3)
