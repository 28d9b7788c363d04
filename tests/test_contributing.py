"""What CONTRIBUTING tells to touch and to copy is there."""

import re
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
GUIDE = (CHECKOUT / ".github" / "CONTRIBUTING.md").read_text()
WORDS = sorted(set(re.findall(r"`([^`\n]+)`", GUIDE)))
FOLDERS = (CHECKOUT, CHECKOUT / "ocp_torch", CHECKOUT / "tests", CHECKOUT / "tests" / "certificate")


@pytest.mark.parametrize("path", [w for w in WORDS if re.fullmatch(r"[\w./<>]+(\.py|\.yaml|/)", w)])
def test_files_it_names_exist(path):
    """A new file's folder does."""
    named = re.sub(r"[^/]*<name>.*", "", path)
    assert any((folder / named).exists() for folder in FOLDERS), path


@pytest.mark.parametrize("name", [w for w in WORDS if re.fullmatch(r"test_\w+", w)])
def test_tests_it_names_exist(name):
    assert any(f"def {name}(" in file.read_text() for file in (CHECKOUT / "tests").glob("*/test_*.py"))
