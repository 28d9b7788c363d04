"""Values, gradients and their slopes in the weights, written out, against autograd's, in float64 to 12 digits."""

import pytest
import torch

from ocp_torch.fields import PeriodicMLP, reverse_sweep
from ocp_torch.fields.activations import ACTIVATIONS
from ocp_torch.maths.jets import jet, reverse_jet

CLOSE = dict(rtol=1e-12, atol=1e-12)


def network(dim: int, **form) -> PeriodicMLP:
    """With features of several coordinates, and a head that is not small."""
    torch.manual_seed(dim)
    made = PeriodicMLP(dim, modes=2, width=10, waves=3, shift=0.4, scale=1.7, **form)
    made.embedding.mix(torch.randint(-2, 3, (2, dim)).float() + 0.5)  # one place stays free
    torch.nn.init.normal_(made.head.weight)
    return made.double()


def loss(of) -> torch.Tensor:
    """One whose slopes in values and gradients differ from state to state."""
    return (of.value.sin() + (of.gradient.square().sum(dim=-1) + 1.0).sqrt() * of.value).mean()


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(("dim", "depth"), [(1, 1), (1, 3), (3, 2)])
def test_the_sweep_back_is_autograds(dim, depth, activation, gated):
    field, x = (
        network(dim, depth=depth, activation=activation, gated=gated),
        torch.rand(17, dim, dtype=torch.float64) - 3.0,
    )
    weights = list(field.parameters())
    here, there = field.jet(x), reverse_jet(field, x)
    for found, expected in ((here.value, field(x)), (here.value, there.value), (here.gradient, there.gradient)):
        torch.testing.assert_close(found, expected, **CLOSE)
    expected = torch.autograd.grad(loss(there), weights)
    for _ in range(2):  # the graph may be gone through again
        found = torch.autograd.grad(loss(here), weights, retain_graph=True)
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, **CLOSE)
    with torch.no_grad():
        assert torch.equal(field.jet(x).gradient, here.gradient)


def test_a_loss_of_values_or_of_gradients_alone():
    field, x = network(2), torch.rand(5, 2, dtype=torch.float64)
    for part in ("value", "gradient"):
        sums = (getattr(of, part).square().sum() for of in (field.jet(x), reverse_jet(field, x)))
        found, expected = (
            torch.autograd.grad(total, list(field.parameters()), materialize_grads=True) for total in sums
        )
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, **CLOSE)


def test_states_can_be_differentiated_too():
    """`Q` is climbed in the state: there the gradient itself must have one."""
    field, x = network(2), torch.rand(5, 2, dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(jet(field, x).gradient.square().sum(), x)
    step = 1e-6
    with torch.no_grad():
        at = lambda y: jet(field, y).gradient.square().sum(dim=-1)
        for i, e in enumerate(torch.eye(2, dtype=torch.float64)):
            torch.testing.assert_close(
                found[:, i], (at(x + step * e) - at(x - step * e)) / (2.0 * step), rtol=1e-6, atol=1e-6
            )


def test_a_weight_that_changed_before_its_slope_was_taken_is_told():
    field, x = network(1), torch.rand(5, 1, dtype=torch.float64)
    total = field.jet(x).gradient.sum()
    with torch.no_grad():
        field.head.weight.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


@pytest.mark.parametrize("noisy", [False, True])
def test_who_computes_something_else_is_not_swept(noisy):
    class Doubled(PeriodicMLP):
        def forward(self, x):
            return 2.0 * super().forward(x)

    torch.manual_seed(0)
    field, x = Doubled(2, modes=2, width=8).double(), torch.rand(5, 2, dtype=torch.float64)
    sigma = torch.rand(5, 2, 2, dtype=torch.float64) if noisy else None
    found, expected = field.jet(x, sigma), reverse_jet(field, x, sigma)
    assert torch.equal(found.value, field(x))
    assert torch.equal(found.gradient, expected.gradient)


def test_frozen_networks_and_no_graphs():
    field, x = network(2).requires_grad_(False), torch.rand(5, 2, dtype=torch.float64)
    assert not field.jet(x).gradient.requires_grad
    assert field.requires_grad_(True).jet(x).gradient.grad_fn is not None


@pytest.mark.parametrize("gated", [False, True])
def test_products_of_slopes_are_had_without_the_slopes(gated, monkeypatch):
    """In strips of rows, below the diagonal."""
    monkeypatch.setattr(reverse_sweep, "STRIP_STATES", 4)
    field, x = network(2, gated=gated), torch.rand(11, 2, dtype=torch.float64)
    of_value, of_gradient = torch.randn(11, dtype=torch.float64), torch.randn(11, 2, dtype=torch.float64)
    of = reverse_jet(field, x)
    each = of_value * of.value + (of_gradient * of.gradient).sum(dim=-1)
    slopes = [torch.autograd.grad(e, list(field.parameters()), retain_graph=True) for e in each]
    rows = torch.stack([torch.cat([s.flatten() for s in own]) for own in slopes])
    with torch.no_grad():
        sweep = reverse_sweep.ReverseSweep(field, x)
        sweep.jet()
        sweep.turn(of_value, of_gradient)
        torch.testing.assert_close(sweep.products().tril(), (rows @ rows.T).tril(), **CLOSE)
