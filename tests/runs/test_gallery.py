"""The gallery: what it says of each system, what goes on, and what it refuses."""

import base64
import json
import re

import pytest
import yaml

from ocp_torch.cli.commands import gallery
from ocp_torch.cli.compose import composed, register_resolvers
from ocp_torch.errors import InputError
from ocp_torch.runs.canvas import blank_figure
from ocp_torch.runs.report.bracket import bracket
from ocp_torch.runs.report.gallery import SECONDS, picture
from ocp_torch.runs.report.lead import lead
from ocp_torch.runs.report.page import text
from ocp_torch.runs.report.sections import FIGURES
from support.forked import TINY, certificate_in, script

pytestmark = pytest.mark.usefixtures("cheap_looks")
register_resolvers()
QUICK = {name: yaml.safe_load(value) for name, value in (o.split("=") for o in TINY[1:])}
QUICK |= {"trainer.steps": 10, "trainer.figures": True}
OWN = {
    "circle": {"problem": {"noise": 0.01}, "method.occupation_bound": 9},  # with it no V is trained for a bound without
    "torus": {"optimizer": "sgd", "optimizer.lr": 1e6, "trainer.dtype": "float32"},
}
SYSTEMS = ["torus", "circle"]


def asked(folder, systems=SYSTEMS, common=QUICK, overrides=OWN) -> dict:
    own = {name: given for name, given in overrides.items() if name in systems}
    return {"systems": list(systems), "common": dict(common), "overrides": own, "folder": str(folder)}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A gallery of which one system fails, and what it ended with."""
    folder = tmp_path_factory.mktemp("gallery") / "of mine"
    systems = gallery.planned(asked(folder))
    assert not folder.exists()
    folder.mkdir()
    with pytest.raises(InputError) as error:
        gallery.shown_all(systems, folder)
    return folder, str(error.value)


def cards(folder) -> dict[str, str]:
    html = (folder / "gallery.html").read_text()
    parts = html.split("\n<div id=")
    return {part.split('"')[1]: part for part in parts[1:]}


def require_whole(folder, name: str, figure: str) -> None:
    """The card of ``name`` has all that its run gave, with ``figure`` as the picture."""
    card, certificate = cards(folder)[name], certificate_in(folder / name)
    drawn = base64.b64encode((folder / name / "figures" / f"{figure}.png").read_bytes()).decode()
    assert f"data:image/png;base64,{drawn}" in card
    assert bracket(certificate) in card
    assert text(lead(certificate)) in card
    assert f'href="{name}/report.html"' in card
    assert f"{json.loads((folder / SECONDS).read_text())[name]:,.0f} s for training" in card


def test_a_card_has_picture_bracket_sentence_seconds_and_a_link_to_the_report(made):
    folder, _ = made
    assert list(cards(folder)) == SYSTEMS
    require_whole(folder, "circle", "value")
    assert "The paper&#x27;s example" in cards(folder)["circle"]


def test_the_picture_is_of_the_motion_where_there_is_one(tmp_path):
    (tmp_path / "figures").mkdir()
    assert picture(tmp_path) == ""
    for name in ("slack", "value", "motion"):
        blank_figure(1.0, 1.0).savefig(tmp_path / "figures" / f"{name}.png")
        shown = [figure for figure in ("value", "motion") if FIGURES[figure] in picture(tmp_path)]
        assert shown == ([] if name == "slack" else [name])


@pytest.mark.nightly
def test_a_system_in_physical_units_has_its_card(tmp_path):
    own = {"pendulum": {"problem.torque_noise": 0.3, "method.occupation_bound": 50}}
    gallery.shown_all(gallery.planned(asked(tmp_path, ["pendulum"], overrides=own)), tmp_path)
    require_whole(tmp_path, "pendulum", "motion")
    assert "Swing up a pendulum" in cards(tmp_path)["pendulum"]
    assert "problem=pendulum problem.torque_noise=0.3" in cards(tmp_path)["pendulum"]


def test_its_command_trains_the_same_run(made):
    folder, _ = made
    (command,) = re.findall("<pre>(.*)</pre>", cards(folder)["circle"])
    python, train, *overrides = command.split(" ")
    assert (python, train) == ("python", "scripts/train.py")
    run = yaml.safe_load((folder / "circle" / ".hydra" / "config.yaml").read_text())
    assert composed("train", overrides) == run


def test_the_page_needs_nothing_else(made):
    html = (made[0] / "gallery.html").read_text()
    assert "http" not in html
    assert not re.search(r"<script|<link|@import|url\(|srcset", html)
    assert all(source.startswith("data:image/png;base64,") for source in re.findall(r'src="([^"]*)"', html))
    assert "prefers-color-scheme: dark" in html
    for link in re.findall(r'href="([^"]*)"', html):
        assert link.removeprefix("#") in SYSTEMS or (made[0] / link).is_file()


def test_a_system_that_fails_is_told_and_the_others_go_on(made):
    folder, error = made
    assert "1 of 2 systems failed: torus;" in error
    card = cards(folder)["torus"]
    assert "It failed: Training stopped at step" in card
    assert "problem=torus optimizer=sgd optimizer.lr=1000000.0" in card
    assert "<img" not in card


def test_what_is_finished_is_not_trained_again(made, monkeypatch):
    folder, _ = made
    before = certificate_in(folder / "circle"), json.loads((folder / SECONDS).read_text())
    with monkeypatch.context() as patch:
        patch.setattr("ocp_torch.cli.python.ending", None)
        gallery.shown_all(gallery.planned(asked(folder, ["circle"])), folder)
    assert (certificate_in(folder / "circle"), json.loads((folder / SECONDS).read_text())) == before
    require_whole(folder, "circle", "value")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"systems": ["circel"]}, ("'circel'", "did you mean 'circle'")),
        ({"systems": "circle"}, ("systems is 'circle'", "list")),
        ({"systems": []}, ("systems is []",)),
        ({"systems": ["circle", "circle"]}, ("different",)),
        ({"systems": ["circle", "dataset"]}, ("dataset: problem.path is missing",)),
        ({"overrides": {"circel": {}}}, ("overrides", "'circel'")),
        ({"overrides": {"circle": {"problem.nose": 1}}}, ("circle: problem.nose", "did you mean 'problem.noise'")),
        ({"overrides": {"torus": {"problem.dim": 3}}}, ("overrides.torus is set", "not in systems, ['circle']")),
        ({"overrides": {"arm": {"problem": {"joint_noise": 0.6}}}}, ("overrides.arm is set", "not in systems")),
        ({"overrides": {"circle": {"problem": "torus"}}}, ("overrides.circle.problem is set",)),
        ({"common": {"resume": "auto"}}, ("common.resume is set",)),
        ({"common": {"trainer": {"batch": 0}}}, ("circle: trainer.batch is 0",)),
        ({"common": 3}, ("common is 3",)),
        ({"folder": "/dev/null/x"}, ("folder", "/dev/null/x")),
    ],
)
def test_a_mistake_is_refused_in_a_sentence(changes, words, tmp_path):
    data = asked(tmp_path / "new", ["circle"]) | changes
    with pytest.raises(InputError) as error:
        gallery.planned(data)
    assert all(word in str(error.value) for word in words), error.value
    assert list(tmp_path.iterdir()) == []


def test_seconds_that_are_damaged_are_refused(tmp_path):
    (tmp_path / SECONDS).write_text('{"circle": "long"}')
    with pytest.raises(InputError, match=r"seconds\.json"):
        gallery.planned(asked(tmp_path, ["circle"]))


def test_a_field_of_all_wins_and_one_that_is_null_is_left_as_it_is(tmp_path):
    common, own = {"method": "dual", "seed": None}, {"circle": {"method": "pd", "seed": 3}}
    (circle,) = gallery.planned(asked(tmp_path, ["circle"], common, own))
    assert circle.command == "python scripts/train.py problem=circle method=dual seed=3"


def test_what_the_file_itself_sets_for_a_system_that_is_not_shown_is_no_mistake(tmp_path):
    usual = composed("gallery", [])["overrides"]
    asking = {**asked(tmp_path, ["circle"]), "overrides": usual}
    assert "pendulum" in usual
    assert [system.name for system in gallery.planned(asking)] == ["circle"]


def test_from_the_command_line_a_mistake_leaves_nothing(tmp_path):
    ended = script("gallery", "systems=[circel]", f"folder={tmp_path / 'new'}", cwd=tmp_path)
    assert ended.returncode == 2
    assert "did you mean 'circle'" in ended.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly
def test_from_the_command_line_and_again_with_one_more(tmp_path):
    few = [f"+common.{o}" for o in TINY[1:] if not o.startswith("trainer.figures")]
    for systems in (["circle"], ["circle", "torus"]):
        ended = script("gallery", f"systems=[{','.join(systems)}]", *few, f"folder={tmp_path / 'new'}", cwd=tmp_path)
        assert ended.returncode == 0, ended.stderr
        assert list(cards(tmp_path / "new")) == systems
    left = {path.name for path in (tmp_path / "new").iterdir()}
    assert left == {*systems, "gallery.html", "gallery.log", SECONDS}
