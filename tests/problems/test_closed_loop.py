"""A problem with its controller: the data of an uncontrolled system."""

import pytest
import torch

from ocp_torch.problems import Arm, Circle, Manufactured, Pendulum
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.samples import Samples

PROBLEMS = {
    "circle": Circle,
    "arm": lambda: Arm(dim=2),
    "pendulum": Pendulum,
    "B varies, q = 1.5": lambda: Manufactured(dim=3, control_dim=2, exponent=1.5, state_dependent_control=True),
}


@pytest.mark.parametrize("made", PROBLEMS.values(), ids=PROBLEMS)
@pytest.mark.parametrize("divergences", [True, False])
def test_samples_ask_the_controller_once(made, divergences):
    problem, asked = made(), []

    def policy(x):
        asked.append(len(x))
        return 0.3 * torch.sin(2.0 * torch.pi * x[:, :1]).expand(-1, problem.control_dim)

    loop, x = ClosedLoop(problem, policy), torch.rand(20, problem.dim, dtype=torch.float64)
    samples = Samples.of(loop, x, divergences=divergences)
    assert asked == [20]
    torch.testing.assert_close(samples.f, loop.state_cost(x))
    torch.testing.assert_close(samples.a, loop.drift(x))
    if divergences:
        torch.testing.assert_close(samples.div_a, loop.drift_divergence(x))
    else:
        assert samples.div_a is None
    asked.clear()
    at = x.clone().requires_grad_(True)
    live = Samples.live(loop, at)
    assert asked == [20]
    (slope,) = torch.autograd.grad(live.f.sum() + live.a.sum(), at)
    moved = [Samples.of(loop, x + step, divergences=False) for step in (1e-6, -1e-6)]
    along = ((moved[0].f + moved[0].a.sum(dim=-1)) - (moved[1].f + moved[1].a.sum(dim=-1))) / 2e-6
    torch.testing.assert_close(slope.sum(dim=-1), along, rtol=1e-4, atol=1e-4)
