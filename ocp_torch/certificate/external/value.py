"""A given `V`, a function of PyTorch's: is it continuous, and is its gradient that of the function?

A lower bound judges by values and derivatives at states whether `V` is a subsolution. Without noise kinks do no harm, since
the Hamiltonian is convex; a `V` that jumps, or whose gradient is another function's, is none. With noise the gradient must
not jump.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ocp_torch.certificate.checks.observed import largest_jump
from ocp_torch.errors import InputError
from ocp_torch.maths.jets import Field
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import in_parts, value_and_gradient
from ocp_torch.problems.blame import place
from ocp_torch.problems.problem import Problem

SEGMENTS = 128  # along which the gradient is integrated
SHORTEST, LONGEST = 0.05, 0.5  # lengths of the segments
ON_SEGMENT = 256  # random states, one in each of as many parts: a kink makes the integral wrong by a 256th at most
# A gradient is another function's where its integral is off by more than this part of all that changes, on average: random
# states make it off by a sixteenth where the sign is random.
OFF_IN_MEAN = 0.1
OFF_ON_ONE = 0.3  # or by this part of the largest change on a single segment


class Periodic:
    """``value`` ``(N, d) -> (N,)``, evaluated in the unit cell only."""

    def __init__(self, value: Field) -> None:
        self.value = value

    def __call__(self, x: Tensor) -> Tensor:
        return self.value(x.remainder(1.0))


def require_differentiable(value: Field, problem: Problem) -> None:
    """Raise `InputError` where ``value`` jumps, or its derivatives by autograd are another function's; with noise also where
    its gradient jumps."""
    continuous = "a lower bound needs it to be continuous, also where a coordinate passes from 1 to 0"
    _require_continuous(lambda x: value(x).unsqueeze(-1), problem, f"value jumps by {{}}; {continuous}.")
    _require_derivative(lambda x, v: value(x), problem, "value", "gradient")
    if problem.noisy:
        slope = lambda x: value_and_gradient(value, x)[1]
        _require_continuous(slope, problem, f"the gradient of value jumps by {{}}; with noise {continuous}.")
        _require_derivative(partial(_along, value), problem, "the gradient of value", "derivative")


def _require_continuous(function: Field, problem: Problem, sentence: str) -> None:
    jump = largest_jump(function, problem.dim)
    if jump.size > 0.0:
        raise InputError(sentence.format(f"{jump.size:.3g} at {place(jump.x)}"))


def _require_derivative(function: Callable[[Tensor, Tensor], Tensor], problem: Problem, what: str, its: str) -> None:
    """Raise `InputError` where the derivative by autograd of ``function``, which maps states and directions, each ``(N, d)``,
    to ``(N,)``, does not integrate to its changes."""
    draw = partial(torch.rand, dtype=torch.float64, generator=fixed_generator())
    x = draw(SEGMENTS, problem.dim)
    v = normalize(draw(SEGMENTS, problem.dim) - 0.5) * (SHORTEST + (LONGEST - SHORTEST) * draw(SEGMENTS, 1))
    change = (function(x + v, v) - function(x, v)).detach()
    parts = (torch.arange(ON_SEGMENT, dtype=torch.float64) + draw(SEGMENTS, ON_SEGMENT)) / ON_SEGMENT
    inside = (x.unsqueeze(1) + parts.unsqueeze(-1) * v.unsqueeze(1)).flatten(0, 1)
    each = lambda at, along: value_and_gradient(lambda y: function(y, along), at)
    along = v.repeat_interleave(ON_SEGMENT, dim=0)
    slope = (in_parts(each, inside, along)[1] * along).sum(dim=-1).unflatten(0, (SEGMENTS, ON_SEGMENT))
    said, size = slope.mean(dim=1), torch.maximum(change.abs(), slope.abs().mean(dim=1))
    off = (said - change).abs()
    worst = int(off.argmax())
    if not (off.mean() <= OFF_IN_MEAN * size.mean() and off[worst] <= OFF_ON_ONE * size.max()):
        there = f"from {place(x[worst])} to {place(x[worst] + v[worst])}"
        raise InputError(
            f"the {its} of {what} by autograd is another function's: {there} it changes by {float(change[worst]):.3g}, and "
            f"by {float(said[worst]):.3g} as that says; PyTorch must see all of it."
        )


def _along(value: Field, x: Tensor, v: Tensor) -> Tensor:
    """`grad V . v`, ``(N,)``."""
    with torch.enable_grad():
        at = x if x.requires_grad else x.detach().requires_grad_(True)
        out = value(at)
        if not out.requires_grad:
            return torch.zeros_like(x[:, 0])
        (slope,) = torch.autograd.grad(out.sum(), at, create_graph=True, materialize_grads=True)
        return (slope * v).sum(dim=-1)
