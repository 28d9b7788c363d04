"""A controller in physical units: what it is on the torus, in the units of the user, and after a file too."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ocp_torch import Circle, InputError, load_controller
from ocp_torch.control.controller import Controller
from ocp_torch.fields import VALUE, Fields
from ocp_torch.fields.mlp import PeriodicMLP
from ocp_torch.problems.constants import Constants
from support.systems import Cart, Swing

MODEL = dict(modes=2, width=8, depth=2)


def controller_of(problem, seed=0):
    """The controller from some `V`."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        fields = Fields({VALUE: PeriodicMLP(dim=problem.dim, outputs=None, **MODEL)}).double().requires_grad_(False)
    constants = Constants(1.0, 1.0, 1.0, dict.fromkeys(("M", "C_V", "C_u"), "problem"))
    return Controller(problem, fields, constants, None, "value", {"name": "mlp", **MODEL}, {}, {})


@pytest.mark.parametrize("make", [lambda: Swing(control_weight=0.3), Cart], ids=["swing", "cart"])
def test_it_is_the_control_on_the_torus_in_physical_units(make, tmp_path):
    problem = make()
    controller = controller_of(problem)
    x = torch.rand(200, problem.dim, dtype=torch.float64)
    x = x[~problem.outside(x)]
    s, v = problem.from_torus(x), controller(x)
    u = controller.physical(s)
    torch.testing.assert_close(u, problem.from_controls(v))
    assert u.std() > 1e-4
    # What it costs is the price on the torus: half of sum_i r_i u_i^2.
    roots = torch.tensor([c["scale"] for c in problem.measures.plain["controls"]], dtype=torch.float64)
    torch.testing.assert_close(0.5 * (roots.square() * u.square()).sum(-1), problem.control_cost.cost(v))
    assert np.array_equal(controller.physical(s.numpy()), u.numpy())
    # In single precision the result is rounded, nothing before it.
    single = s.float()
    assert torch.equal(controller.physical(single), controller.physical(single.double()).float())

    controller.save(tmp_path / "controller.safetensors")
    loaded = load_controller(tmp_path / "controller.safetensors", problem=make())
    assert torch.equal(loaded.physical(s), u)


def test_beyond_the_box_it_is_what_it_is_at_the_nearest_state():
    problem = Cart()
    controller = controller_of(problem)
    s = torch.tensor([[5.0, 1.0, 0.0], [-2.3, 1.0, 9.0]], dtype=torch.float64)
    near = torch.tensor([[2.0, 1.0, 0.0], [-2.0, 1.0, 7.0]], dtype=torch.float64)
    torch.testing.assert_close(controller.physical(s), controller.physical(near))


def test_it_says_what_is_wrong():
    controller = controller_of(Cart())
    with pytest.raises(InputError, match=r"s has shape \(4, 2\), but must have shape \(N, 3\)"):
        controller.physical(torch.zeros(4, 2))
    with pytest.raises(InputError, match="the problem circle has no physical units; give states of the torus"):
        controller_of(Circle()).physical(torch.zeros(4, 1))


def test_a_file_is_loaded_with_the_units_of_its_run_alone(tmp_path):
    path = tmp_path / "controller.safetensors"
    controller_of(Cart(noisy=False)).save(path)

    class Wider(Cart):
        def __init__(self):
            super().__init__(noisy=False)
            spin = type(self.coordinates[0])("spin", -4.0, 8.0, "rad/s")
            self.measures = replace(self.measures, coordinates=(*self.coordinates[:2], spin))

    Wider.__name__ = "Cart"
    with pytest.raises(InputError, match=r"problem.coordinates is .* but the run of .* has"):
        load_controller(path, problem=Wider())
