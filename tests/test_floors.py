"""The rooms of the package stand on floors, in the order of CONTRIBUTING: imports go down, and never round."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import ocp_torch

ROOT = Path(ocp_torch.__file__).parent
MAP = (ROOT.parent / ".github" / "CONTRIBUTING.md").read_text()
# From the top floor to the ground.
FLOORS = [*re.findall(r"^\| `(\w+)` \|", MAP, re.MULTILINE), "errors"]
MODULES = {
    ".".join((ROOT.name, *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in ROOT.rglob("*.py")
}


def imported(module: str, at_once: bool = False) -> set[str]:
    """The modules of the package that ``module`` names in an import; with ``at_once`` those that its own import runs."""
    tree, found = ast.parse(MODULES[module].read_text()), set()
    statements = list(ast.walk(tree)) if not at_once else tree.body
    for node in statements:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            # A name of a package may be a module in it, or made in its `__init__`.
            found |= {full if (full := f"{node.module}.{a.name}") in MODULES else node.module for a in node.names}
    return found & MODULES.keys() - {module}


def test_every_room_is_on_the_map():
    rooms = {path.name for path in ROOT.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert rooms == set(FLOORS) - {"errors"}
    assert {path.name for path in ROOT.glob("*.py")} == {"__init__.py", "errors.py"}


@pytest.mark.parametrize("room", FLOORS)
def test_a_room_imports_from_those_below_it_alone(room):
    above = set(FLOORS[: FLOORS.index(room)])
    inside = [m for m in MODULES if m.split(".")[1:2] == [room]]
    wrong = [(m, other) for m in inside for other in imported(m) if {*other.split(".")[1:2]} & above]
    assert not wrong


def test_no_import_goes_round():
    """But for `__init__` files, which gather what is in their rooms."""
    names = {m for m, path in MODULES.items() if path.name != "__init__.py"}
    try:
        TopologicalSorter({m: imported(m, at_once=True) & names for m in names}).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))
