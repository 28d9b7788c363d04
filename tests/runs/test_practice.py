"""Numbers and pictures of controlled systems: simulated right, repeatable, and telling a good controller from none."""

import math

import pytest
import torch
from PIL import Image

from ocp_torch.control.policies import zero_policy
from ocp_torch.errors import InputError
from ocp_torch.problems import Arm, Circle, Unicycle
from ocp_torch.runs.metrics.classical import classical_policy
from ocp_torch.runs.metrics.measures import admissible, measure, simulate
from ocp_torch.runs.metrics.trial import metrics, metrics_table, random_starts
from ocp_torch.runs.pictures.picture import animate, motion
from support import zoo

# Whether the number should be larger than with no control.
BETTER = {
    "arm n=2": ("success", True),
    "unicycle": ("success", True),
    "dubins": ("distance", False),
    "pendulum": ("upright", True),
    "acrobot": ("success", True),
    "pendubot": ("success", True),
    "quadrotor": ("success", True),
    "satellite": ("pointed", True),
    "kuramoto n=3": ("order_after", True),
    "kuramoto desynchronise": ("order_after", False),
    "phase neurons n=2": ("order_after", False),
    "double integrator": ("inside", True),
    "cart-pole": ("success", True),
    "inverted double pendulum": ("success", True),
    "phase-locked loop": ("locked", True),
}


@pytest.mark.nightly
@zoo.on(["circle rho=2", "manufactured 2-d mu0"])
def test_a_simulated_cost_is_the_exact_value(problem):
    """The optimal controller costs `V*` but for the tail that the discount makes small."""
    x0 = zoo.states(problem, 40, off_kinks=True)
    path = simulate(problem, problem.exact_control, x0, 12.0 / problem.discount, 1500)
    torch.testing.assert_close(path.cost, problem.exact_value(x0), rtol=1e-3, atol=1e-5)


def test_states_of_a_path_are_those_of_the_flow():
    circle = Circle()
    x0 = torch.tensor([[0.7], [0.4]], dtype=torch.float64)
    path = simulate(circle, lambda x: torch.full_like(x, 0.31), x0, 2.0, 8)
    expected = (x0 + 0.31 * path.times.reshape(-1, 1, 1)).remainder(1.0)
    torch.testing.assert_close(path.states, expected)
    assert torch.equal(path.each(lambda x: x[:, 0], late=True), path.states[-2:, :, 0])


@pytest.mark.nightly
@zoo.on(list(BETTER))
def test_the_classical_controller_does_what_no_control_does_not(request, problem):
    number, larger = BETTER[request.node.callspec.params["problem"]]
    policy = classical_policy(problem)
    found = metrics(problem, policy, seed=3, starts=48)
    gain = found["classical"][number] - found["zero"][number]
    assert gain >= 0.2 if larger else gain <= -0.2
    assert found["controller"] == found["classical"]
    assert metrics_table(found).count("\n") == 4


@pytest.mark.nightly
def test_numbers_repeat_with_a_seed_and_change_with_another():
    arm = zoo.build("arm n=2")
    found = [metrics(arm, zero_policy(arm), seed=seed, starts=16) for seed in (3, 3, 4)]
    assert found[0] == found[1]
    assert found[0]["zero"] != found[2]["zero"]


def test_problems_that_ask_for_nothing_but_a_low_cost_have_no_numbers_and_no_scene():
    circle = zoo.build("circle rho=2")
    assert metrics(circle, zero_policy(circle)) is None
    assert motion(circle, zero_policy(circle)) is None
    assert classical_policy(circle) is None


def test_starts_keep_the_clearance_where_they_can():
    arm = Arm(obstacles=[[0.5, 0.0, 0.2], [-0.5, 0.2, 0.1]])
    x = random_starts(arm, 300, seed=0)
    assert x.shape == (300, 2)
    assert bool((arm.gap(x) > arm.clearance).all())
    walled = Arm(obstacles=[[0.0, 0.0, 0.3]])  # the base is inside: no start is free
    assert not bool(admissible(walled, random_starts(walled, 20, seed=0)).any())


def test_a_path_through_an_obstacle_is_no_success_although_it_reaches_the_target():
    straight = lambda x: torch.tensor([[1.0, 0.0]], dtype=torch.float64).expand(len(x), 2)
    options = dict(target=[2.0, 2.0], speed=1.0)
    start = Unicycle(**options).to_torus(torch.tensor([[1.0, 2.0, 0.0]], dtype=torch.float64))
    results = {}
    for name, obstacles in {"free": [], "blocked": [[1.5, 2.0, 0.1]]}.items():
        unicycle = Unicycle(obstacles=obstacles, **options)
        results[name] = measure(unicycle, simulate(unicycle, straight, start, 1.0, 50))
    assert results["free"] == {"success": 1.0, "reached": 1.0, "crossed": 0.0}
    assert results["blocked"] == {"success": 0.0, "reached": 1.0, "crossed": 1.0}


@pytest.mark.nightly
@zoo.on(["arm n=2", "unicycle", "kuramoto n=3", "pendulum", "cart-pole", "inverted double pendulum"])
def test_every_system_has_a_picture_that_is_drawn(problem, tmp_path):
    figure = motion(problem, classical_policy(problem))
    figure.savefig(tmp_path / "motion.png", dpi=40)
    shades = Image.open(tmp_path / "motion.png").convert("L").getextrema()
    assert shades[0] < 100 < 250 < shades[1]
    assert all(math.isfinite(v) for axes in figure.axes for v in (*axes.get_xlim(), *axes.get_ylim()))


@pytest.mark.nightly
def test_an_animation_is_a_gif_whose_frames_differ(tmp_path, monkeypatch):
    from ocp_torch.runs.pictures import picture

    monkeypatch.setattr(picture, "STRIDE", 80)
    kuramoto = zoo.build("kuramoto n=3")
    with Image.open(animate(kuramoto, classical_policy(kuramoto), tmp_path / "phases.gif")) as gif:
        assert gif.n_frames == 3
        frames = []
        for k in range(3):
            gif.seek(k)
            frames.append(gif.convert("RGB").tobytes())
    assert len(set(frames)) == 3


def test_animations_that_cannot_be_are_refused(tmp_path):
    kuramoto, circle = zoo.build("kuramoto n=3"), zoo.build("circle rho=2")
    with pytest.raises(InputError, match="must be a file that ends in .gif"):
        animate(kuramoto, zero_policy(kuramoto), tmp_path / "phases.mp4")
    with pytest.raises(InputError, match="no picture that moves"):
        animate(circle, zero_policy(circle), tmp_path / "circle.gif")
    with pytest.raises(InputError, match="cannot be written"):
        animate(kuramoto, zero_policy(kuramoto), tmp_path / "none" / "phases.gif")
