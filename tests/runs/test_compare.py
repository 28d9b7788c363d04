"""Runs side by side: sorted by gap, in a table, a CSV file and a picture; broken and unfinished ones are named."""

import csv
import json

import pytest
import torch
import yaml
from matplotlib.image import imread

from ocp_torch.certificate import Run
from ocp_torch.errors import InputError
from ocp_torch.runs.compare import COLUMNS, compare
from ocp_torch.runs.trend import field_of, save_trend
from ocp_torch.training.checkpoint import save_checkpoint
from support.forked import command
from support.looks import certificate


def finished(folder, gap, certified=None, **run):
    folder.mkdir(parents=True)
    certificate(Run("circle", "dual", **run), gap, certified).save(folder / "certificate.json")


@pytest.fixture
def outputs(tmp_path):
    root = tmp_path / "outputs"
    finished(root / "circle_dual" / "poor", 0.5, 0.6, seed=1, step=10)
    finished(root / "circle_dual" / "good", 0.01, 0.02, seed=2, step=2000)
    finished(root / "sweeps" / "monday" / "fair", 0.1, 0.3)
    finished(root / "sweeps" / "monday" / "simulated only", 0.001)
    (root / "circle_pd" / "empty" / ".hydra").mkdir(parents=True)
    state = {"step": 30, "config": {"trainer": {"steps": 90}}, "weights": torch.zeros(2)}
    save_checkpoint(root / "circle_pd" / "killed" / "checkpoints" / "last.pt", state)
    (root / "circle_pd" / "broken").mkdir()
    (root / "circle_pd" / "broken" / "certificate.json").write_text('{"schema": 1')
    return root


def test_runs_are_sorted_by_gap_and_what_is_not_finished_is_named(outputs):
    comparison = compare([outputs])
    names = [row["run"].rpartition("/")[2] for row in comparison.rows]
    assert names == ["good", "fair", "poor", "simulated only"]
    assert comparison.rows[0]["gap_certified"] == pytest.approx(0.02)
    assert (comparison.rows[0]["seed"], comparison.rows[0]["step"]) == (2, 2000)
    why = {name.rpartition("/")[2]: text for name, text in comparison.unfinished.items()}
    assert why.keys() == {"empty", "killed", "broken"}
    assert "step 30 of 90" in why["killed"]
    assert "damaged" in why["broken"]
    table = comparison.table().splitlines()
    assert table[0].split() == list(COLUMNS)
    assert "2,000" in table[2]
    assert "2.000%" in table[2]
    assert len(table) == 2 + 4 + 3
    assert [row["run"] for row in compare([outputs / "circle_dual" / "good"]).rows] == ["good"]


def test_a_job_that_failed_is_named_with_its_reason(outputs):
    """The last line of its log counts: one that went on, and was stopped, has not failed."""
    runs, said = outputs / "circle_pd", "error: job 1 (problem.discount=-1): problem.discount is -1."
    (runs / "empty" / "train.log").write_text(f"{said}\n")
    (runs / "killed" / "train.log").write_text(f"going on\n{said}\n")
    why = {name.rpartition("/")[2]: text for name, text in compare([outputs]).unfinished.items()}
    assert why["empty"] == "failed: job 1 (problem.discount=-1): problem.discount is -1."
    assert why["killed"].startswith("not finished: saved at step 30 of 90; resume=")
    assert why["killed"].endswith("goes on; failed: job 1 (problem.discount=-1): problem.discount is -1.")
    (runs / "killed" / "train.log").write_text(f"{said}\ngoing on\n")
    why = {name.rpartition("/")[2]: text for name, text in compare([outputs]).unfinished.items()}
    assert why["killed"].endswith("goes on.")


@pytest.mark.parametrize(
    "change",
    [
        {"gap": None},
        {"lower": {"F_M": {"value": "1"}}},
        {"seed": "x"},
        {"step": None},
        {"warnings": 3},
        {"train_seconds": float("nan")},
        {"share": []},
        {"seed": True},
    ],
)
def test_a_crafted_certificate_is_named_not_believed(change, tmp_path):
    finished(tmp_path / "run", 0.1, 0.2)
    file = tmp_path / "run" / "certificate.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    comparison = compare([tmp_path])
    assert comparison.rows == []
    assert "damaged" in comparison.unfinished["run"]


def test_names_in_files_cannot_steer_the_terminal(tmp_path):
    finished(tmp_path / "run", 0.1, 0.2)
    file = tmp_path / "run" / "certificate.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"problem": "\x1b[2Jcircle\nrow"}))
    assert "\x1b" not in compare([tmp_path]).table()
    assert len(compare([tmp_path]).table().splitlines()) == 3


def test_the_script_prints_and_writes_what_it_is_asked_for(outputs, tmp_path):
    table, picture, page = tmp_path / "runs.csv", tmp_path / "runs.png", tmp_path / "runs.html"
    ended = command("compare", str(outputs), f"csv={table}", f"plot={picture}", f"html={page}", cwd=tmp_path)
    assert ended.status == 0, ended
    assert ended.stdout.splitlines()[0].startswith("run ")
    with table.open() as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["gap_certified"] or "inf") for row in rows] == pytest.approx([0.02, 0.3, 0.6, float("inf")])
    assert rows[3]["upper"] == ""
    assert imread(picture).std() > 0
    assert "killed" in page.read_text()


@pytest.mark.parametrize(
    "arguments", [("nowhere",), (".", "cvs=a.csv"), (".", "plot=a.txt"), (".", "html=a.txt"), (".", "csv=")]
)
def test_a_slip_is_told_in_one_sentence(arguments, tmp_path):
    finished(tmp_path / "run", 0.1)
    assert command("compare", *arguments, cwd=tmp_path).sentence
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_folders_without_runs_are_named_and_alone_give_no_empty_table(tmp_path):
    (tmp_path / "empty").mkdir()
    said = command("compare", "empty", "csv=a.csv", cwd=tmp_path).sentence
    assert "no run is in empty; give runs' folders" in said
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
    finished(tmp_path / "run", 0.1)
    found = compare([tmp_path / "run", tmp_path / "empty"])
    assert [row["run"] for row in found.rows] == ["run"]
    assert found.table().endswith(f"not in the table: {tmp_path / 'empty'}: no run is in it.")


def test_a_folder_that_is_not_there_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        compare([tmp_path / "nowhere"])


def test_gaps_are_plotted_against_a_number_of_the_configuration(tmp_path):
    """Runs that have no such number are named."""
    for run, noise, gap in (("a", 0.01, 0.3), ("b", 0.1, 0.2)):
        finished(tmp_path / "runs" / run, gap, gap)
        (tmp_path / "runs" / run / ".hydra").mkdir()
        text = yaml.safe_dump({"problem": {"_target_": "ocp_torch.problems.Circle", "noise": noise, "shape": "x"}})
        (tmp_path / "runs" / run / ".hydra" / "config.yaml").write_text(text)
    found = compare([tmp_path / "runs"])
    assert [field_of(found.folders[name], "problem.noise") for name in ("a", "b")] == [0.01, 0.1]
    save_trend(found, "problem.noise", tmp_path / "trend.png")
    assert imread(tmp_path / "trend.png").std() > 0
    for field in ("problem.nose", "problem.shape", "problem", "problem.noise.size"):
        with pytest.raises(InputError, match=r"against is .* but .*runs/[ab] has no such number"):
            save_trend(found, field, tmp_path / "never.png")
    with pytest.raises(InputError, match="must end in"):
        save_trend(found, "problem.noise", tmp_path / "trend.txt")
    assert "plot=FILE" in command("compare", "runs", "against=problem.noise", cwd=tmp_path).sentence
