"""Noise that users bring: in a simulator's answers, and in recorded samples."""

import math

import numpy as np
import pytest
import torch

from ocp_torch.errors import InputError
from ocp_torch.problems import Dataset, Simulator
from ocp_torch.problems.checks.check import check_once
from ocp_torch.problems.recorded import recording
from ocp_torch.problems.samples import Samples
from support import zoo
from support.recorded import certificate_of, record
from support.refusals import refused

TURN = 2.0 * math.pi
SHAPES = ("noisy 1-d", "noisy 2-d sigma(x)", "noisy 3-d m=2 sigma(x) B(x) q=1.5", "noisy swing")


def as_arrays(problem, parts, precision=np.float64):
    """A problem of ours as a plain function of arrays, with the ``parts`` after `B` that are named."""

    def oracle(x):
        states = torch.from_numpy(x)
        first = problem.state_cost(states), problem.drift(states), problem.control_matrix(states)
        more = {"mu0": problem.initial_density, "sigma": problem.noise, "none": lambda x: None}
        found = [*first, *(more[name](states) for name in parts)]
        return tuple(None if part is None else part.numpy().astype(precision) for part in found)

    return oracle


def boxed(problem, oracle, **options):
    sizes = dict(dim=problem.dim, control_dim=problem.control_dim)
    return Simulator(oracle, **sizes, discount=problem.discount, exponent=problem.exponent, **options)


PARTS = [("sigma",), ("mu0", "sigma"), ("none", "sigma")]


@pytest.mark.parametrize(
    ("name", "parts"), [*(("noisy swing", parts) for parts in PARTS), *((n, PARTS[1]) for n in SHAPES)]
)
@pytest.mark.parametrize("single", [False, True])
def test_a_simulator_gives_its_noise_after_all_else(name, parts, single):
    problem = zoo.build(name)
    oracle = as_arrays(problem, parts)
    one = lambda x: tuple(None if part is None else part[0] for part in oracle(x[None]))
    box, x = boxed(problem, one if single else oracle, differences=True), zoo.states(problem, 5)
    ours, its = Samples.of(problem, x), Samples.of(box, x + 2.0)
    assert (box.noisy, box.still, box.gives_divergences) == (True, False, True)
    torch.testing.assert_close(its.noise, ours.noise, rtol=1e-9, atol=1e-9)
    for column in ("div_D", "div_div_D"):
        torch.testing.assert_close(getattr(its, column), getattr(ours, column), rtol=1e-7, atol=1e-7)
    if "mu0" in parts:
        torch.testing.assert_close(its.mu0, ours.mu0)
    assert Samples.of(box, x.float()).div_D.dtype == torch.float32


@pytest.mark.parametrize("name", SHAPES[1:])
def test_differences_in_single_precision_are_good_to_three_digits(name):
    problem = zoo.build(name)
    box, x = boxed(problem, as_arrays(problem, ("sigma",), np.float32), differences=True), zoo.states(problem, 40)
    for found, expected in zip(box.noise_divergences(x), problem.noise_divergences(x), strict=True):
        assert float((found - expected).detach().abs().max()) < 1e-3 * float(expected.detach().abs().max())


def test_without_differences_a_simulator_says_which_divergences_are_missing():
    problem = zoo.build("noisy swing")
    box = boxed(problem, as_arrays(problem, ("sigma",)))
    samples = Samples.of(box, zoo.states(problem, 5))
    assert samples.noise is not None
    assert samples.div_D is samples.div_div_D is None
    assert box.unknown_divergences == "a and B and D"
    quiet = boxed(zoo.build("swing"), as_arrays(zoo.build("swing"), ()))
    assert (quiet.noisy, quiet.unknown_divergences) == (False, "a and B")
    assert Samples.of(quiet, zoo.states(problem, 5)).noise is None


def test_a_number_stands_beside_the_noise_of_a_simulator():
    problem = zoo.build("noisy swing")
    x, oracle = zoo.states(problem, 5), as_arrays(problem, ("sigma",))
    both = boxed(problem, oracle, differences=True, noise=[0.01, 0.0])
    alone = boxed(zoo.build("swing"), as_arrays(zoo.build("swing"), ()), noise=0.01)
    D = lambda p: 0.5 * p.noise(x) @ p.noise(x).mT
    torch.testing.assert_close(D(both) - D(problem), torch.tensor([[0.01, 0.0], [0.0, 0.0]]).double().expand(5, 2, 2))
    for found, expected in zip(both.noise_divergences(x), problem.noise_divergences(x), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-7)
    assert (alone.noisy, alone.unknown_divergences) == (True, "a and B")
    assert not alone.noise_divergences(x)[0].any()


def plain(x):
    return 1.0 + np.cos(TURN * x[:, 0]), 0.1 * np.sin(TURN * x), np.ones((len(x), 2, 1))


def with_noise(change):
    """``plain`` with noise, ``change``d at states."""
    return lambda x: (*plain(x), change(0.1 + 0.05 * np.cos(TURN * x)[:, :, None], x))


WRONG = {
    "sigma alone": (with_noise(lambda s, x: s[:, :, 0]), r"the oracle's mu0 has shape \(5, 2\)"),
    "few rows": (
        with_noise(lambda s, x: s[:, :1]),
        r"the oracle's sigma has shape \(5, 1, 1\) .* must have \(5, 2, 1\)",
    ),
    "no column": (with_noise(lambda s, x: s[:, :, :0]), r"the oracle's mu0 has shape \(5, 2, 0\)"),
    "both the wrong way": (
        lambda x: (*plain(x), np.ones((len(x), 2, 1)), np.ones(len(x))),
        "the oracle's mu0 has shape",
    ),
    "NaN": (
        with_noise(lambda s, x: np.where(x[:, :1, None] > 0.5, np.nan, s)),
        "the oracle's sigma is not finite at x =",
    ),
    "no period": (with_noise(lambda s, x: s * x[:, :1, None]), "the oracle's sigma jumps by .* coordinate 0 passes"),
    "of the batch": (with_noise(lambda s, x: s + x.mean()), "sigma at x = .* depends on the other states"),
    "words": (with_noise(lambda s, x: np.full(s.shape, "much")), "the oracle's sigma is no array of real numbers"),
}


@pytest.mark.parametrize("name", WRONG)
def test_noise_of_a_simulator_that_is_none_is_named(name):
    oracle, sentence = WRONG[name]
    with refused(sentence):
        Simulator(oracle, dim=2, control_dim=1)


def test_noise_of_a_simulator_neither_comes_nor_goes():
    left = [40]

    def fading(x):
        left[0] -= 1
        return plain(x) if left[0] < 0 else with_noise(lambda s, x: s)(x)

    box = Simulator(fading, dim=2, control_dim=1)
    left[0] = 0
    with pytest.raises(InputError, match=r"the oracle gave f, a, B at x = .*, but other parts before"):
        box.noise(torch.rand(3, 2))
    check_once(Simulator(with_noise(lambda s, x: s), dim=2, control_dim=1))
    with pytest.raises(InputError, match="the noise of .* is too large"):
        check_once(Simulator(with_noise(lambda s, x: 1e4 * s), dim=2, control_dim=1))


# Recorded samples.
@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("noisy")


def arrays_of(path):
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_recorded_noise_is_read_as_it_was_written(folder, suffix):
    problem = zoo.build("noisy 3-d m=2 sigma(x) B(x) q=1.5")
    data = Dataset(str(record(folder, problem, 600, f"a{suffix}")))
    truth = Samples.of(problem, data.training.x)
    for column in ("noise", "div_D", "div_div_D"):
        torch.testing.assert_close(getattr(data.training, column), getattr(truth, column))
    assert (data.noisy, data.still, data.gives_divergences) == (True, False, True)


@pytest.mark.parametrize("name", ["noisy 1-d", "noisy 2-d degenerate", "noisy 2-d sigma(x)"])
def test_what_needs_missing_divergences_of_the_noise_says_so(folder, name):
    """Of constant noise they are 0, and are not missed."""
    problem = zoo.build(name)
    arrays = arrays_of(record(folder, problem, 600))
    np.savez(folder / "few.npz", **{k: v for k, v in arrays.items() if "D" not in k})
    data, constant = Dataset(str(folder / "few.npz")), name != "noisy 2-d sigma(x)"
    assert data.gives_divergences is constant
    assert data.unknown_divergences == ("" if constant else "D")
    if constant:
        assert not data.training.div_D.any()
        assert not data.training.div_div_D.any()
        return
    certificate = certificate_of(data, problem, 0, steps=3)
    assert certificate.upper["J"] is None
    assert any(
        "no upper bound" in w and "where the noise varies div_D and div_div_D" in w for w in certificate.warnings
    )


def test_noise_of_0_is_none(folder):
    problem = zoo.build("noisy 1-d")
    arrays = arrays_of(record(folder, problem, 600))
    np.savez(folder / "zero.npz", **{k: 0.0 * v if "D" in k or k == "noise" else v for k, v in arrays.items()})
    data = Dataset(str(folder / "zero.npz"))
    assert not data.noisy
    assert data.training.noise is data.held_out.div_D is None


UNREADABLE = {
    "noise of two axes": (dict(noise=lambda s: s[:, :, 0]), r"noise has shape \(600, 2\), but must have \(N, d, k\)"),
    "noise of few rows": (dict(noise=lambda s: s[:, :1]), r"noise has shape .* must have \(N, d, k\) = \(600, 2, 2\)"),
    "noise of no column": (dict(noise=lambda s: s[:, :, :0]), r"noise has shape \(600, 2, 0\)"),
    "NaN": (dict(noise=lambda s: np.where(s == s.max(), np.nan, s)), "noise is not finite at 1 samples"),
    "div D alone": (dict(div_div_D=None), "lacks div_div_D; div_D and div_div_D go with"),
    "no noise": (dict(noise=None), "lacks noise; div_D and div_div_D go with each other and with noise"),
    "div D of one axis": (dict(div_D=lambda s: s[:, 0]), r"div_D has shape \(600,\)"),
    "div D shifted": (dict(div_D=lambda s: s + 0.5), r"div_D\[0\] has mean 0.*, but a divergence must have mean 0"),
    "div div D shifted": (dict(div_div_D=lambda s: s + 5.0), "div_div_D has mean [45]"),
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_recorded_noise_that_is_none_is_refused_in_one_sentence(folder, name):
    changes, sentence = UNREADABLE[name]
    arrays = arrays_of(record(folder, zoo.build("noisy 2-d sigma(x)"), 600, "plain.npz"))
    for column, change in changes.items():
        value = arrays.pop(column)
        arrays |= {} if change is None else {column: change(value)}
    np.savez(folder / "bad.npz", **arrays)
    with refused(sentence):
        recording.read(folder / "bad.npz")


@pytest.mark.parametrize("name", ["noisy 1-d", "noisy 2-d sigma(x)"])
def test_bounds_of_recorded_noise_keep_their_sides_of_the_optimum(folder, name):
    """At the exact value function, and far from it."""
    problem = zoo.build(name)
    data = Dataset(str(record(folder, problem, 4000, "many.npz")))
    certificate = certificate_of(data, problem, 0, steps=3)
    low, high = certificate.lower["F_M"].interval(0.99999)
    assert low <= problem.exact_optimum <= high
    assert high - low < 0.2 * problem.exact_optimum
    assert certificate.upper["J"].interval(0.99999)[1] >= problem.exact_optimum
    rough = certificate_of(data, problem, 0, zoo.rough_network(problem.dim, 3, size=0.3), steps=3)
    assert rough.lower["F_M"].interval(0.99999)[0] <= problem.exact_optimum <= rough.upper["J"].interval(0.99999)[1]
