"""A run of a problem in physical units, as its user writes it: trained, drawn and loaded with the names and units he gave."""

import json

import pytest
import torch

from ocp_torch import load_controller
from ocp_torch.certificate.report import table
from ocp_torch.problems import Circle, Pendulum, Unicycle
from ocp_torch.runs.figures import FieldFigures
from ocp_torch.runs.frame import frame_of
from ocp_torch.runs.metrics.trial import metrics, random_starts
from ocp_torch.runs.pictures.picture import motion
from support.small import session, small
from support.systems import Cart, Conveyor, Swing

pytestmark = pytest.mark.usefixtures("quick_composition")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    cheap = ("certificate.mollify=false", "certificate.occupation_states=0", "certificate.stage.steps=0")
    own = (
        "certificate.trajectories=32",
        "certificate.tolerance=0.1",
        "certificate.replicates=2",
        "warm_start.mode=off",
        "problem._target_=support.systems.Swing",
        "problem.control_limit=2.0",
    )
    trainer = small(*own, *cheap, "trainer.figures=true")
    session(trainer, folder)
    return folder, trainer


def test_it_trains_and_leaves_a_controller_in_physical_units(run):
    folder, trainer = run
    controller = load_controller(folder / "controller.safetensors", problem=Swing(control_limit=2.0))
    s = torch.tensor([[0.5, 1.0], [-1.0, 3.0]], dtype=torch.float64)
    u = controller.physical(s)
    assert u.shape == (2, 1)
    problem = trainer.problem
    torch.testing.assert_close(u, problem.from_controls(controller(problem.to_torus(s))))


def test_its_certificate_says_what_part_of_the_time_is_outside(run):
    certificate = json.loads((run[0] / "certificate.json").read_text())
    outside = certificate["outside_box"]
    assert 0.0 <= outside["value"] <= 1.0
    assert outside["interval"][0] <= outside["value"] <= outside["interval"][1]
    assert "outside the box: " in table(certificate)
    warned = any("outside the box of velocity" in note for note in certificate["warnings"])
    assert warned == (outside["value"] > 0.01)


def test_its_figures_have_names_and_units_on_their_axes(run):
    _, trainer = run
    figures = FieldFigures(
        trainer.problem, trainer.averaged_fields, trainer.constants, trainer.objective.occupation
    ).figures()
    (axis, *_) = figures["value"].axes
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("angle [rad]", "velocity [rad/s]")
    assert axis.get_ylim() == pytest.approx((-10.0, 10.0))
    assert figures["control_value"].axes[0].get_title() == "u from V, torque [N m]"
    moving = motion(trainer.problem, lambda x: torch.zeros_like(x[:, :1]))
    assert (moving.axes[0].get_xlabel(), moving.axes[0].get_ylabel()) == ("angle [rad]", "velocity [rad/s]")


@pytest.mark.parametrize("problem", [Swing(), Conveyor(), Pendulum(), Circle(), Unicycle()])
def test_a_frame_maps_what_is_drawn_to_its_place(problem):
    """States are drawn where they are: in the middle of a system's frame is its centre."""
    frame = frame_of(problem)
    x = frame.line(41) if problem.dim == 1 else frame.map(8)
    places = frame.places(x)
    expected = x if isinstance(problem, Circle) else problem.from_torus(x.remainder(1.0))
    # Both ends of a line are the same state.
    torch.testing.assert_close(places[1:-1], expected[1:-1])


def test_numbers_and_pictures_start_in_the_box():
    problem = Cart(start={"spin": (-1.0, 1.0)})
    x = random_starts(problem, 100, 0)
    assert bool((problem.from_torus(x)[:, 2].abs() <= 1.0).all())
    assert not problem.outside(x).any()
    conveyor = Conveyor(start={"place": (0.0, 1.0)}, discount=4.0)
    stay = lambda x: conveyor.to_controls(torch.full_like(x, -1.0))
    found = metrics(conveyor, stay, starts=16)
    assert found["controller"]["inside"] == 1.0
    assert metrics(Conveyor(start={"place": (0.0, 1.0)}, discount=1.0), stay, starts=16)["zero"]["inside"] == 0.0
