"""`--help`: every field of every command with its value and what it means, from the files that hold the defaults."""

import os
import subprocess
import sys

import pytest
import yaml

from ocp_torch.cli.compose import register_resolvers, with_own_defaults
from ocp_torch.cli.explain import CONFIGS
from ocp_torch.cli.help import comments, help_text
from ocp_torch.cli.outcome import BROKEN_PIPE
from ocp_torch.errors import InputError
from support.forked import assert_succeeded, script

register_resolvers()
COMMANDS = sorted(path.stem for path in CONFIGS.glob("*.yaml"))


def helped(command: str, *overrides: str) -> str:
    return help_text(command, f"python scripts/{command}.py", list(overrides))


def leaves(section: dict, prefix: str = "") -> list[str]:
    below = [(f"{prefix}{key}", value) for key, value in section.items()]
    return [
        n for name, value in below for n in (leaves(value, f"{name}.") if isinstance(value, dict) and value else [name])
    ]


def test_help_of_training_names_every_group_and_its_choices():
    text = " ".join(helped("train").split("Choices")[1].split("Fields")[0].split())
    for path in CONFIGS.glob("*/*.yaml"):
        if len(list(path.parent.glob("*.yaml"))) > 1:
            listed = text.split(f" {path.parent.name}=")[1].split("=")[0]
            assert path.stem in listed.replace(",", "").replace(":", "").split()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_field_of_a_command_is_in_its_help(command):
    fields = yaml.safe_load((CONFIGS / f"{command}.yaml").read_text())
    text = helped(command)
    for name in leaves({key: value for key, value in fields.items() if key not in ("defaults", "hydra")}):
        assert f"  {name}=" in text
    assert text.startswith(next(iter((CONFIGS / f"{command}.yaml").read_text().splitlines())).removeprefix("# "))


# An experiment sets fields that are explained where they are defined.
EXPLAINING = sorted(path for path in CONFIGS.glob("**/*.yaml") if path.parent.name != "experiment")


@pytest.mark.parametrize("path", EXPLAINING, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_every_field_in_the_configuration_says_what_it_means(path):
    """On its line, or on that of the section it is in; names that only repeat the file's own need no words."""
    known = comments(path)
    for name in leaves(yaml.safe_load(path.read_text())):
        above = [name.rsplit(".", k)[0] for k in range(name.count(".") + 1)]
        overridden = path.parent == CONFIGS and (CONFIGS / above[-1]).is_dir()
        if not name.startswith(("hydra", "defaults")) and name != "name" and not overridden:
            assert any(known.get(one) for one in above), f"{path.name}: {name}"


def test_help_shows_the_fields_of_what_is_chosen_with_the_values_given():
    text = helped("train", "problem=pendulum", "method=dual", "problem.mass=2", "trainer.batch=77")
    assert "problem.torque_noise=0.0" in text
    assert "problem.mass=2 " in text
    assert "trainer.batch=77 " in text
    assert "method.augmentation" not in text
    assert "N m sqrt(s), beside the torque" in " ".join(text.split())


def test_comments_are_those_of_the_line_of_the_section_or_of_the_line_before(tmp_path):
    file = tmp_path / "a.yaml"
    lines = (
        "# what it is for",
        "",
        "# told before",
        "a: [1, 2]",
        "b:  # of the section",
        "  c: '# no'  # of c",
        "e: x#y",
    )
    file.write_text("\n".join(lines))
    assert comments(file) == {"a": "told before", "b": "of the section", "b.c": "of c"}


def test_help_explains_the_words():
    text = helped("evaluate", "terms")
    for word in ("OPT", "F_M", "Perf", "gap, certified", "occupation density"):
        assert word in text


@pytest.mark.parametrize("wrong", ["terns", "problem=circel", "trainer.stepz=3"])
def test_help_of_what_there_is_not_is_one_sentence(wrong):
    with pytest.raises(InputError, match=wrong.split("=")[-1] if "=3" not in wrong else "trainer.steps"):
        helped("train", wrong)


def test_help_from_the_command_line_leaves_nothing(tmp_path):
    result = script("train", "--help", "problem=torus", cwd=tmp_path)
    assert_succeeded(result)
    assert "problem.dim=2" in result.stdout
    assert list(tmp_path.iterdir()) == []


def test_help_shows_what_a_class_of_ones_own_is_made_from(tmp_path, monkeypatch):
    (tmp_path / "winches.py").write_text(
        "from ocp_torch import System\n\n\n"
        "class Winch(System):\n"
        '    """A drum winds up a load."""\n\n'
        "    def __init__(self, load: float, radius: float = 0.25, walls: list | None = None):\n"
        "        raise AssertionError('help makes nothing')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    typed = lambda *overrides: helped("train", *with_own_defaults("train", list(overrides)))
    text = typed("problem._target_=winches.Winch", "problem.walls=[1,2]")
    assert "\nproblem  A drum winds up a load.\n" in text
    assert "  problem.load=...\n" in text
    assert "  problem.radius=0.25\n" in text
    assert "  problem.walls=[1,2]\n" in text
    with pytest.raises(InputError, match="winches has no class Wench"):
        typed("problem._target_=winches.Wench")


def test_a_reader_that_closes_the_pipe_ends_a_command_quietly():
    """As `... | head -1` does."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, CONFIGS.parent / "scripts" / "compare.py", "--help"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (BROKEN_PIPE, "")
