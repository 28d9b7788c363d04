"""A controller somebody brings: what it truly costs is inside what is printed, or it is refused in one sentence."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ocp_torch import InputError, certify
from ocp_torch.certificate import StageSettings, table
from ocp_torch.certificate.external.black_box import BlackBox
from ocp_torch.problems import Circle, Manufactured
from ocp_torch.runs.external import value_of
from ocp_torch.runs.loading import load_policy
from support import zoo
from support.controllers import controllers
from support.forked import assert_succeeded, certificate_in, script
from support.honesty import BARE
from support.switching import cost_of_switching

TURN = 2.0 * math.pi
UNFITTED = replace(BARE, tolerance=1e-2)
CHEAP = replace(UNFITTED, stage=StageSettings(steps=100, rounds=1, batch=128))


def cost_by_itself(u, rho: float = 2.0, starts: int = 500, h: float = 0.01, horizon: float = 7.0) -> float:
    """On the circle, in NumPy: Euler's method with steps halved once and extrapolated."""

    def euler(h):
        x, total = (np.arange(starts) + 0.5) / starts, 0.0
        for k in range(round(horizon / h)):
            weight = math.exp(-rho * k * h) - math.exp(-rho * (k + 1) * h)
            total += weight * np.mean((x - 0.5) ** 2 + 0.5 * u(x) ** 2)
            x = (x + h * u(x)) % 1.0
        return total

    return 2.0 * euler(0.5 * h) - euler(h)


def saturated(x):
    return 0.4 * np.tanh(np.sin(TURN * np.asarray(x)))


LAWS = {
    # Smooth, in NumPy: proportional to the angle, saturated.
    "saturated": (saturated, None),
    # Proportional, k = 1: V^u = (x - 1/2)^2 rho (1 + k^2/2) / (rho + 2k); jumps at the seam, which it leaves.
    "proportional": (lambda x: 0.5 - x, 2.0 * 1.5 / 4.0 / 12.0),
    # Bang-bang, in PyTorch: slides at 1/2.
    "bang-bang": (lambda x: torch.where(x < 0.5, 0.3, -0.3), cost_of_switching(0.3, 0.3)),
}


@pytest.mark.nightly
@pytest.mark.parametrize("name", LAWS)
def test_the_true_suboptimality_is_inside_the_printed_interval(name):
    problem, (policy, truth) = Circle(), LAWS[name]
    truth = cost_by_itself(policy) if truth is None else truth
    certificate = certify(problem, policy, value=problem.exact_value, settings=CHEAP, seed=3)
    low, high = certificate.perf["given"].interval(0.999)
    assert low <= truth <= high
    worse = truth / problem.exact_optimum - 1.0
    found = certificate.suboptimality
    assert found["at_least"] <= worse <= found["at_most"] <= worse + 0.3
    below = [e for e in certificate.perf_lower.values() if e is not None]
    above = [e for e in certificate.upper.values() if e is not None]
    assert all(e.interval(0.999)[0] <= truth for e in below)
    assert all(e.interval(0.999)[1] >= truth for e in above)
    # Where it jumps nothing that takes its divergence is shown.
    assert (certificate.upper["lagrangian"] is None) == (name != "saturated")
    assert certificate.assumptions.regular_holds == (name == "saturated")
    assert "worse than the optimum" in table(certificate.to_dict())


def test_without_a_value_function_there_is_no_lower_bound():
    certificate = certify(Circle(), lambda x: 0.0 * x, settings=UNFITTED, train_steps=0)
    assert certificate.best_lower is None
    assert certificate.suboptimality["at_most"] is None
    assert any("no lower bound" in w for w in certificate.warnings)
    assert certificate.perf["given"].value == pytest.approx(1.0 / 12.0, rel=0.1)


@pytest.mark.nightly
def test_a_value_function_is_trained_where_none_is_given():
    problem = Circle()
    certificate = certify(problem, lambda x: 0.0 * x, settings=UNFITTED, train_steps=40)
    name, _ = certificate.best_lower
    assert certificate.lower[name].interval(0.999)[0] <= problem.exact_optimum
    assert certificate.run.step == 40


@pytest.mark.nightly
def test_a_controller_of_ours_and_its_value():
    problem = Manufactured(dim=1)
    saved = controllers("dual")[0]
    quick = replace(UNFITTED, points=128, trajectories=2)
    certificate = certify(saved.problem, saved, value=saved, settings=quick)
    given, own = certificate.perf["given"], certificate.perf["value"]
    assert abs(given.value - own.value) <= given.half_width(0.999) + own.half_width(0.999)
    with pytest.raises(InputError, match="but the problem has d = 3"):
        certify(Manufactured(dim=3), saved, settings=CHEAP)
    with pytest.raises(InputError, match="value gave"):
        certify(problem, lambda x: x, value=lambda x: x, settings=CHEAP)


class Counter:
    def __init__(self):
        self.calls = 0

    def __call__(self, x):
        self.calls += 1
        return torch.full_like(x, 0.1 * self.calls)


class Tired:
    """A constant control that drops once it was asked often enough."""

    def __init__(self):
        self.calls = 0

    def __call__(self, x):
        self.calls += 1
        return torch.full_like(x, 0.1 if self.calls < 40 else 0.0)


def fails(x):
    raise KeyError("no table")


REFUSED = {
    "two controls": (lambda x: np.zeros((len(x), 2)), "must give"),
    "no batch": (lambda x: np.zeros(1), "must give"),
    "not a number": (lambda x: x * math.nan, "not finite"),
    "infinite somewhere": (lambda x: 1.0 / (x < 0.01).double(), "not finite"),
    "memory": (Counter(), "function of x"),
    "the batch": (lambda x: x - x.mean(), "other states"),
    "a large batch": (lambda x: 0.0 * x + 0.5 * (len(x) > 512), "batch \\(of 1024 here\\)"),
    "a memory": (Tired(), "what it was asked before"),
    "an error": (fails, "raised KeyError"),
    "no function": (0.3, "must be a function"),
}


@pytest.mark.nightly
@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_controller_is_refused_in_one_sentence(name):
    controller, words = REFUSED[name]
    with pytest.raises(InputError, match=words) as caught:
        certify(Circle(), controller, settings=CHEAP, train_steps=0)
    assert "\n" not in str(caught.value)


def test_sparse_controls_are_controls():
    box = BlackBox(lambda x: x.to_sparse(), Manufactured(dim=2))
    x = torch.rand(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.equal(box(x), x)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_derivatives_of_a_black_box_are_those_of_its_function(dtype):
    policy = lambda x: torch.stack([(TURN * x[:, 0]).sin(), x[:, 1].cos() * (TURN * x[:, 0]).cos()], dim=-1)
    box = BlackBox(lambda x: policy(x.to(dtype)), Manufactured(dim=2))
    x = 0.1 + 0.8 * torch.rand(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    tangent = torch.randn(20, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    forward = torch.func.jvp(box, (x,), (tangent,))[1]
    _, pull = torch.func.vjp(box, x)
    close = dict(rtol=0.0, atol=1e-6 if dtype is torch.float64 else 2e-2)
    torch.testing.assert_close(forward, torch.func.jvp(policy, (x,), (tangent,))[1], **close)
    torch.testing.assert_close(pull(tangent)[0], torch.func.vjp(policy, x)[1](tangent)[0], **close)
    torch.testing.assert_close(box(x + 3.0), policy(x), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("kind", [torch.from_numpy, np.asarray])
def test_a_controller_that_writes_into_its_argument_is_a_function_of_the_state(kind):
    def shifted(states):
        states -= 0.25
        return kind(np.sin(TURN * np.asarray(states)))

    x = torch.rand(20, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = (TURN * (x - 0.25)).sin()
    torch.testing.assert_close(BlackBox(shifted, Circle())(x), wanted, rtol=1e-12, atol=1e-12)


class Sine(torch.nn.Module):
    def forward(self, x):
        return 0.3 * torch.sin(6.283185307179586 * x)


FILE = """
from __future__ import annotations  # with which a dataclass looks its module up

import math
from dataclasses import dataclass

@dataclass
class Law:
    size: float = 0.3

def u(x):
    return 0.3 * (2 * math.pi * x).sin()
"""


@pytest.mark.parametrize("script", [False, True])
def test_a_network_of_another_size_is_refused_by_its_size_not_by_its_precision(script, tmp_path):
    network = torch.nn.Linear(2, 1)
    if script:
        torch.jit.script(network).save(str(tmp_path / "law.pt"))
        network = load_policy(str(tmp_path / "law.pt"), Circle())
    with pytest.raises(InputError, match=r"for states in float32 RuntimeError: .*\(7x1 and 2x1\)\.$"):
        BlackBox(network, Circle())


def test_tensors_may_be_answered_with_arrays():
    mixed = BlackBox(lambda x: 0.5 - x.numpy(), Circle())
    torch.testing.assert_close(mixed(torch.tensor([[0.2]])), torch.tensor([[0.3]]))
    with pytest.raises(InputError, match=r"gave shape \(7, 2\) for states \(7, 1\)"):
        BlackBox(lambda x: np.zeros((len(x.numpy()), 2)), Circle())


def test_files_are_loaded_or_refused(tmp_path):
    (tmp_path / "law.py").write_text(FILE)
    torch.jit.script(Sine()).save(str(tmp_path / "law.pt"))
    controllers("dual")[0].save(tmp_path / "controller.safetensors")
    x = torch.rand(5, 1, dtype=torch.float64)
    for source in ("law.py:u", "law.pt"):
        found = BlackBox(load_policy(str(tmp_path / source), Circle()), Circle())(x)
        torch.testing.assert_close(found, 0.3 * (TURN * x).sin(), rtol=1e-6, atol=1e-6)
    (tmp_path / "broken.pt").write_text("nothing")
    (tmp_path / "broken.py").write_text("def u(x:")
    refusals = {
        "law.py:v": "no function 'v'",
        "law.py": "must name its function",
        "nowhere.py:u": "does not exist",
        "nowhere": "does not exist",
        "broken.pt": "not a TorchScript file",
        "broken.py:u": "controller = .* cannot be imported: SyntaxError",
    }
    for source, words in refusals.items():
        with pytest.raises(InputError, match=words):
            load_policy(str(tmp_path / source), Circle())


@pytest.mark.filterwarnings("ignore")  # of numbers that overflow
def test_a_fit_that_fails_costs_its_bounds_alone():
    """An absurd learning rate: what is simulated stands, and the warning says what is missing; no `V` can be trained so."""
    wild = replace(CHEAP, stage=replace(CHEAP.stage, lr=1e6), points=64, trajectories=4)
    certificate = certify(Circle(), saturated, settings=wild, train_steps=0)
    assert certificate.perf["given"].finite
    assert any(w.startswith("the certification stage failed: the loss of player") for w in certificate.warnings)


class Misshapen(Circle):
    def state_cost(self, x):
        return super().state_cost(x).unsqueeze(-1)


def test_a_problem_is_checked_before_a_controller_is_certified():
    with pytest.raises(InputError, match=r"state_cost of .*Misshapen.* \(7,\)"):
        certify(Misshapen(), saturated, settings=CHEAP, train_steps=0)


@pytest.mark.nightly
def test_the_script_leaves_a_certificate_and_its_figure(tmp_path):
    (tmp_path / "law.py").write_text(FILE)
    own = ["problem=circle", "steps=20", f"hydra.run.dir={tmp_path / 'out'}", "certificate.points=256"]
    own += ["certificate.trajectories=4", "certificate.occupation_states=0", "certificate.stage.steps=20"]
    result = script("certify", "controller=law.py:u", *own, cwd=tmp_path)
    assert_succeeded(result)
    assert "Perf: this controller" in result.stdout
    assert certificate_in(tmp_path / "out")["perf"]["given"]["value"] > Circle().exact_optimum
    assert (tmp_path / "out" / "figures" / "certificate.png").exists()
    wrong = script("certify", "controller=law.py:w", *own, cwd=tmp_path)
    assert (wrong.returncode, "Traceback" in wrong.stderr) == (2, False)
    assert "no function 'w'" in wrong.stderr


def bowl(x):
    return 0.2 - 0.1 * (TURN * x[:, 0]).cos()


# Functions that are no `V` to judge by, with what is said of them; with noise in the last ones.
ODD_VALUES = {
    "a table": (lambda x: bowl(((1000 * x).floor() + 0.5) / 1000), 0.0, "value jumps by 0.00.* at x = "),
    "no period": (lambda x: 0.1 * (0.5 * TURN * x[:, 0]).cos(), 0.0, "value jumps by 0.2 at x = .* passes from 1 to 0"),
    "detached": (
        lambda x: bowl(x.detach()) + 0.0 * x[:, 0],
        0.0,
        "the gradient of value by autograd is another function's",
    ),
    "half of it": (lambda x: torch.where(x[:, 0] < 0.4, bowl(x.detach()), bowl(x)), 0.0, "another function's"),
    "kinks": (lambda x: 0.1 * (x[:, 0] - 0.5).abs(), 0.01, "gradient of value jumps by 0.2 at x = .*; with noise"),
    "bent": (lambda x: bowl(x) + (x - x.detach())[:, 0] * bowl(x.detach()), 0.01, "gradient of value"),
}


@pytest.mark.parametrize("name", ODD_VALUES)
def test_a_value_that_is_not_what_its_derivatives_say_is_refused(name):
    value, noise, said = ODD_VALUES[name]
    with pytest.raises(InputError, match=said):
        certify(Circle(noise=noise), saturated, value=value, settings=UNFITTED)


@zoo.on(("circle rho=2", "manufactured 2-d q=1.5"))
def test_what_is_continuous_is_a_value(problem):
    """Exact ones, a piecewise linear table, single precision, a constant; whatever it says beyond the unit cell."""
    table = lambda y: torch.lerp(
        bowl(y.floor()[:, None] / 64), bowl((y.floor() + 1)[:, None] / 64), y - y.detach().floor()
    )
    for value in (
        problem.exact_value,
        bowl,
        lambda x: bowl(x.float()),
        lambda x: table(64 * x[:, 0]),
        lambda x: 0.3 + 0 * x[:, 0],
    ):
        inside = lambda x, value=value: torch.where((x < 0).any(-1) | (x >= 1).any(-1), math.nan, value(x))
        assert torch.isfinite(value_of(inside, problem)(torch.tensor([[1.7] * problem.dim], dtype=torch.float64))).all()
