"""The README: every line of code is run, in order, as written, in a fresh copy; it is short, and its links lead on."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ocp_torch.cli.explain import CHECKOUT

TEXT = (CHECKOUT / "README.md").read_text(encoding="utf-8")
MOST_LINES = 150
# What a fresh copy needs, of a checkout.
COPIED = ("ocp_torch", "configs", "scripts", "pyproject.toml", "README.md")
# Installing is what continuous integration begins with.
INSTALLS = "pip install"


def blocks() -> list[tuple[str, str]]:
    """Language and code of each block that names one."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)


def commands(folder: Path) -> list[list[str]]:
    """What is run, in order; modules are written to ``folder`` on the way."""
    found = []
    for language, code in blocks():
        module = re.match(r"# (\w+\.py),", code)
        if module:
            (folder / module[1]).write_text(code, encoding="utf-8")
        elif language == "python":
            found.append([sys.executable, "-c", code])
        else:
            assert language == "bash"
            found += [["bash", "-c", line] for line in code.splitlines() if not line.startswith(INSTALLS)]
    return found


@pytest.mark.nightly
def test_every_line_runs_in_order_as_written(tmp_path):
    for name in COPIED:
        source = CHECKOUT / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, tmp_path / name)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    alone = os.environ | {"PATH": path, "PYTHONPATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    listed = commands(tmp_path)
    assert len(listed) >= 7
    for words in listed:
        ended = subprocess.run(words, cwd=tmp_path, env=alone, capture_output=True, text=True, timeout=600)
        assert ended.returncode == 0, (words[-1], ended.stderr[-2000:])
        assert "Traceback" not in ended.stdout + ended.stderr
    (report,) = (tmp_path / "outputs" / "circle_pd").glob("*/report.html")
    assert report.stat().st_size > 10_000
    assert (tmp_path / "controller.c").exists()


def test_it_is_short_and_its_links_and_scripts_exist():
    assert len(TEXT.splitlines()) <= MOST_LINES
    for target in re.findall(r"\]\(([^)#]+)[)#]", TEXT):
        assert target.startswith("http") or (CHECKOUT / target).exists(), target
    scripts = set(re.findall(r"scripts/(\w+)\.py", TEXT))
    assert scripts == {path.stem for path in (CHECKOUT / "scripts").glob("*.py")}


@pytest.mark.parametrize("page", ["README.md", ".github/GUIDE.md"])
def test_a_link_within_the_pages_leads_to_a_heading(page):
    text = (CHECKOUT / page).read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#]*)#([^)]+)\)", text):
        there = (CHECKOUT / page).parent / target if target else CHECKOUT / page
        headings = re.findall(r"^#+ (.*)$", there.read_text(encoding="utf-8"), flags=re.MULTILINE)
        assert anchor in {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings}
