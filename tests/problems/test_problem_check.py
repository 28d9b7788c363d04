"""A problem is checked once, before anything is trained: each slip is one sentence, and nothing legal is refused."""

import time

import pytest
import torch

from ocp_torch import Angle, Problem, System
from ocp_torch.compute.threads import cores
from ocp_torch.errors import InputError
from ocp_torch.problems import Circle, Simulator
from ocp_torch.problems.checks.check import check_once
from ocp_torch.problems.checks.functions import MOST_ENTRIES, Functions
from ocp_torch.problems.checks.mass import sampled_mass
from ocp_torch.problems.checks.sameness import BATCHES, require_concurrency
from ocp_torch.runs.build import build_problem, checked_problem
from support import hostile_problems
from support.hostile_problems import LEGAL, REFUSED, TURN, Good, column, with_
from support.refusals import refused


@pytest.mark.parametrize("name", REFUSED)
def test_a_slip_is_one_sentence_that_says_where(name):
    make, words = REFUSED[name]
    with refused(words):
        check_once(make())


@pytest.mark.parametrize("name", LEGAL)
def test_what_is_legal_is_let_through(name):
    check_once(LEGAL[name]())


def test_functions_of_the_object_itself_count_as_those_of_its_class():
    problem, x = Plain(2, 2), torch.rand(5, 2, dtype=torch.float64)
    assert problem.driftless
    problem.drift = lambda x: 0.3 * torch.ones_like(x)  # of divergence 0, so that no difference shows it
    check_once(problem)
    assert not problem.driftless
    problem.drift = lambda x: torch.sin(TURN * x)
    problem.control_matrix = lambda x: torch.diag_embed(2.0 + torch.cos(TURN * x))
    problem.noise = lambda x: column()(problem, x)
    check_once(problem)
    for divergence in (problem.drift_divergence(x), problem.control_divergence(x), problem.noise_divergences(x)[0]):
        assert float(divergence.detach().abs().max()) > 0.0
    problem.initial_density = lambda x: 1.5 * torch.ones_like(x[:, 0])
    with refused("initial_density of .*Plain integrates to 1.5"):
        check_once(problem)


def test_a_function_set_on_an_object_of_the_package_is_refused_as_files_would_lose_it():
    problem = Circle()
    checked_problem(problem)
    problem.drift = lambda x: 0.5 * torch.ones_like(x)
    with refused("drift is set on an object of .*Circle, whose files name only this class"):
        checked_problem(problem)


class Plain(Problem):
    def state_cost(self, x):
        return 1.0 + torch.cos(TURN * x[:, 0])


def test_a_disturbance_of_the_object_itself_is_noise():
    system = Gusty()
    assert not system.noisy
    system.disturbance = lambda s: torch.ones_like(s)[..., None]
    assert system.noisy
    assert float(system.noise(torch.rand(3, 1, dtype=torch.float64)).min()) == pytest.approx(1.0 / TURN)
    system.drift = lambda x: 0.5 * torch.ones_like(x)
    assert float(system.vector_fields(torch.rand(3, 1))[0].min()) == 0.5


class Gusty(System):
    def __init__(self):
        super().__init__([Angle("phase")], ["rate"])

    def cost(self, s):
        return 1.0 + s[:, 0].cos()

    def dynamics(self, s):
        return 0.0 * s, torch.ones_like(s)[..., None]


def kept(self, x):
    """A cost that is kept in `self` until it is given."""
    self.cost = hostile_problems.plain_cost(self, x)
    if len(x) > 1000:
        time.sleep(1e-3)
    return self.cost


@pytest.mark.skipif(cores() < 2, reason="nothing is asked side by side on one core")
def test_what_two_threads_may_ask_at_once_is_held_against_one():
    check_once(with_(state_cost=kept))
    check_once(with_(concurrent=True))
    with refused(
        "state_cost of .*Mine changes when two threads call the functions at once, which concurrent = True allows"
    ):
        check_once(with_(state_cost=kept, concurrent=True))


@pytest.mark.skipif(cores() < 2, reason="nothing is asked side by side on one core")
def test_all_that_two_threads_are_given_at_once_fits_the_memory_of_any_other_check():
    asked = []

    def matrix(self, x):
        asked.append(x.shape[0])
        return x.new_ones(1, 64, 64).expand(len(x), 64, 64)

    require_concurrency(Functions(with_(64, control_matrix=matrix, concurrent=True), simulator=False))
    assert max(asked) * 64**2 * BATCHES <= MOST_ENTRIES


def test_the_check_leaves_random_numbers_as_they_were():
    problem = Good()
    before = torch.get_rng_state()
    check_once(problem)
    assert torch.equal(torch.get_rng_state(), before)


def test_what_a_constructor_raises_is_told_with_the_line():
    with pytest.raises(
        InputError, match=r"__init__ of .*BrokenInit raised KeyError: 'missing' \(.*hostile_problems.py, line"
    ):
        build_problem({"_target_": "support.hostile_problems.BrokenInit"})


def test_a_simulator_is_held_against_the_same():
    import numpy as np

    def oracle(x):
        return np.cos(2.0 * np.pi * x[:, 0]), None, np.ones((len(x), 2, 1))

    with pytest.raises(InputError, match="state_cost .* must be at least 0"):
        check_once(Simulator(oracle, dim=2, control_dim=1))


@pytest.mark.parametrize(("dim", "width"), [(1, 0.004), (2, 0.004), (3, 0.03), (5, 0.03)])
def test_the_mass_of_a_narrow_density_is_found(dim, width):
    problem = with_(dim, initial_density=hostile_problems.gaussian(width, dim))
    for factor in (0.3, 1.0, 3.0):
        found = sampled_mass(lambda x, k=factor: k * problem.initial_density(x), dim, 1024)
        assert abs(found.value - factor) <= found.half
        assert found.half < 0.4 * factor
        assert found.wrong == (factor != 1.0)


MODULES = {
    "syntax": ("def f(:\n", r"SyntaxError: .*\(.*broken_syntax.py, line 1\)"),
    "name": ("import math\nx = maths.pi\n", r"NameError: name 'maths' is not defined.*\(.*broken_name.py, line 2\)"),
    "exit": ("import sys\nsys.exit(0)\n", r"SystemExit: 0 \(.*broken_exit.py, line 2\)"),
    "needs": ("import no_such_package\n", r"No module named 'no_such_package'.*\(.*broken_needs.py, line 1\)"),
}


@pytest.mark.parametrize("kind", MODULES)
def test_a_module_that_cannot_be_imported_is_told_with_the_line(kind, tmp_path, monkeypatch):
    text, words = MODULES[kind]
    (tmp_path / f"broken_{kind}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    with refused(words):
        build_problem({"_target_": f"broken_{kind}.Mine"})
