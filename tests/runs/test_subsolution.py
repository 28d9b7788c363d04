"""What a run's lower bound is of lies beside its controller: the bound is evaluated again, and nothing trained again."""

import copy
import json

import pytest
import torch

from ocp_torch import load_controller
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.errors import InputError
from ocp_torch.fields import Subsolution
from ocp_torch.files.storage import load_tensors, save_tensors
from ocp_torch.problems import Circle
from ocp_torch.runs.build import build_certificate_settings
from ocp_torch.runs.evaluate import certify_saved
from ocp_torch.runs.external import certify
from support.small import session, small

pytestmark = pytest.mark.usefixtures("quick_composition")

QUICK = (
    "certificate.points=128",
    "certificate.replicates=2",
    "certificate.trajectories=0",
    "certificate.ascents=2",
    "certificate.occupation_states=0",
    "certificate.stage.steps=0",
    "certificate.tolerance=0.1",
    "trainer.figures=false",
)
TIGHTENED = "ocp_torch.certificate.lower.tightened"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Its bound is of `V` trained on: of any gain."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{TIGHTENED}.PLAN", (100.0, 60, 1e-2))
        patch.setattr(f"{TIGHTENED}.BATCH", 64)
        patch.setattr("ocp_torch.certificate.lower.sampled.LEAST_PROMISE", 0.0)
        certificate = session(small("certificate.mollify=true", *QUICK), folder)
    assert any("tightened" in line for line in certificate.searches)
    return folder


@pytest.fixture
def untrained(monkeypatch):
    """Whoever trains `V` for a bound fails."""

    def trained(*_):
        raise AssertionError("V is trained on for its bound")

    monkeypatch.setattr("ocp_torch.certificate.lower.sampled.tightened", trained)


def again(folder, seed=None) -> dict:
    controller = load_controller(folder / "controller.safetensors")
    return certify_saved(controller, build_certificate_settings(controller.config), seed).to_dict()


@pytest.mark.usefixtures("untrained")
def test_the_bound_is_evaluated_again_without_training(run):
    written = json.loads((run / "certificate.json").read_text())
    same, fresh = again(run), again(run, seed=7)
    assert same["lower"] == written["lower"]
    assert fresh["lower"] != written["lower"]
    assert fresh["lower"]["shifted"]["value"] <= written["exact"] + 5.0 * fresh["lower"]["shifted"]["se"]


@pytest.mark.usefixtures("untrained")
def test_it_bounds_how_far_another_controller_is_from_the_optimum(run):
    controller = load_controller(run)
    settings = build_certificate_settings(controller.config)
    nothing = lambda x: torch.zeros(len(x), 1)
    found = certify(controller.problem, nothing, controller, settings)
    assert any("tightened" in line for line in found.searches)


def test_of_another_problem_it_says_nothing(run, untrained):
    controller = load_controller(run)
    settings = build_certificate_settings(controller.config)
    other = Circle(discount=2.0 * controller.problem.discount)
    with pytest.raises(AssertionError, match="trained on"):
        certify(other, lambda x: torch.zeros(len(x), 1), controller, settings)


def test_where_v_itself_gives_the_bound_nothing_lies_beside_it(tmp_path):
    session(small(*QUICK), tmp_path)
    assert load_controller(tmp_path).fields.subsolution is None


def test_the_controller_is_what_it_is_without_in_a_file_of_the_schema_before(run, tmp_path):
    tensors, metadata = load_tensors(run / "controller.safetensors")
    kept = {name: t for name, t in tensors.items() if "subsolution" not in name}
    metadata["fields"].remove("subsolution")
    metadata["schema"] = 1
    save_tensors(tmp_path / "controller.safetensors", kept, metadata)
    x = torch.rand(50, 1, dtype=torch.float64)
    assert torch.equal(load_controller(run)(x), load_controller(tmp_path)(x))


@pytest.mark.parametrize(
    ("worst", "words"),
    [
        (None, "KeyError"),
        (torch.tensor(1.0), "0-d"),
        (torch.zeros(3), "does not fit"),
        (torch.zeros(3, 2), "does not fit"),
        (torch.full((3, 1), float("nan")), "not finite"),
    ],
)
def test_states_that_are_none_are_refused_in_one_sentence(run, tmp_path, worst, words):
    tensors, metadata = load_tensors(run / "controller.safetensors")
    name = "networks.subsolution.worst"
    tensors = {**tensors, name: worst} if worst is not None else {k: t for k, t in tensors.items() if k != name}
    save_tensors(tmp_path / "controller.safetensors", tensors, metadata)
    with pytest.raises(InputError, match=words) as error:
        load_controller(tmp_path)
    assert "\n" not in str(error.value)


def taught(value, steps: int = 300):
    """A network of the weights of ``value`` trained towards the exact `V` of the circle."""
    network, exact = copy.deepcopy(value).double().requires_grad_(True), Circle().exact_value
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    x = torch.linspace(0.0, 1.0, 257, dtype=torch.float64).unsqueeze(1)
    for _ in range(steps):
        optimizer.zero_grad()
        (network(x) - exact(x)).square().mean().backward()
        optimizer.step()
    return network.requires_grad_(False)


def test_its_controller_is_handed_out_where_it_is_the_best(tmp_path, monkeypatch):
    def training(problem, value, *_):
        with torch.enable_grad():
            return Subsolution(taught(value), torch.zeros(0, 1, dtype=torch.float64))

    monkeypatch.setattr("ocp_torch.certificate.lower.sampled.tightened", training)
    monkeypatch.setattr("ocp_torch.certificate.lower.sampled.LEAST_PROMISE", 0.0)
    how = [setting for setting in QUICK if "trajectories" not in setting]
    how += ["method=dual", "certificate.mollify=true", "certificate.trajectories=16", "trainer.steps=2"]
    certificate = session(small(*how), tmp_path)
    controller = load_controller(tmp_path)
    assert certificate.controller == controller.kind == "subsolution"
    assert certificate.perf["subsolution"].above < certificate.perf["value"].above
    x = torch.rand(50, 1, dtype=torch.float64)
    W = controller.fields.subsolution.double()
    assert torch.allclose(controller(x), ValuePolicy(controller.problem, W)(x))
    assert torch.allclose(controller.held(x, 1e-6), controller(x), atol=1e-3)  # of the same function
    assert again(tmp_path)["controller"] == "subsolution"


@pytest.mark.nightly
@pytest.mark.usefixtures("untrained")
def test_without_any_state_beside_it_is_a_bound_too(run, tmp_path):
    tensors, metadata = load_tensors(run / "controller.safetensors")
    name = "networks.subsolution.worst"
    save_tensors(tmp_path / "controller.safetensors", {**tensors, name: tensors[name][:0]}, metadata)
    found = again(tmp_path)["lower"]["shifted"]
    assert found["value"] == pytest.approx(again(run)["lower"]["shifted"]["value"], rel=1e-3)
