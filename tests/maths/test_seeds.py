"""The tree of seeds: every draw has a place of its own on it."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest
import torch

import ocp_torch
from ocp_torch.maths.seeds import Branch, derive_seed, fixed_generator

ROOT = Path(ocp_torch.__file__).parent
# Where seeds come in that are not derived: the library's own, those a caller hands in, and those that define a problem.
BARE = {
    "maths/seeds.py",  # `fixed_generator`
    "certificate/upper/policy_evaluation.py",  # `FixedPool`, handed a derived seed
    "fields/fields.py",  # `Fields.build`, handed a derived seed
    "maths/sampling.py",  # `evaluation_points`, whose seed is derived in the line before
    "training/state.py",  # the process's own generators, from a derived seed
    "runs/metrics/trial.py",  # `random_starts`, handed a derived seed
    "training/warm_start/trial.py",  # handed a derived seed
    "problems/exact/manufactured.py",
    "problems/exact/torus.py",
    "problems/systems/graphs.py",
    "problems/systems/kuramoto.py",
}


@cache
def trees() -> dict[str, ast.Module]:
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in ROOT.rglob("*.py")}


def calls(name: str):
    """Every call of a function or method ``name``: the file it is in, and the call."""
    for path, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and name == getattr(node.func, "id", getattr(node.func, "attr", None)):
                yield path, node


def member(path: str, call: ast.Call) -> str:
    branch = call.args[1] if len(call.args) > 1 else None
    named = isinstance(branch, ast.Attribute) and getattr(branch.value, "id", None) == "Branch"
    assert named, f"{path}:{call.lineno} derives a seed without naming a branch of Branch"
    return branch.attr


def place(call: ast.Call) -> tuple[int, ...] | None:
    """The path below the branch; `None` where it is only known when the program runs."""
    path = call.args[2:]
    return tuple(n.value for n in path) if all(isinstance(n, ast.Constant) for n in path) else None


def test_every_seed_is_derived_on_a_named_branch_and_no_two_modules_share_a_place():
    found = defaultdict(list)
    for path, call in calls("derive_seed"):
        found[member(path, call)].append((path, place(call)))
    assert set(found) == set(Branch.__members__), "a branch that nobody draws from, or one that is not listed"
    for name, uses in found.items():
        modules = {path for path, _ in uses}
        if len(modules) > 1:
            places = {(path, where) for path, where in uses}
            assert all(where is not None for _, where in places), f"{name} is used in {modules}"
            assert len({where for _, where in places}) == len(places), f"{modules} draw from the same place on {name}"


def test_numbers_of_branches_that_runs_repeat_do_not_change():
    """A run of an older version goes on, or is repeated, with the states and weights it had."""
    expected = dict(TRAINING=0, EVALUATION=1, WEIGHTS=2, POLICY_EVALUATION=3, EXTERNAL_VALUE=4, VALIDATION=5, VISITS=9)
    assert {name: int(Branch[name]) for name in expected} == expected
    assert derive_seed(7, Branch.TRAINING, 3) == 6248955217710131343


def test_generators_are_seeded_from_the_tree():
    """Elsewhere nobody calls `manual_seed` with anything but a derived seed."""
    for path, call in calls("manual_seed"):
        seed = call.args[0]
        derived = isinstance(seed, ast.Call) and getattr(seed.func, "id", None) == "derive_seed"
        assert derived or path in BARE, f"{path}:{call.lineno}"


@pytest.mark.parametrize("number", [0, 1])
def test_a_fixed_generator_begins_in_the_same_place(number):
    first, again = (torch.rand(5, generator=fixed_generator(number)) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, torch.rand(5, generator=fixed_generator(number + 1)))
