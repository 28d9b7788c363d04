"""A run of a natural problem leaves its numbers and its picture beside the certificate, and its controller loads again."""

import json

import pytest
import torch

from ocp_torch.control.saved import load_controller
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.runs.build import build_problem
from ocp_torch.runs.metrics.trial import METRICS, metrics
from support.small import configured, session, small

NEW = [
    "acrobot",
    "pendubot",
    "quadrotor",
    "satellite",
    "cart_pole",
    "double_integrator",
    "inverted_double_pendulum",
    "mountain_car",
    "phase_locked_loop",
]
pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")


@pytest.mark.nightly
def test_a_run_leaves_numbers_and_a_picture(tmp_path):
    session(small("problem=double_integrator", "method=dual"), tmp_path)
    assert (tmp_path / "figures" / "motion.png").stat().st_size > 0
    found = json.loads((tmp_path / METRICS).read_text())
    assert {"controller", "zero", "classical"} <= found.keys()
    controller = load_controller(tmp_path / "controller.safetensors")
    assert metrics(controller.problem, controller.policy, derive_seed(0, Branch.METRICS)) == found


@pytest.mark.nightly
def test_a_run_without_simulations_has_no_numbers(tmp_path):
    session(
        small("problem=double_integrator", "method=dual", "certificate.trajectories=0", "trainer.figures=false"),
        tmp_path,
    )
    assert not (tmp_path / METRICS).exists()


@pytest.mark.parametrize(
    "problem", ["kuramoto", "phase_neurons", "arm", "unicycle", "dubins", "pendulum", "robot", *NEW]
)
def test_files_and_classes_agree_on_the_defaults(problem):
    """What a file says is what the class does without one."""
    built = build_problem(configured(f"problem={problem}")["problem"])
    again = type(built)()
    assert built.parameters == again.parameters
    x = torch.rand(20, built.dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.equal(built.state_cost(x), again.state_cost(x))
