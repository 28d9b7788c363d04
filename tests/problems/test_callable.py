"""Somebody's simulator as a problem: batched or not, with every way it can go wrong named together with the state."""

import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ocp_torch.cli.job import Job
from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError
from ocp_torch.maths.jets import jet
from ocp_torch.objectives import primal, saddle
from ocp_torch.objectives.saddle import Saddle
from ocp_torch.problems import Simulator
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.samples import Samples
from ocp_torch.runs.build import problem_class
from ocp_torch.runs.resume import OWN_TARGETS
from support import zoo
from support.refusals import refused
from support.small import outcome, session, small

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")

TURN = 2.0 * np.pi


def as_arrays(problem):
    """A problem of ours as a plain function of arrays."""

    def oracle(x):
        states = torch.from_numpy(x)
        parts = problem.state_cost(states), problem.drift(states), problem.control_matrix(states)
        return tuple(part.numpy() for part in (*parts, problem.initial_density(states)))

    return oracle


def one_at_a_time(oracle):
    def single(x):
        assert x.ndim == 1
        return tuple(part[0] for part in oracle(x[None]))

    return single


def wrapped(name, single=False, **options):
    problem = zoo.build(name)
    oracle = as_arrays(problem)
    given_ = dict(
        dim=problem.dim, control_dim=problem.control_dim, discount=problem.discount, exponent=problem.exponent
    )
    return problem, Simulator(one_at_a_time(oracle) if single else oracle, **given_, **options)


NAMES = ("manufactured 2-d mu0", "manufactured 3-d m=2 B(x) q=1.5", "swing", "circle rho=2")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("single", [False, True])
def test_it_is_the_problem_whose_numbers_it_gives(name, single):
    problem, box = wrapped(name, single, differences=True)
    x = zoo.states(problem, 40, off_kinks=True)
    ours, its = Samples.of(problem, x), Samples.of(box, x + 3.0)
    for column in ("f", "a", "B", "mu0"):
        torch.testing.assert_close(getattr(its, column), getattr(ours, column), rtol=1e-9, atol=1e-9)
    for column in ("div_a", "div_B"):
        torch.testing.assert_close(getattr(its, column), getattr(ours, column), rtol=1e-6, atol=1e-6)
    assert Samples.of(box, x.float()).B.dtype == torch.float32


@pytest.mark.parametrize("name", NAMES[1:3])
def test_differences_go_through_every_transform_the_package_uses(name):
    problem, box = wrapped(name, differences=True)
    x = zoo.states(problem, 9)
    network = zoo.rough_network(problem.dim, 0)

    def policy(owner):
        def control(x):
            gradient = jet(network, x).gradient
            return -torch.einsum("ndm,nd->nm", owner.control_matrix(x), gradient)

        return control

    ours, its = ClosedLoop(problem, policy(problem)), ClosedLoop(box, policy(box))
    torch.testing.assert_close(its.drift_divergence(x), ours.drift_divergence(x), rtol=1e-5, atol=1e-5)
    slopes = []
    for owner in (problem, box):
        y = x.clone().requires_grad_(True)
        slopes.append(torch.autograd.grad(owner.control_matrix(y).sum() + owner.state_cost(y).sum(), y)[0])
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-5, atol=1e-5)


def test_calls_are_counted_honestly():
    calls = []

    def oracle(x):
        calls.append(len(x))
        return np.ones(len(x)), None, np.broadcast_to(np.eye(3), (len(x), 3, 3))

    for differences, expected in ((False, [50]), (True, [50, 2 * 3 * 50])):
        box = Simulator(oracle, dim=3, differences=differences)
        assert box.driftless
        assert box.gives_divergences is differences
        calls.clear()
        samples = Samples.of(box, torch.rand(50, 3))
        assert calls == expected
        assert (samples.div_a is None) == (samples.div_B is None) == (not differences)


def plain(x):
    return 1.0 + np.cos(TURN * x[:, 0]), 0.1 * np.sin(TURN * x), np.ones((len(x), 2, 1))


def broken(**changes):
    def oracle(x):
        parts = dict(zip("faB", plain(x), strict=True))
        return tuple((changes[k](x, v) if k in changes else v) for k, v in parts.items())

    return oracle


def raises_beyond(limit):
    def oracle(x):
        if (x[:, 0] > limit).any():
            raise ZeroDivisionError("no mass\nmore lines")
        return plain(x)

    return oracle


class Moody:
    def __init__(self):
        self.calls = 0

    def __call__(self, x):
        self.calls += 1
        f, a, B = plain(x)
        return f + self.calls, a, B


HOSTILE = {
    "NaN": (
        broken(f=lambda x, f: np.where(x[:, 0] > 0.5, np.nan, f)),
        r"the oracle's f is not finite at x = \[0\.[5-9]",
    ),
    "infinite": (broken(B=lambda x, B: B * np.inf), r"the oracle's B is not finite at x = \["),
    "f of shape (N, 1)": (broken(f=lambda x, f: f[:, None]), r"the oracle's f has shape \(5, 1\)"),
    "a state, whose f has shape (1,)": (
        lambda x: (1.0 - np.cos(x[:1]), np.zeros(2), np.ones((2, 1))),
        r"the oracle's f has shape \(1,\) for a state of shape \(2,\) \(x = .*\), but must have \(\)",
    ),
    "a state, whose sigma has no column": (
        lambda x: (1.0 - np.cos(x[0]), np.zeros(2), np.ones((2, 1)), np.ones((2, 1, 1))),
        r"shape \(2, 1, 1\) for a state of shape \(2,\)",
    ),
    "one column too many": (broken(B=lambda x, B: np.ones((len(x), 2, 3))), r"the oracle's B has shape \(5, 2, 3\)"),
    "an exception": (raises_beyond(0.5), r"raised ZeroDivisionError at x = \[0\.[5-9].*no mass\.$"),
    "an exception everywhere": (broken(f=lambda x, f: f / (x[:, 0] @ {}["mass"])), "raised KeyError at x = .*: 'mass'"),
    "words": (broken(a=lambda x, a: np.full(a.shape, "left")), "the oracle's a is no array of real numbers"),
    "nothing": (lambda x: None, "gave a NoneType, but must give f, a, B"),
    "six things": (lambda x: (1, 2, 3, 4, 5, 6), "gave a tuple"),
    "no period": (broken(f=lambda x, f: x[:, 1]), r"f jumps by 1 where coordinate 1 passes from 1 to 0, at x = \["),
    "no period of a": (broken(a=lambda x, a: x), "a jumps by 1 where coordinate 0"),
    "memory": (Moody(), "the oracle's f differs between two calls"),
    "talk": (broken(f=lambda x, f: f + x[:, 0].mean()), "depends on the other states of the batch"),
    "not callable": (3, "must be module:function or a function"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_goes_wrong_is_named_with_the_state(name):
    oracle, sentence = HOSTILE[name]
    with refused(sentence):
        Simulator(oracle, dim=2, control_dim=1)


def test_a_drift_that_is_zero_at_the_seam_does_not_jump_there():
    oracle = lambda x: (np.ones(len(x)), -0.3 * np.sin(TURN * x), np.ones((len(x), 1, 1)))
    assert Simulator(oracle, dim=1).dim == 1


@given(st.floats(0.55, 0.999))
def test_an_exception_met_later_is_traced_to_its_state(limit):
    oracle = raises_beyond(2.0)
    box = Simulator(lambda x: oracle(x), dim=2, control_dim=1)
    oracle = raises_beyond(limit)
    x = torch.cat([torch.rand(40, 2, dtype=torch.float64) * limit, torch.tensor([[0.9995, 0.25]], dtype=torch.float64)])
    with pytest.raises(InputError, match=r"x = \[0\.9995, 0\.25\]: no mass"):
        box.state_cost(x[torch.randperm(41)])


@pytest.fixture
def module(tmp_path, monkeypatch):
    text = """
    import numpy as np

    def batched(x):
        return 1.0 - np.cos(2 * np.pi * x[:, 0]), None, np.ones((len(x), 1, 1))

    def single(x):
        return 1.0 - np.cos(2 * np.pi * x[0]), np.zeros(1), np.ones((1, 1))

    def fails(x):
        raise OSError("no licence")
    """
    (tmp_path / "my_oracles.py").write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path / "my_oracles.py"
    sys.modules.pop("my_oracles", None)


TARGETS = {
    "nowhere:oracle": "problem.target = nowhere:oracle cannot be imported: ModuleNotFoundError",
    "my_oracles:batch": "has no function 'batch' .did you mean 'batched'",
    "my_oracles": "must be module:function or FILE.py:function",
    "gone.py:oracle": "names gone.py, which does not exist",
    "my_oracles:fails": "raised OSError at x = .*no licence",
}


@pytest.mark.parametrize("target", TARGETS)
def test_targets_that_name_no_oracle_are_refused(module, target):
    said = outcome("problem=callable", "problem.dim=1", f"problem.target={target}")
    assert isinstance(said, str)
    with pytest.raises(InputError, match=TARGETS[target]):
        raise InputError(said)


def test_a_missing_target_is_asked_for():
    assert "problem.target" in outcome("problem=callable")
    with pytest.raises(InputError, match="by name"):
        Simulator(plain, dim=2, control_dim=1, workers=2)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["single"])
def test_worker_processes_give_the_same_numbers(module, name):
    alone, shared = (Simulator(f"{module}:{name}", dim=1, workers=k) for k in (1, 2))
    x = torch.rand(11, 1, dtype=torch.float64)
    for column in ("f", "a", "B"):
        assert torch.equal(getattr(Samples.of(alone, x), column), getattr(Samples.of(shared, x), column))
    with pytest.raises(InputError, match="OSError"):
        Simulator(f"{module}:fails", dim=1, workers=2)


def test_methods_fall_back_without_divergences():
    _, bare = wrapped("swing")
    assert type(saddle(bare)) is type(primal(bare)) is Saddle


@pytest.mark.nightly
@pytest.mark.parametrize("differences", [True])
def test_a_run_on_a_simulator_leaves_bounds_and_a_controller_that_needs_the_simulator(module, tmp_path, differences):
    quick = ("certificate.points=128", "certificate.trajectories=4", "certificate.stage.steps=20")
    trainer = small(
        "problem=callable", f"problem.target={module}:batched", "problem.dim=1", "method=dual", *quick,
        f"problem.differences={str(differences).lower()}",
    )  # fmt: skip
    certificate = session(trainer, tmp_path / "run")
    assert certificate.perf["value"].finite
    assert (certificate.upper["lagrangian"] is not None) == differences
    path = tmp_path / "run" / "controller.safetensors"
    with pytest.raises(InputError, match="load_controller"):
        load_controller(path)  # a file does not name a function to be imported
    u = load_controller(path, problem=Simulator(f"{module}:single", dim=1))
    assert u(np.random.default_rng(0).random((4, 1))).shape == (4, 1)


def test_configurations_that_use_its_former_name_still_name_it():
    assert problem_class("ocp_torch.problems.Callable") is problem_class("ocp_torch.problems.Simulator") is Simulator


def test_no_file_can_have_a_function_imported():
    assert not any("simulator" in target.lower() or "callable" in target.lower() for target in OWN_TARGETS)
    overrides = SimpleNamespace(task=["problem=callable", "problem.target=a:b", "problem.dim=3", "seed=1"])
    hydra = SimpleNamespace(overrides=overrides, mode=None)
    command = Job(hydra, "runs/here").again()
    assert "problem=callable problem.target=a:b problem.dim=3" in command
    assert "seed" not in command
