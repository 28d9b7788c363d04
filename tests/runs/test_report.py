"""The report of a run and the page of many: whole, self-contained, honest, and deaf to what strangers' names would do."""

import inspect
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from torch.utils.tensorboard import SummaryWriter

import ocp_torch
from ocp_torch import Angle, Interval, System
from ocp_torch.certificate import BOUNDS, Run
from ocp_torch.certificate.report import in_words
from ocp_torch.cli.compose import composed
from ocp_torch.errors import InputError
from ocp_torch.problems import Circle
from ocp_torch.runs import run as runs
from ocp_torch.runs.canvas import blank_figure
from ocp_torch.runs.compare import compare
from ocp_torch.runs.evaluate import load_run
from ocp_torch.runs.report import history, words
from ocp_torch.runs.report.advice import ADVICE, OTHERWISE, advice
from ocp_torch.runs.report.bracket import bracket
from ocp_torch.runs.report.many import save_page
from ocp_torch.runs.report.report import REPORT, write_report
from support.looks import certificate
from support.small import SMALL, configured

pytestmark = pytest.mark.usefixtures("quick_composition")

VOID = {"meta", "img", "br"}
TAGS = {
    *(
        "html head meta title style body main section h1 h2 h3 p dl dt dd div table thead tbody tr th td details summary"
    ).split(),
    *("pre code sub sup br span i a figure figcaption img svg rect line circle text polyline").split(),
}
EVIL = "<script>alert(1)</script><img src=x onerror=alert(2)>\"'&`</style>"


class Page(HTMLParser):
    """A page taken apart: every tag closed, in order; its tags, attributes, links and words."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html, self.open, self.tags, self.attributes = html, list[str](), set[str](), set[tuple[str, str]]()
        self.words, self.blocks = dict[str, list[str]](), list[str]()
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes |= {(name, value or "") for name, value in attrs}
        self.open += [] if tag in VOID else [tag]
        key = next((value for name, value in attrs if name == "class"), "") if tag == "p" else tag
        self.words.setdefault(key, []).append("")
        self.key = key

    def handle_startendtag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes |= {(name, value or "") for name, value in attrs}

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, (tag, self.getpos())

    def handle_data(self, data):
        if self.open:
            self.words[self.key][-1] += data

    @property
    def lead(self) -> str:
        (found,) = (said for kind, said in self.words.items() if kind.startswith("lead"))
        return found[0].strip()


def page(file: Path) -> Page:
    """The page in ``file``, which needs nothing else and does nothing."""
    found = Page(file.read_text())
    assert found.tags <= TAGS
    assert not [name for name, _ in found.attributes if name.startswith("on")]
    assert all(value.startswith("data:image/png;base64,") for name, value in found.attributes if name == "src")
    assert not {"srcset", "action", "xlink:href", "data"} & {name for name, _ in found.attributes}
    (style,) = found.words["style"]
    assert not re.search(r"@import|url\(|expression", style)
    assert "prefers-color-scheme: dark" in style
    drawn = " ".join(
        value for name, value in found.attributes if name in ("x", "y", "x1", "x2", "cx", "cy", "points", "width")
    )
    assert not re.search("nan|inf", drawn)
    return found


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "run"
    few = ("certificate.points=64", "certificate.trajectories=4", "certificate.ascents=1", "certificate.stage.steps=5")
    made = runs.training_run(configured(*SMALL, "problem=circle", "method=dual", "trainer.log_every=5", *few))
    folder.mkdir()
    runs.train(made, folder)
    return folder


def crafted(folder: Path, made, **changes) -> Path:
    """A folder with the certificate ``made``, some of its entries replaced."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "certificate.json").write_text(json.dumps(made.to_dict() | changes))
    return folder


def looked(folder: Path, made, **changes) -> Page:
    return page(write_report(crafted(folder, made, **changes), Circle(), {"problem": {}}))


def test_a_run_leaves_one_page_that_is_whole_and_needs_nothing_else(finished):
    folder = finished
    found = page(folder / REPORT)
    titles = found.words["h2"]
    wanted = ("problem", "bracket", "trust", "rests on", "Warnings", "V, u, mu", "curves", "go on", "Configuration")
    assert [w for w in wanted if not any(w in title for title in titles)] == []
    figures = [p for p in folder.glob("figures/*.png") if p.stem != "certificate"]
    assert len([1 for name, _ in found.attributes if name == "src"]) == len(figures) > 2
    assert {"The bracket closes: running estimates", "Losses", "Violations"} <= set(found.words["h3"])
    told = json.loads((folder / "certificate.json").read_text())
    assert all(found.html.count(advice(w)) or f"What to do: {advice(w)[:10]}" in found.html for w in told["warnings"])
    assert "batch: 16" in " ".join(found.words["pre"])


def test_its_first_sentence_is_that_of_the_certificate_and_true(finished):
    """On the circle OPT is known, and so is what the controller costs."""
    folder = finished
    told = json.loads((folder / "certificate.json").read_text())
    said, at_most = page(folder / REPORT).lead, told["suboptimality"]["at_most"]
    percent, times = re.search(r"at most ([\d.]+) %", said), re.search(r"cost ([\d,.]+) times", said)
    most = float(percent[1]) / 100.0 if percent else float(times[1].replace(",", "")) - 1.0
    assert most == pytest.approx(at_most, rel=5e-3, abs=0.1 if times else 0.0)
    assert (percent is None) == (at_most > 1.0)
    assert told["perf"][told["controller"]]["value"] <= told["exact"] * (1.0 + most)
    assert most >= 0.9 * told["gap"]["simulated"]


def test_the_band_of_the_bracket_holds_the_optimum_and_dots_stand_in_order(finished):
    folder = finished
    told = json.loads((folder / "certificate.json").read_text())
    drawn = bracket(told)
    number = lambda name, text: float(re.search(rf'{name}="([\d.]+)%"', text)[1])
    (band,) = re.findall("<rect.*?/>", drawn)
    (known,) = re.findall('<line class="known".*?/>', drawn)
    assert number("x", band) <= number("x1", known) <= number("x", band) + number("width", band)
    values = [e["value"] for side in ("lower", "perf", "upper", "baseline") for e in told[side].values() if e]
    arrows, dots = len(re.findall("[◂▸]", drawn)), re.findall("<circle.*?/>", drawn)
    assert arrows + len(dots) == len(values)
    places = [number("cx", dot) for dot in dots]
    rows = [float(re.search(r'cy="([\d.]+)"', dot)[1]) for dot in dots]
    shown = [values[round((y - 24) / 42)] for y in rows]
    assert sorted(zip(places, shown, strict=True)) == sorted(zip(places, shown, strict=True), key=lambda p: p[1])


@pytest.mark.parametrize(
    ("gap", "above", "said"),
    [
        (None, None, "Nothing is certified of how far from optimal the controller is: there is no lower bound"),
        (-0.5, 0.2, "Nothing is certified: F_M = 0.05, a lower bound, contradicts"),
        (4.0, 5.0, "Hardly anything is certified: the controller may cost 5 times the optimum (95 % sure"),
        (0.1, 0.2, f"{in_words(certificate(Run('circle', 'pd'), 0.1).to_dict())[0]}."),
    ],
)
def test_it_says_what_is_certified_and_no_more(gap, above, said, tmp_path):
    found = looked(tmp_path / "run", certificate(Run("circle", "pd"), gap, above))
    assert found.lead.lower().startswith(said.lower())
    assert ("lead alert" in found.words) == (gap != 0.1)
    if gap != 0.1:
        assert not re.search(r"at most [\d.]+ %", found.html)
        assert "Trust the certified" not in found.html or gap == 4.0


def test_without_simulation_the_certified_gap_is_the_sentence(tmp_path):
    made = replace(certificate(Run("circle", "pd"), 0.1, 0.2), perf={"value": None, "density": None})
    said = looked(tmp_path / "run", made).lead
    assert said.startswith(
        "The controller is at most 20 % worse than the optimum (nothing is simulated, each bound 95 %"
    )
    assert "M is at least sup mu*" in said
    negative = replace(made, lower={"F_M": replace(made.lower["F_M"], value=-1.0)})
    assert "is not above 0" in looked(tmp_path / "other", negative).lead


class Hostile(System):
    """<script>alert("doc")</script> swings ``<b>`` up."""

    def __init__(self):
        coordinates = [Angle("angle"), Interval("speed <i onclick=x>", -8, 8, "rad/s")]
        super().__init__(coordinates, ["torque <u>"], discount=1.0, control_limit=2.0)

    def noise(self, x):
        raise SystemExit("the licence has expired")


def test_nothing_that_a_stranger_wrote_is_more_than_words(tmp_path):
    """Names of problems, bounds, controllers, coordinates and curves, docstrings, warnings, values and folders."""
    made = certificate(Run(EVIL, EVIL), 0.1, 0.2).to_dict()
    made |= {"warnings": [EVIL, EVIL, f"\x1b[2J{EVIL}"], "controller": EVIL, "contradiction": EVIL}
    made["perf"] = {EVIL: made["perf"]["value"]}
    made["upper"][EVIL] = made["upper"]["lagrangian"]
    made["lower"]["F_M"] |= {"if": EVIL, "rests_on": {EVIL: EVIL}, "counts": False}
    folder = tmp_path / EVIL.replace("/", "|")
    folder.mkdir()
    (folder / "certificate.json").write_text(json.dumps(made))
    result = {EVIL: 1.0}
    metrics = {"starts": 2, "duration": 1.0, "controller": result, "zero": result, EVIL: result}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    blank_figure(1.0, 1.0).savefig(tmp_path / "figure.png")
    (folder / "figures").mkdir()
    (folder / "figures" / "half.png").write_bytes((tmp_path / "figure.png").read_bytes()[:20])
    (tmp_path / "figure.png").rename(folder / "figures" / f"{EVIL.replace('/', '|')}.png")
    with SummaryWriter(str(folder)) as writer:
        writer.add_scalar(f"loss/{EVIL}", 1.0, 1)
    found = page(write_report(folder, Hostile(), {"problem": {"_target_": EVIL, "by": EVIL}, EVIL: EVIL}))
    assert "\x1b" not in found.html
    assert len(found.words["figcaption"]) == 1
    assert found.words["dt"].count(words.sentence(EVIL)) == 1
    save_page(compare([folder]), tmp_path / "runs.html")
    assert "alert" in page(tmp_path / "runs.html").words["h2"][0] + " ".join(found.words["dd"])


@pytest.mark.parametrize(
    "change",
    [
        {"gap": {}},
        {"lower": 3},
        {"perf": {"value": {"value": "1"}}},
        {"confidence": None},
        {"step": "x"},
        {"share": []},
    ],
)
def test_a_damaged_certificate_is_a_sentence_and_on_the_page_of_many_too(change, tmp_path):
    made = certificate(Run("circle", "pd"), 0.1, 0.2)
    folder = crafted(tmp_path / "runs" / "bad", made, **change)
    with pytest.raises(InputError, match="has no report"):
        write_report(folder, Circle(), {})
    crafted(tmp_path / "runs" / "good", made)
    save_page(compare([tmp_path / "runs"]), tmp_path / "runs.html")
    found = page(tmp_path / "runs.html")
    assert "bad" in found.html
    assert "damaged" in found.html


def test_the_page_of_many_names_all_runs_and_links_to_their_reports(finished, tmp_path):
    root = tmp_path / "runs"
    for name, gap, certified in (("a #1?", 0.01, 0.02), ("b", 0.2, None), ("c", None, None)):
        write_report(crafted(root / name, certificate(Run("circle", "pd"), gap, certified)), Circle(), {})
    (root / "killed" / ".hydra").mkdir(parents=True)
    save_page(compare([root]), root / "page.html")
    found = page(root / "page.html")
    assert found.lead.startswith("The smallest certified gap is 2 %, of a #1?")
    assert [s.partition(":")[0] for s in found.words["summary"]] == ["a #1?", "b", "c"]
    links = [value for name, value in found.attributes if name == "href"]
    assert sorted(links) == ["a%20%231%3F/report.html", "b/report.html", "c/report.html"]
    assert "killed: not finished" in found.html
    with pytest.raises(InputError, match=r"must end in \.html"):
        save_page(compare([root]), root / "page.txt")


def test_what_a_report_tells_to_type_works(finished):
    folder = finished
    blocks = page(folder / REPORT).words["pre"]
    (python,) = (block for block in blocks if block.startswith("import torch"))
    exec(python, {})
    evaluate = next(line for block in blocks for line in block.splitlines() if "evaluate.py" in line).split()
    assert load_run(composed("evaluate", evaluate[2:])).problem.dim == 1
    train = next(block for block in blocks if "train.py" in block).split()
    assert composed("train", train[2:])["trainer"]["steps"] == 40


def test_a_report_that_was_lost_is_made_of_the_other_files(finished, monkeypatch):
    folder = finished
    before = (folder / REPORT).read_text()
    (folder / REPORT).unlink()
    monkeypatch.setattr(runs, "run_to_end", None)
    runs.train(runs.training_run(composed("train", [f"resume={folder}"])), folder)
    assert (folder / REPORT).read_text() == before


def test_curves_of_a_resumed_run_have_each_step_once_and_damaged_ones_are_left_out(tmp_path):
    for start, values in ((0, (1.0, 2.0, 3.0)), (1, (2.5, 3.5, float("nan")))):
        with SummaryWriter(str(tmp_path), filename_suffix=f".{start}") as writer:
            for step, value in enumerate(values, start):
                writer.add_scalar("loss/value", value, step)
    first, second = sorted(tmp_path.iterdir(), key=lambda file: file.suffix)
    first.rename(tmp_path / "events.out.tfevents.1")
    second = second.rename(tmp_path / "events.out.tfevents.2")
    assert history.curves(tmp_path) == {"loss/value": [(0.0, 1.0), (1.0, 2.5), (2.0, 3.5)]}
    second.write_bytes(b"\x18\x00\x00\x00" + second.read_bytes())
    assert set(history.curves(tmp_path)) <= {"loss/value"}
    second.unlink()
    second.symlink_to("/dev/zero")
    assert history.curves(tmp_path) == {}


def test_every_need_bound_and_warning_has_its_words():
    """What warnings are known by stands where they are made."""
    assumptions = certificate(Run("circle", "pd"), 0.1).assumptions
    assert {need.name for bound in BOUNDS for need in bound.needs(assumptions)} <= words.NEEDS.keys()
    assert {bound.name for bound in BOUNDS} <= words.BOUNDS.keys()
    files = [f for f in Path(inspect.getfile(ocp_torch)).parent.rglob("*.py") if f.name != "advice.py"]
    source = re.sub(r'"\s*\n\s*f?"', "", "\n".join(f.read_text() for f in files)).replace("{name}", "C_V")
    assert [part for part in ADVICE if part.replace("C_u", "C_V") not in source.replace("C_u", "C_V")] == []
    assert advice("what nobody has thought of") == OTHERWISE
    assert torch.is_grad_enabled()
