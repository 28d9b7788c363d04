"""Jumps and layers of the data inside the torus: found, or seen by what they hide; what takes a divergence then falls."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from ocp_torch.certificate import Run, Trained, certify_fields
from ocp_torch.certificate.checks.hidden import Flux, hidden_divergence
from ocp_torch.certificate.checks.observed import largest_jump
from ocp_torch.certificate.statistics.estimate import replicated_samples
from ocp_torch.certificate.upper.lagrangian import closed_loop_bounds
from ocp_torch.certificate.upper.penalised import density_bounds
from ocp_torch.control.policies import CLOSED, NETWORK
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.problems import Dataset
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.samples import Samples
from support import zoo
from support.adversarial import JumpingMatrix, JumpSink
from support.formulas import Exactly
from support.honesty import BARE
from support.recorded import certificate_of, record


def log_density(dim):
    """Of a smooth density that is far from uniform; its mass does not matter."""
    return lambda x: 0.5 * (2 * torch.pi * (x - 0.1 * torch.arange(1, dim + 1).to(x))).sin().sum(dim=-1) / dim


def seen(problem, points=1024, replicates=8):
    """What the closed loop of doing nothing hides, as its bounds see it."""
    loop = ClosedLoop(problem, lambda x: torch.zeros_like(x))
    sets = [Samples.of(loop, s.x) for s in replicated_samples(problem, points, replicates, 0, divergences=False)]
    zero = lambda x: 0.0 * x[:, 0]
    return closed_loop_bounds(loop, zero, log_density(problem.dim), sets, 1, "value").hidden


SINKS = {
    "1-d": {},
    "1-d layer of 1e-7": {"width": 1e-7},
    "1-d layer of 1e-6": {"width": 1e-6},
    "2-d": {"dim": 2},
    "2-d elsewhere": {"dim": 2, "at": 0.8137},
    "2-d patch": {"dim": 2, "patch": 0.1},
    "2-d patch, layer": {"dim": 2, "patch": 0.1, "width": 1e-6},
    "3-d patch": {"dim": 3, "patch": 0.1},
    "5-d": {"dim": 5},
    "1-d slow": {"speed": 0.01},
}


@pytest.mark.parametrize("name", SINKS)
def test_what_a_jump_hides_is_seen(name):
    problem = JumpSink(**SINKS[name])
    hidden = seen(problem)
    assert hidden is not None
    if "patch" not in SINKS[name]:
        off = (hidden.x[0] - problem.at + 0.5).remainder(1.0) - 0.5
        assert abs(float(off)) < 0.1


@pytest.mark.parametrize("width", [0.1, 0.01, 1e-3])
@pytest.mark.parametrize("dim", [1, 2])
def test_a_layer_that_states_resolve_hides_nothing(dim, width):
    problem = JumpSink(dim, width)
    assert seen(problem, points=2048) is None
    assert largest_jump(lambda x: 0.0 * x, dim, problem=problem).size == 0.0


@pytest.mark.parametrize("name", [n for n in SINKS if "layer" not in n])
def test_jumps_of_the_drift_are_found(name):
    problem = JumpSink(**SINKS[name])
    found = largest_jump(lambda x: torch.full_like(x, 0.1), problem.dim, problem=problem)
    assert found.what == "drift"
    assert float(found.x[0]) == pytest.approx(problem.at, abs=1e-6)
    assert found.size <= 2.0 * problem.speed + 1e-12


def test_a_layer_too_narrow_for_any_states_is_found():
    found = largest_jump(lambda x: torch.zeros_like(x), 2, problem=JumpSink(2, width=1e-5))
    assert found.what == "drift"
    assert "changes within" in found.verb


@pytest.mark.parametrize("dim", [1, 2, 4])
def test_jumps_of_the_control_matrix_are_found(dim):
    found = largest_jump(lambda x: torch.ones_like(x), dim, problem=JumpingMatrix(dim))
    assert found.what == "control matrix"
    assert found.in_problem


def test_a_patch_where_trajectories_end_is_found():
    """Too small for lines through random states."""
    problem = JumpSink(4, patch=0.003)
    near = torch.rand(200, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    near[:, 0], near[:, 1] = 0.3, 0.5 + 0.002 * (near[:, 1] - 0.5)
    assert largest_jump(lambda x: torch.zeros_like(x), 4, problem=problem, near=near).what == "drift"


@zoo.on((*zoo.NATURAL, *zoo.FEW_SMOOTH, "swing"))
def test_no_alarm_where_there_is_no_jump(problem):
    network = zoo.rough_network(problem.dim, 3, problem.control_dim)
    assert largest_jump(network, problem.dim, problem=problem).size == 0.0
    sets = replicated_samples(problem, 256, 4, 1, divergences=True)
    density = log_density(problem.dim)
    assert density_bounds(problem, network, lambda x: density(x).exp(), sets, 2.0).hidden is None


@zoo.on(("circle rho=2", "torus 2-d chain"))
def test_a_jump_of_the_optimal_controller_is_seen_twice(problem):
    assert largest_jump(problem.exact_control, problem.dim, problem=problem).what == "controller"
    loop = ClosedLoop(problem, problem.exact_control)
    sets = [Samples.of(loop, s.x) for s in replicated_samples(problem, 512, 8, 0, divergences=False)]
    assert closed_loop_bounds(loop, problem.exact_value, log_density(problem.dim), sets, 1, "value").hidden is not None


@pytest.mark.nightly
def test_chance_alone_raises_no_alarm():
    """Two hundred random smooth fields at independent uniform states, where errors are largest."""
    alarms = 0
    for seed in range(200):
        generator = torch.Generator().manual_seed(seed)
        a, k, shift = (torch.rand(6, generator=generator, dtype=torch.float64) for _ in range(3))
        k = 2 * torch.pi * (1 + (4 * k).floor())
        fluxes = []
        for _ in range(4):
            x = torch.rand(256, 1, generator=generator, dtype=torch.float64)
            flux = (a * (k * x + 6.0 * shift).sin()).sum(dim=1, keepdim=True)
            fluxes.append(Flux(x, torch.ones(256).double(), (a * k * (k * x + 6.0 * shift).cos()).sum(dim=1), flux))
        alarms += hidden_divergence(fluxes) is not None
    assert alarms == 0


CHEAP = replace(BARE, points=4096)


def certified(problem, occupation, settings=CHEAP):
    names = ("control_density", "log_occupation") if occupation == NETWORK else ("control_density",)
    fields = Fields.build(problem, names, partial(PeriodicMLP, width=8, depth=1), 3)
    trained = Trained(fields, occupation, partial(PeriodicMLP, width=8, depth=1))
    return certify_fields(problem, trained, resolve_constants(problem), settings, Run("jump", "primal"))


@pytest.mark.nightly
@pytest.mark.parametrize("width", [0.0, 1e-6])
def test_a_drift_that_jumps_into_a_sink_has_no_upper_bound(width):
    certificate = certified(JumpSink(width=width), NETWORK)
    assert certificate.best_upper is None
    assert not certificate.assumptions.hold
    assert any("do not see" in w for w in certificate.warnings)
    assert any("the drift" in w for w in certificate.warnings)


@pytest.mark.nightly
def test_a_control_matrix_that_jumps_has_neither_J_nor_G():
    certificate = certified(JumpingMatrix(2), CLOSED)
    assert certificate.best_upper is None
    assert certificate.upper["G"] is None
    assert any("the control matrix jumps" in w for w in certificate.warnings)


def test_a_smooth_drift_keeps_its_upper_bound():
    assert certified(JumpSink(width=0.1), NETWORK).best_upper is not None


@pytest.mark.parametrize(("width", "stands"), [(0.0, False), (0.1, True)])
def test_recorded_samples_of_a_jump_give_no_upper_bound(tmp_path, width, stands):
    problem = JumpSink(width=width)
    data = Dataset(str(record(tmp_path, problem, 4000)))
    certificate = certificate_of(data, problem, 0, Exactly(lambda x: 0.0 * x[:, 0]), steps=3)
    assert (certificate.upper["J"] is not None) == stands
    assert any("do not see" in w for w in certificate.warnings) != stands
