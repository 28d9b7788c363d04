"""Recorded samples: what is read is what was written, whatever is wrong with a file is one sentence, and a certificate
from held-out samples alone keeps its promise."""

import contextlib
import dataclasses
import io
import json
import math
import pickle
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch.certificate import CertificateSettings, Run, StageSettings, Trained, certify_fields
from ocp_torch.certificate.contexts.recorded import groups
from ocp_torch.certificate.upper.recorded import closed_loop_samples
from ocp_torch.control.policies import NETWORK, trained_policies
from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.objectives import Dual, primal, saddle
from ocp_torch.problems import Circle, Dataset, Manufactured, PhaseNeurons, Unicycle
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.recorded import plausible, recording
from ocp_torch.problems.samples import Samples
from ocp_torch.runs import record as recording_command
from ocp_torch.runs.build import build_certificate_settings
from ocp_torch.runs.evaluate import certify_saved, load_run
from ocp_torch.runs.external import certify as certify_given
from ocp_torch.runs.figures import FieldFigures
from ocp_torch.runs.frame import frame_of, in_units
from ocp_torch.runs.report.advice import advice
from ocp_torch.training.checkpoint import load_checkpoint
from ocp_torch.training.monitor import Observer
from support import zoo
from support.formulas import Exactly
from support.recorded import certificate_of, record
from support.refusals import refused
from support.small import outcome, session, small

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("recorded")


@pytest.fixture(scope="module")
def plain(folder):
    return record(folder, zoo.build("manufactured 2-d mu0"))


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
@pytest.mark.parametrize("contrast", [0.0, 0.8])
def test_what_is_read_is_what_was_written(tmp_path, suffix, contrast):
    problem = zoo.build("manufactured 3-d m=2 B(x) q=1.5")
    path = record(tmp_path, problem, 3000, f"a{suffix}", contrast=contrast, seed=4)
    found = recording.read(path)
    truth = Samples.of(problem, found.samples.x)
    for field in dataclasses.fields(Samples):
        if field.name != "weight":
            torch.testing.assert_close(getattr(found.samples, field.name), getattr(truth, field.name))
    density = (1.0 + contrast * (2.0 * torch.pi * found.samples.x).cos()).prod(dim=-1)
    torch.testing.assert_close(found.samples.weight * density, torch.ones(3000, dtype=torch.float64))
    assert found.numbers == {"discount": problem.discount, "exponent": problem.exponent}
    assert found.notes == ()


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_a_limit_for_each_control_is_recorded_and_one_for_fewer_or_more_refused(tmp_path, suffix):
    problem = zoo.build("box-limited 2-d")
    path = record(tmp_path, problem, 300, f"a{suffix}")
    data = Dataset(str(path))
    assert data.control_limit == problem.control_limit
    assert Dataset(**data.parameters).control_limit == problem.control_limit
    samples = Samples.of(problem, zoo.states(problem, 300))
    for wrong in ([0.1, 0.2, 0.3], [[0.1], [0.2]], [0.1, np.nan]):
        recording.write(path, samples, {"discount": 2.0, "control_limit": wrong})
        with pytest.raises(InputError, match=r"control_limit has shape \(.*must be one finite number, or one for each"):
            recording.read(path)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_names_and_units_are_recorded_and_stand_on_the_axes(tmp_path, suffix):
    for problem in (Unicycle(walls=True), PhaseNeurons(strength=2.0)):
        data = Dataset(str(record(tmp_path, problem, 300, f"a{suffix}")))
        assert data.measures == problem.measures
        mine, theirs = frame_of(data), frame_of(problem)
        assert (mine.labels, mine.extent, mine.control) == (theirs.labels, theirs.extent, theirs.control)
    control = in_units(data, lambda x: torch.ones(3, 1))
    assert control(None).tolist() == [[2.0]] * 3
    assert Dataset(str(record(tmp_path, Circle(), 300, f"b{suffix}"))).measures is None


def test_a_strangers_names_are_no_formulas_in_a_figure(tmp_path):
    path = record(tmp_path, Circle(), 300)
    units = {"coordinates": [{"name": "$\\frac{"}], "controls": [{"name": "$\\over$ }"}]}
    np.savez(path, **arrays_of(path), units=np.frombuffer(json.dumps(units).encode(), np.uint8))
    fields = Fields({"value": PeriodicMLP(dim=1, width=8, depth=2, modes=2)})
    data = Dataset(str(path))
    for figure in FieldFigures(data, fields, resolve_constants(data, occupation_bound=2.0), None).figures().values():
        figure.canvas.draw()
        assert figure.axes[0].get_xlabel() == "$\\frac{ [rad]"


GOOD = {"coordinates": [{"name": "a"}, {"name": "b", "low": 0, "high": 2, "unit": "m"}], "controls": [{"name": "F"}]}
UNREADABLE = {
    "no text": [300.0] * 40,
    "no JSON": b"{'a': 1",
    "no UTF-8": b"\xff\xfe{}",
    "a list": b"[]",
    "endless": b" " * (recording.MOST_UNITS + 1),
    "deep": b'{"a":' * 2000 + b"1" + b"}" * 2000,
    "too few": {**GOOD, "coordinates": GOOD["coordinates"][:1]},
    "words": {**GOOD, "controls": ["F", "G"]},
    "the same name": {**GOOD, "controls": [{"name": "F"}, {"name": "F"}]},
    "a long name": {**GOOD, "controls": [{"name": "F" * 99}, {"name": "G"}]},
    "a name for a terminal": {**GOOD, "controls": [{"name": "\x1b[2J"}, {"name": "G"}]},
    "no name": {**GOOD, "controls": [{"unit": "N"}, {"name": "G"}]},
    "an unknown unit": {**GOOD, "controls": [{"name": "F", "unit": "parsecs"}, {"name": "G"}]},
    "a scale of 0": {**GOOD, "controls": [{"name": "F", "scale": 0}, {"name": "G"}]},
    "swapped": {**GOOD, "coordinates": [{"name": "a"}, {"name": "b", "low": 2, "high": 0}]},
    "no low": {**GOOD, "coordinates": [{"name": "a"}, {"name": "b", "high": 0}]},
    "a period of words": {**GOOD, "coordinates": [{"name": "a", "period": "long"}, {"name": "b"}]},
}


def test_strange_names_and_units_are_left_out_with_a_sentence(tmp_path, plain):
    base = arrays_of(plain)
    for name, units in {"good": {**GOOD, "controls": [{"name": "F"}, {"name": "G"}]}, **UNREADABLE}.items():
        text = json.dumps(units).encode() if isinstance(units, dict) else units
        as_array = np.frombuffer(text, np.uint8) if isinstance(text, bytes) else np.array(text)
        np.savez(tmp_path / "a.npz", **base, units=as_array)
        found = recording.read(tmp_path / "a.npz")
        assert (found.measures is None, len(found.notes)) == ((name != "good"),) * 2, name
        assert all(note.isprintable() and len(note) < 300 and note.endswith("left out.") for note in found.notes), name


def arrays_of(path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def banded(x):
    """Each coordinate is uniform, their difference is not."""
    return np.stack([x[:, 0], (x[:, 0] + 0.5 * x[:, 1]) % 1.0], axis=1)


def dented(**changes):
    """A change of arrays: a function of the old one, a new value, or `None` to leave it out."""

    def change(arrays):
        for name, new in changes.items():
            if new is None:
                arrays.pop(name)
            else:
                arrays[name] = new(arrays[name].copy()) if callable(new) else new
        return arrays

    return change


def put(row, value):
    def change(array):
        array[row] = value
        return array

    return change


WRONG = {
    "no B": (dented(B=None), "lacks B"),
    "no x, no f": (dented(x=None, f=None), "lacks x, f"),
    "a typo": (dented(div_A=np.zeros(1500)), "'div_A', which is no array of a recording .did you mean 'div_a'"),
    "f of shape (N, 1)": (dented(f=lambda f: f[:, None]), r"f has shape \(1500, 1\), but must have \(N,\) = \(1500,\)"),
    "x of one axis": (dented(x=lambda x: x[:, 0]), r"x has shape \(1500,\)"),
    "B without columns": (dented(B=lambda B: B[:, :, :0]), r"\(N, d\) and \(N, d, m\)"),
    "a transposed": (dented(a=lambda a: a.T), r"a has shape \(2, 1500\)"),
    "fewer of mu0": (dented(mu0=lambda m: m[:-1]), r"mu0 has shape \(1499,\)"),
    "NaN in f": (dented(f=put(7, np.nan)), "f is not finite at 1 samples, first at row 7"),
    "infinite B": (dented(B=put(3, np.inf)), "B is not finite at 1 samples, first at row 3"),
    "negative f": (dented(f=put(11, -0.5)), "f is -0.5 at row 11, but must not be negative"),
    "radians": (dented(x=lambda x: 6.28 * x), r"outside \[0, 1\)"),
    "words": (dented(f=np.array(["a"] * 1500)), "f has type <U1, but must hold real numbers"),
    "complex": (dented(a=lambda a: a * 1j), "a has type complex128"),
    "booleans": (dented(f=lambda f: f > 0), "f has type bool"),
    "density of 0": (dented(density=put(2, 0.0)), "density falls to 0, but must be positive"),
    "a density of another law": (dented(density=lambda d: 2.0 * d), "the mean of 1 / density is 0.5"),
    "negative mu0": (dented(mu0=put(1, -1e-3)), "mu0 falls to -0.001"),
    "mu0 of mean 2": (dented(mu0=lambda m: 2.0 * m), "mu0 has mean"),
    "two discounts": (dented(discount=np.ones(2)), r"discount has shape \(2,\)"),
    "a discount of 0": (dented(discount=np.float64(0.0)), "problem.discount is 0"),
    "a NaN exponent": (dented(exponent=np.float64(np.nan)), "exponent has shape"),
    "few samples": (lambda arrays: {k: v[:50] if v.ndim else v for k, v in arrays.items()}, "holds 50 samples"),
    "one half of the torus": (dented(x=lambda x: 0.5 * x), r"coordinate \d of x does not follow the uniform law"),
    "a band": (dented(x=banded), r"coordinates \[0, 1\] of x together do not follow the uniform law"),
}


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
@pytest.mark.parametrize("name", WRONG)
def test_a_file_that_is_no_recording_is_refused_in_one_sentence(tmp_path, plain, name, suffix):
    change, sentence = WRONG[name]
    base = arrays_of(plain)
    arrays = change({**base, "density": np.ones(1500)} if "density" in name else base)
    path = tmp_path / f"bad{suffix}"
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        if any(v.dtype.kind in "Uc" for v in arrays.values()):
            return  # the format holds no such thing
        from safetensors.numpy import save_file

        save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, str(path))
    with refused(sentence):
        Dataset(str(path))


class Trap:
    def __reduce__(self):
        return (pytest.fail, ("the pickle was run",))


def test_a_pickle_inside_is_never_run(tmp_path, plain):
    arrays = arrays_of(plain)
    trap = np.empty(1500, dtype=object)
    trap[:] = [Trap()] * 1500
    np.savez(tmp_path / "trap.npz", **{**arrays, "f": trap})
    with pytest.raises(InputError, match="f holds Python objects, which are never read"):
        Dataset(str(tmp_path / "trap.npz"))
    (tmp_path / "bare.npz").write_bytes(pickle.dumps(Trap))
    with pytest.raises(InputError, match="not a whole .npz"):
        Dataset(str(tmp_path / "bare.npz"))
    with zipfile.ZipFile(tmp_path / "inner.npz", "w") as archive:
        archive.writestr("x.npy", pickle.dumps([1.0, 2.0]))
    with pytest.raises(InputError):
        Dataset(str(tmp_path / "inner.npz"))


@settings(max_examples=40)
@given(cut=st.floats(0.0, 0.999), flip=st.integers(0, 2**30), which=st.sampled_from(["npz", "safetensors"]))
def test_damaged_files_are_refused_or_read_as_numbers(damaged, cut, flip, which):
    """Cut short: always refused. One byte changed: refused, unless only numbers changed, which nobody can see."""
    folder, contents = damaged
    path = folder / f"damaged.{which}"
    whole = contents[which]
    path.write_bytes(whole[: int(cut * len(whole))])
    with pytest.raises(InputError):
        recording.read(path)
    bent = bytearray(whole)
    bent[flip % len(whole)] ^= 1 << (flip % 8)
    path.write_bytes(bytes(bent))
    with contextlib.suppress(InputError):
        assert len(recording.read(path).samples) == 1500


@pytest.fixture(scope="module")
def damaged(folder, plain):
    other = record(folder, zoo.build("manufactured 2-d mu0"), name="data.safetensors")
    return folder, {"npz": plain.read_bytes(), "safetensors": other.read_bytes()}


def test_other_files_are_refused(tmp_path, plain):
    (tmp_path / "table.csv").write_text("x,f\n")
    for path, sentence in (
        (tmp_path / "table.csv", "ending in .npz or .safetensors"),
        (tmp_path / "nowhere.npz", "does not exist"),
        (tmp_path, "ending in"),
    ):
        with pytest.raises(InputError, match=sentence):
            Dataset(str(path))
    with pytest.raises(InputError, match=r"problem\.path is 3"):
        Dataset(3)
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w") as archive:
        archive.writestr("x.npy", b"0")
        archive.infolist()[0].file_size = 2**40
    (tmp_path / "bomb.npz").write_bytes(bomb.getvalue())
    with pytest.raises(InputError, match=r"unpacks to|damaged"):
        Dataset(str(tmp_path / "bomb.npz"))
    assert "problem.path" in outcome("problem=dataset")
    for override, sentence in (
        ("trainer.target_gap=0.1", "no simulation"),
        ("sampler.visited=0.2", "a data set has no data"),
        ("sampler=importance", "a data set has no data"),
    ):
        assert sentence in outcome("problem=dataset", f"problem.path={plain}", "method=dual", override)
    for field, sentence in (("held_out=1.5", "held_out"), ("held_out=0.01", "too few"), ("discount=-1", "discount")):
        assert sentence in outcome("problem=dataset", f"problem.path={plain}", f"problem.{field}")


def test_whole_turns_are_taken_off_only_when_asked(tmp_path, plain):
    arrays = arrays_of(plain)
    shifted = {**arrays, "x": arrays["x"] + np.arange(1500)[:, None] % 5 - 2.0}
    np.savez(tmp_path / "turns.npz", **shifted)
    found = recording.read(tmp_path / "turns.npz", wrap=True)
    torch.testing.assert_close(found.samples.x, torch.from_numpy(arrays["x"]), rtol=0.0, atol=1e-12)


def test_a_trajectory_is_noticed(tmp_path, plain):
    arrays = arrays_of(plain)
    order = np.argsort(arrays["f"])
    np.savez(tmp_path / "sorted.npz", **{k: v[order] if v.ndim else v for k, v in arrays.items()})
    assert "no independent draws" in recording.read(tmp_path / "sorted.npz").notes[0]


def test_parts_are_disjoint_and_follow_the_seed(plain):
    problem, again, other = Dataset(str(plain)), Dataset(str(plain)), Dataset(str(plain), seed=1)
    assert torch.equal(problem.held_out.x, again.held_out.x)
    assert not torch.equal(problem.held_out.x, other.held_out.x)
    rows = lambda samples: {tuple(x) for x in samples.x.tolist()}
    parts = [rows(problem.training), rows(problem.held_out), rows(problem.validation_view.held_out)]
    assert sum(map(len, parts)) == len(set.union(*parts)) == 1500
    assert len(problem.held_out) == 300
    sets = groups(problem.held_out)
    assert len({len(s) for s in sets}) == 1
    assert set.union(*map(rows, sets)) <= parts[1]


def test_importance_weights_make_any_law_serve(tmp_path):
    problem = zoo.build("manufactured 2-d q=2")
    path = record(tmp_path, problem, 20000, contrast=0.7)
    samples = recording.read(path).samples
    for values, truth in (
        (problem.exact_value(samples.x) * samples.mu0, problem.exact_optimum),
        ((2.0 * torch.pi * samples.x[:, 1]).cos(), 0.0),
    ):
        error = float((samples.weight * values).std()) / 20000**0.5
        assert abs(float(samples.mean(values)) - truth) <= 5.0 * error
    assert float(values.mean()) == pytest.approx(0.35, abs=0.03)  # half the contrast, without the weights


@pytest.mark.parametrize("name", ["manufactured 2-d mu0", "manufactured 3-d m=2", "limited 2-d", "box-limited 2-d"])
def test_closed_loops_from_samples_are_those_of_the_problem(tmp_path, name):
    problem = zoo.build(name)
    data = Dataset(str(record(tmp_path, problem, 400)))
    fields = Fields({"value": zoo.rough_network(problem.dim, 1)})
    policy = trained_policies(None, data, fields, resolve_constants(data))["value"]
    found = closed_loop_samples(data.held_out, policy, data.control_cost)
    true = Samples.of(
        ClosedLoop(problem, trained_policies(None, problem, fields, resolve_constants(data))["value"]), found.x
    )
    for column in ("f", "a", "div_a", "mu0"):
        torch.testing.assert_close(getattr(found, column), getattr(true, column), rtol=1e-9, atol=1e-9)


@pytest.mark.nightly
def test_the_lower_bound_at_the_exact_value_covers_the_optimum_as_often_as_it_says(tmp_path):
    """60 data sets: at the exact V the slack is 0 and F_M is an unbiased estimate of OPT; 95 % intervals cover."""
    problem, hits = zoo.build("manufactured 1-d q=2"), 0
    for seed in range(60):
        data = Dataset(str(record(tmp_path, problem, 300, seed=seed, contrast=0.5)), held_out=0.5)
        low, high = certificate_of(data, problem, seed).lower["F_M"].interval(0.95)
        hits += low <= problem.exact_optimum <= high
    assert 51 <= hits <= 60  # outside with probability below 1e-3 for a binomial of 0.95


@pytest.mark.nightly
@settings(max_examples=5)
@given(seed=st.integers(0, 10**6), size=st.sampled_from([0.03, 0.3, 1.0]))
def test_no_value_gives_bounds_that_contradict_the_optimum(datasets, seed, size):
    problem, data = datasets
    network = zoo.rough_network(problem.dim, seed, size=size)
    value = Exactly(lambda x: problem.exact_value(x) + network(x.double()).to(x))
    certificate = certificate_of(data, problem, seed, value, steps=3)
    low, high = certificate.lower["F_M"], certificate.upper["J"]
    assert low.interval(0.999999)[0] <= problem.exact_optimum
    assert high.interval(0.999999)[1] >= problem.exact_optimum
    assert certificate.upper["lagrangian"] is certificate.lower["shifted"] is certificate.exact is None
    assert certificate.perf == {"value": None, "density": None}
    assert certificate.baseline == {"zero": None}
    said = " ".join(certificate.warnings)
    assert "held-out samples" in said
    assert "C_V" in said
    json.dumps(certificate.to_dict(), allow_nan=False)


@pytest.fixture(scope="module")
def datasets(folder):
    problem = zoo.build("manufactured 2-d q=2")
    return problem, Dataset(str(record(folder, problem, 4000, "weighted.npz", contrast=0.5)))


def test_nothing_is_claimed_that_samples_do_not_give(tmp_path):
    problem = zoo.build("manufactured 2-d B(x)")
    bare = Dataset(str(record(tmp_path, problem, 400, "bare.npz", divergences=False)))
    assert not bare.gives_divergences
    with pytest.raises(InputError, match="B varies"):
        bare.control_matrix(torch.rand(2, 2))
    with pytest.raises(InputError, match="recorded states only"):
        bare.state_cost(torch.rand(2, 2))
    assert {type(Dual(bare)).__name__, type(saddle(bare)).__name__} == {"Dual", "Saddle"}
    assert type(primal(bare)).__name__ == "Saddle"
    certificate = certificate_of(bare, problem, 0, steps=3)
    assert certificate.upper["J"] is certificate.subject is None
    assert any("B varies" in w for w in certificate.warnings)
    constant = Dataset(str(record(tmp_path, zoo.build("manufactured 2-d mu0"), 400, divergences=False)))
    told = certificate_of(constant, zoo.build("manufactured 2-d mu0"), 0, steps=3)
    assert told.upper["J"] is None
    assert any("no div_a" in w for w in told.warnings)
    with pytest.raises(InputError, match="data set"):
        certify_given(constant, lambda x: x)


def test_a_torus_recorded_without_divergences_has_them_all_the_same(tmp_path):
    """No drift, constant B: both divergences are 0, and primal takes a network for mu, which needs no f at new states."""
    data = Dataset(str(record(tmp_path, zoo.build("torus 2-d chain"), 400, divergences=False)))
    assert data.driftless
    assert data.gives_divergences
    assert primal(data).occupation == NETWORK
    with pytest.raises(InputError, match=r"method\.occupation"):
        primal(data, occupation="closed")


@pytest.mark.parametrize(("discount", "bounded"), [(4.0, True), (0.5, False)])
def test_a_density_without_bound_is_noticed_without_a_simulation(tmp_path, discount, bounded):
    """On the circle mu* is bounded exactly for rho > 1: below, no M can be believed, and F_M is not used."""
    problem = Circle(discount=discount)
    data = Dataset(str(record(tmp_path, problem, 2000)))
    smooth = lambda x: problem._alpha * (1.0 + (2.0 * torch.pi * x[:, 0]).cos()) / (2.0 * torch.pi**2)
    fields = Fields({"value": Exactly(smooth)}).double()
    settings_ = CertificateSettings(stage=StageSettings(steps=200, rounds=1, batch=64))
    network = lambda **form: PeriodicMLP(width=24, depth=2, modes=3, **form)
    trained = Trained(fields, None, network)
    given = resolve_constants(data, occupation_bound=4.0)
    found = certify_fields(data, trained, given, settings_, Run("dataset", "dual"))
    assert found.assumptions.occupation_holds is bounded
    assert (found.best_lower is not None) is bounded
    assert any("grows beyond all bounds" in w for w in found.warnings) is not bounded
    json.dumps(found.to_dict(), allow_nan=False)


RUN = ("problem=dataset", "certificate.stage.steps=10", "certificate.stage.rounds=1", "trainer.evaluate_every=10")


@pytest.mark.nightly
@pytest.mark.parametrize("method", ["dual", "primal", "pd"])
@pytest.mark.parametrize("varying", [False, True])
def test_runs_on_recorded_samples_leave_all_their_files(tmp_path, method, varying):
    path = record(tmp_path, zoo.build("manufactured 2-d B(x)" if varying else "manufactured 2-d mu0"), 600)
    trainer = small(
        *RUN, f"problem.path={path}", f"method={method}", f"trainer.figures={str(method != 'primal').lower()}"
    )
    certificate = session(trainer, tmp_path / "run")
    saved = json.loads((tmp_path / "run" / "certificate.json").read_text())
    assert saved["perf"] == {"value": None, "density": None}
    assert (saved["upper"]["J"] is None) == (varying and method == "dual")
    path.unlink()  # the controller needs no data
    u = load_controller(tmp_path / "run" / "controller.safetensors")
    kind = "value" if method != "primal" and not varying else "density"
    assert u.kind == (kind if not (varying and method == "dual") else "value")
    if varying and method == "dual":
        with pytest.raises(InputError, match="B varies"):
            u(torch.rand(3, 2))
    else:
        assert u(torch.rand(3, 2)).shape == (3, 2)
        assert certificate.subject == u.kind
    with pytest.raises(InputError, match="does not exist"):
        certify_saved(u, CertificateSettings(stage=StageSettings(steps=1)))


def test_a_run_without_a_controller_says_so_and_what_to_do(tmp_path, caplog):
    path = record(tmp_path, zoo.build("manufactured 2-d B(x)"), 300)
    with caplog.at_level("INFO"):
        found = session(small(*RUN, f"problem.path={path}", "method=dual", "trainer.figures=false"), tmp_path / "run")
    assert "no controller, " in caplog.text
    assert "controller from" not in caplog.text
    (told,) = (w for w in found.warnings if "no controller" in w)
    assert "method=pd" in advice(told)


def test_no_larger_bound_is_advised_where_none_can_be_believed():
    told = (
        "F_M is not used: the occupation density under the controller grows beyond all bounds, so no M can be believed."
    )
    assert "A larger `M` does not help" in advice(told)


@pytest.mark.nightly
def test_a_saved_run_is_certified_again_from_its_file(tmp_path, plain):
    trainer = small(*RUN, f"problem.path={plain}", "method=dual")
    first = session(trainer, tmp_path / "run")
    controller = load_run({"run": str(tmp_path / "run"), "problem": {}})
    second = certify_saved(controller, build_certificate_settings(trainer.config))
    for side in ("lower", "upper"):
        assert getattr(first, side) == getattr(second, side)


def test_a_resumed_run_is_the_uninterrupted_one_and_notices_other_data(tmp_path, plain):
    build = lambda steps, path=plain: small(
        "problem=dataset", f"problem.path={path}", "method=pd", f"trainer.steps={steps}"
    )
    through = build(20)
    through.fit(Observer(), tmp_path / "whole.pt")
    half = build(20)
    half.settings = dataclasses.replace(half.settings, max_seconds=None)
    for _ in range(10):
        half._advance(Observer(), None)
    half.save(tmp_path / "half.pt")
    rest = build(20)
    rest.resume(tmp_path / "half.pt")
    rest.fit(Observer(), tmp_path / "end.pt")
    one, other = load_checkpoint(tmp_path / "whole.pt"), load_checkpoint(tmp_path / "end.pt")
    assert all(torch.equal(one["average"][k], other["average"][k]) for k in one["average"])
    arrays = arrays_of(plain)
    np.savez(tmp_path / "other.npz", **{**arrays, "f": arrays["f"] + 1e-9})
    with pytest.raises(InputError, match="contents have changed"):
        build(20, tmp_path / "other.npz").resume(tmp_path / "half.pt")


def test_recording_is_checked_before_anything_is_written(tmp_path):
    good = {"problem": {"_target_": "ocp_torch.problems.Circle"}, "out": str(tmp_path / "a.npz"), "samples": 200}
    good |= {"seed": 0, "divergences": True, "contrast": 0.0}
    for field, value in (("out", "a.csv"), ("samples", 3), ("contrast", 1.0), ("seed", -1), ("divergences", 1)):
        with pytest.raises(InputError, match=field):
            recording_command.arguments({**good, field: value})
    path = recording_command.record(**recording_command.arguments(good))
    with pytest.raises(InputError, match="data set already"):
        recording_command.arguments({**good, "problem": {"_target_": "ocp_torch.problems.Dataset", "path": str(path)}})


@pytest.mark.nightly
def test_twenty_thousand_samples_certify_the_optimum(tmp_path):
    """A shortened run; the defaults do better."""
    problem = Manufactured()
    path = record(tmp_path, problem, 20000)
    overrides = ("problem=dataset", f"problem.path={path}", "method=dual", "trainer.steps=600", "trainer.batch=256")
    overrides += ("model.width=48", "model.modes=2", "optimizer.lr=0.01", "certificate.stage.steps=300")
    overrides += ("certificate.stage.rounds=1", f"method.occupation_bound={2 * problem.occupation_bound}")
    certificate = session(small(*overrides), tmp_path / "run")
    (_, low), (_, high) = certificate.best_lower, certificate.best_upper
    assert low <= problem.exact_optimum <= high
    assert certificate.gap["certified"] <= 0.06


@pytest.mark.parametrize("name", ["manufactured 2-d B(x)", "noisy 2-d sigma(x)"])
def test_a_divergence_of_another_column_is_told(tmp_path, monkeypatch, name):
    """A drift, a control matrix or noise whose coordinates are in another order than the divergences beside them; of so many
    samples every second is looked at."""
    monkeypatch.setattr(plausible, "TESTED", 2000)
    path = record(tmp_path, zoo.build(name), 4000)
    arrays = arrays_of(path)
    assert recording.read(path).notes == ()
    told = {"a": "div_a", "B": "div_B"} if "B(x)" in name else {"a": "div_a", "noise": "div_D"}
    for column, divergence in told.items():
        np.savez(tmp_path / "a.npz", **{**arrays, column: arrays[column][:, ::-1]})
        notes = recording.read(tmp_path / "a.npz").notes
        assert f"{divergence} of a.npz is not the divergence of its {column}" in notes[0]


@pytest.mark.parametrize("noise", [0.0, 1e-7])
def test_copies_among_the_samples_are_left_out(tmp_path, plain, noise):
    arrays = arrays_of(plain)
    twice = {name: np.concatenate([a, a[:50]]) if a.ndim else a for name, a in arrays.items()}
    twice["x"][1500:] = (twice["x"][1500:] + noise * np.random.default_rng(0).standard_normal((50, 2))) % 1.0
    np.savez(tmp_path / "twice.npz", **twice)
    found = recording.read(tmp_path / "twice.npz")
    assert found.notes == ("50 samples of twice.npz are at the state of another, and are left out.",)
    assert torch.equal(found.samples.x, recording.read(plain).samples.x)


@pytest.mark.parametrize("dim", [1, 2, 6])
@pytest.mark.parametrize("contrast", [0.0, 0.9])
def test_independent_draws_in_single_precision_are_no_copies(tmp_path, dim, contrast):
    """Among 20,000 states of a circle in single precision some are the same; of three times 7,000 nearly two in three are
    copies under a little noise, and left out or told."""
    path = record(tmp_path, Manufactured(dim=dim), 20000, contrast=contrast)
    arrays = {name: a.astype(np.float32) for name, a in arrays_of(path).items()}
    np.savez(tmp_path / "a.npz", **arrays)
    found = recording.read(tmp_path / "a.npz")
    assert found.notes == ()
    assert len(found.samples) == 20000
    rows = np.arange(21000) % 7000
    noise = np.random.default_rng(0).standard_normal((21000, dim))
    for size in (1e-8, 1e-7):
        again = {name: a[rows] if a.ndim else a for name, a in arrays_of(path).items()}
        again["x"] = (again["x"] + size * noise) % 1.0
        np.savez(tmp_path / "again.npz", **again)
        notes = recording.read(tmp_path / "again.npz").notes
        assert all("of again.npz are" in note for note in notes)
        assert 11000 < sum(int(note.split()[0].replace(",", "")) for note in notes) < 14100  # a few by chance


@pytest.mark.parametrize(("dim", "same"), [(1, 19000), (2, 400), (3, 0)])
def test_independent_draws_in_three_decimals_are_all_kept(tmp_path, dim, same):
    """Most of those on a circle are at the state of another: without these the others would follow another law."""
    arrays = arrays_of(record(tmp_path, Manufactured(dim=dim), 20000, contrast=0.9))
    np.savez(tmp_path / "a.npz", **{**arrays, "x": arrays["x"].round(3)})
    found = recording.read(tmp_path / "a.npz")
    assert len(found.samples) == 20000
    assert all("at the state of another, as x has few digits" in note for note in found.notes)
    assert sum(int(note.split()[0].replace(",", "")) for note in found.notes) == pytest.approx(same, rel=0.05)


def test_states_along_a_path_are_no_copies(tmp_path):
    """Consecutive ones of twelve coordinates are .04 apart, which is nearer than chance explains: that is told."""
    x = (0.01 * np.arange(20000)[:, None] * np.sqrt([2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37])) % 1.0
    one = np.ones(len(x))
    np.savez(tmp_path / "a.npz", x=x, f=one, a=0.0 * x, B=np.ones((len(x), 12, 1)), discount=1.0)
    found = recording.read(tmp_path / "a.npz")
    assert len(found.samples) == 20000
    assert any("nearer to another than chance explains" in note for note in found.notes)


def test_a_violation_that_only_trained_samples_show_is_in_the_interval(tmp_path):
    """`f` is 1, and 0 in a hole that no held-out sample met: `OPT` is .999, and `V = 1` has no slack elsewhere."""
    for seed in range(20):
        x = np.random.default_rng(seed).random((4000, 1))
        f = np.where(np.abs(x[:, 0] - 0.37) < 5e-4, 0.0, 1.0)
        np.savez(tmp_path / "hole.npz", x=x, f=f, a=0.0 * x, B=np.full((4000, 1, 1), 1e-9), discount=2.0)
        problem = Dataset(str(tmp_path / "hole.npz"))
        if bool((problem.held_out.f > 0.5).all()) and not bool((problem.training.f > 0.5).all()):
            break
    settings = CertificateSettings(stage=StageSettings(steps=0))
    trained = Trained(Fields({"value": Exactly(lambda x: torch.ones_like(x[:, 0]))}), None, PeriodicMLP)
    constants = resolve_constants(problem, occupation_bound=1.25)
    found = certify_fields(problem, trained, constants, settings, Run("dataset", "dual")).lower["F_M"]
    assert found.value == 1.0
    assert found.interval(0.95)[0] <= 0.999


@pytest.mark.parametrize("factor", [0.75, 1.4])
def test_a_factor_that_a_start_density_has_too_much_moves_no_bound(tmp_path, factor):
    """So few samples do not show that a narrow `mu0` integrates to 0.75 or 1.4: `F_M` at the exact `V` was so many times
    `OPT`, beyond its interval."""
    problem = zoo.build("manufactured 2-d mu0")
    with np.load(record(tmp_path, problem, 6000)) as arrays:
        plain = dict(arrays)
    values = problem.exact_value(torch.from_numpy(plain["x"])).numpy()
    away = plain["x"] - plain["x"][values.argmax()]
    near = np.abs(away - away.round()).max(axis=1) < 0.1
    np.savez(tmp_path / "narrow.npz", **{**plain, "mu0": factor * near / near.mean()})
    data, true = Dataset(str(tmp_path / "narrow.npz")), float(values[near].mean())
    low, high = certificate_of(data, problem, 0).lower["F_M"].interval(0.95)
    assert low <= true <= high
    assert high - low < 0.2 * true


def test_a_single_start_among_the_samples_is_no_level_without_scatter(tmp_path):
    """Of mass 1 at one row: where that is trained on, the held-out ones show none, and the interval was of width 0."""
    problem = zoo.build("manufactured 2-d mu0")
    with np.load(record(tmp_path, problem, 6000)) as arrays:
        plain = dict(arrays)
    for row in range(3):
        mu0 = np.zeros(6000)
        mu0[997 * row] = 6000.0
        np.savez(tmp_path / "one.npz", **{**plain, "mu0": mu0})
        low, high = certificate_of(Dataset(str(tmp_path / "one.npz")), problem, 0).lower["F_M"].interval(0.95)
        assert low <= 0.0 or high - low > 0.1


@pytest.mark.parametrize("name", ["f", "a", "B", "mu0"])
def test_a_column_whose_rows_are_in_another_order_is_told(tmp_path, name):
    """The mean of `V` by a start density in another order is that over all states: `F_M` was above `OPT` without a word."""
    problem = zoo.build("manufactured 2-d B(x)" if name == "B" else "manufactured 2-d mu0")
    with np.load(record(tmp_path, problem, 3000, divergences=False)) as arrays:
        plain = dict(arrays)
    if name == "mu0":
        values = problem.exact_value(torch.from_numpy(plain["x"])).numpy()
        cheap = values < np.quantile(values, 0.2)
        plain["mu0"] = cheap / cheap.mean()
    np.savez(tmp_path / "right.npz", **plain)
    assert not [note for note in Dataset(str(tmp_path / "right.npz")).recording.notes if "nothing to do with x" in note]
    np.savez(tmp_path / "wrong.npz", **{**plain, name: np.roll(plain[name], 7, axis=0)})
    data = Dataset(str(tmp_path / "wrong.npz"))
    assert [note for note in data.recording.notes if note.startswith(f"{name} of wrong.npz has nothing to do with x")]
    if name == "mu0":
        found = certificate_of(data, problem, 0)
        assert found.lower["F_M"].interval(0.95)[0] > float(values[cheap].mean())
        assert any("nothing to do with x" in warning for warning in found.warnings)


@pytest.mark.parametrize("dim", [1, 4, 9, 16])
def test_functions_of_the_state_are_not_taken_for_rows_in_another_order(tmp_path, dim):
    """Waves, a step, a narrow start; and rounding of what is constant."""
    draw = np.random.default_rng(dim).random
    for count in (120, 5000):
        x = draw((count, dim))
        f = 1.0 + np.cos(2.0 * np.pi * x).mean(axis=1)
        a = np.stack([np.where(x[:, k] < 0.3, 0.1, 0.2) for k in range(dim)], axis=1)
        near = np.abs(x[:, 0] - 0.4) < 0.04
        B = 1.0 + 1e-7 * draw((count, dim, 1))
        mu0 = near / near.mean()
        np.savez(tmp_path / "data.npz", x=x, f=f, a=a, B=B.astype(np.float32), mu0=mu0, discount=1.0)
        told = Dataset(str(tmp_path / "data.npz"), held_out=0.3).recording.notes
        assert not [note for note in told if "nothing to do with x" in note]


@pytest.mark.parametrize("order", ["Sobol", "lattice"])
def test_evenly_spread_states_in_their_order_are_not_taken_for_rows_in_another(tmp_path, order):
    axis = torch.arange(64, dtype=torch.float64) / 64
    x = torch.cartesian_prod(axis, axis) if order == "lattice" else scrambled_sobol(4096, 2, 0, torch.float64)
    for k in range(2):
        f = 1.0 + (2.0 * math.pi * x[:, k]).cos()
        np.savez(tmp_path / "data.npz", x=x, f=f, a=0.0 * x, B=torch.ones(4096, 2, 1), discount=1.0)
        told = Dataset(str(tmp_path / "data.npz")).recording.notes
        assert not [note for note in told if "nothing to do with x" in note]
