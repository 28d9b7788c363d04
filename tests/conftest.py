"""What every test shares: one thread, repeatable hypothesis examples, the devices there are, and the zoo as a fixture."""

import copy
import math
import time
from collections import Counter
from dataclasses import replace

import pytest
import torch
from hypothesis import Phase, settings

from support import zoo
from support.composing import quickly

# The same examples on every run: a failure is then a change in the code, never luck. No shrinking: most examples are
# seeds of networks, and a smaller seed is not a simpler network.
settings.register_profile(
    "repeatable", derandomize=True, deadline=None, database=None, phases=(Phase.explicit, Phase.generate)
)
settings.load_profile("repeatable")


# Files that take longest: begun first, so that of several processes none waits for another at the end.
LONGEST = ("test_readme.py", "test_killed.py", "test_adversarial.py", "test_warm_start.py", "test_export.py")
BEGUN = time.monotonic()
# With nothing beside, a slow machine has time for some two fifths of the nightly tests: three turns in a row then run all.
FIFTHS, STRIDE = 5, 2


def pytest_addoption(parser):
    parser.addoption(
        "--minutes", type=float, help="skip the tests that would begin later than so many minutes from now"
    )
    parser.addoption("--turn", type=int, help="begin with another part of the tests, so that --minutes skips others")


@pytest.hookimpl(tryfirst=True)  # before what a test needs is made
def pytest_runtest_setup(item):
    minutes = item.config.getoption("minutes")
    if minutes is not None and time.monotonic() - BEGUN > 60.0 * minutes:
        pytest.skip(f"it would begin after the {minutes:g} minutes that --minutes allows")


@pytest.hookimpl(trylast=True)  # of the tests that -m leaves
def pytest_collection_modifyitems(config, items):
    """The longest files, with those of most tests in between: what is begun last is short. Each ``--turn`` begins with the
    file at another fifth of the tests."""
    many = Counter(item.path for item in items)
    others = sorted((path for path in many if path.name not in LONGEST), key=lambda path: (-many[path], path))
    place = {path: 2 * k + 1 for k, path in enumerate(others)}
    place |= {path: 2 * LONGEST.index(path.name) for path in many if path.name in LONGEST}
    items.sort(key=lambda item: place[item.path])
    begin = len(items) * (STRIDE * (config.getoption("turn") or 0) % FIFTHS) // FIFTHS
    begin = next((k for k in range(begin, len(items)) if k == 0 or items[k].path != items[k - 1].path), 0)
    items[:] = items[begin:] + items[:begin]


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    """Small networks are faster on one thread, and sums are then added in one order."""
    torch.set_num_threads(1)


FOUND = ("V0", "c", "state_cost_bound", "value_bound", "control_bound", "occupation_bound", "exact_optimum")


@pytest.fixture(autouse=True, scope="session")
def searched_once():
    """A manufactured problem of the same arguments as one before has what was found for that one, by searches that take
    most of the time of many tests."""
    from ocp_torch.problems import Manufactured

    derive, found = Manufactured._derive, {}

    def derived(problem):
        if type(problem) is not Manufactured:  # another class may have another cost
            return derive(problem)
        of = repr(sorted(problem.parameters.items()))
        if of not in found:
            derive(problem)
            found[of] = {name: copy.deepcopy(getattr(problem, name)) for name in FOUND}
        vars(problem).update(copy.deepcopy(found[of]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Manufactured, "_derive", derived)
        yield


@pytest.fixture(scope="module")
def quick_composition():
    """For modules that compose hundreds of configurations."""
    with quickly():
        yield


@pytest.fixture(scope="module")
def cheap_looks():
    """For modules whose looks on the way need not say much, nor draw."""
    from ocp_torch.runs import run
    from ocp_torch.training import evaluator

    little = replace(evaluator.QUICK, points=64, replicates=2, trajectories=2, ascents=1, tolerance=0.01)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluator, "QUICK", little)
        patch.setattr(run, "glimpse", lambda _: {})
        yield


@pytest.fixture
def any_variate(monkeypatch):
    """A control variate is used however bad it is."""
    monkeypatch.setattr("ocp_torch.certificate.simulated.performance.NO_VARIATE", math.inf)


@pytest.fixture(params=["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"])
def device(request) -> torch.device:
    return torch.device(request.param)


@pytest.fixture
def problem(request):
    """The problem of the zoo whose name a test is parametrised with (``zoo.on``)."""
    return zoo.build(request.param)
