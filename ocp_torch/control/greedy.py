r"""The control that is best for a whole step, during which it is held.

The greedy control at a state, `grad R*(-B^T grad V / rho)`, is best for an instant. Where `V` bends sharply, as across the
path to a goal, an instant later it may be the opposite: held for a step it overshoots, and applied at all times it trembles.
"""

import math

import torch
from torch import Tensor

from ocp_torch.control.pace import Pace
from ocp_torch.maths.jets import Field, Jet, jet
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.generator import pull_back
from ocp_torch.problems.problem import Problem

# Newton steps for the part of the control that is kept, which has no closed form unless the exponent is 2: four leave less
# than a millionth of its cost.
NEWTON_STEPS = 4


class HeldPolicy:
    r"""The candidate `u` of least `R(u) + V(x_h(u)) / (rho h)`, with `x_h` the state a step of ``pace`` later.

    * `s u_0`, `0 <= s <= 1`, where `u_0` is the greedy control at the state that `x` drifts to without control. With `s` the
      end of the step moves from there to `x_h(u_0)`, on a straight line for a short step, and the slope of `V` along it is
      taken to change linearly: so `s` follows from the gradients at both ends, exactly for a quadratic `V`.
    * For several controls and `q = 2`: the minimiser where slopes change linearly along each control, since `V` may curve
      differently along them (a quadrotor's cost was 0.61 without, and 0.55 with it).
    * With a limit: the farthest controls along `u_0` and against it, since `s u_0` may be far from best where `V` has ridges
      (Pendulum-v1 lost 8 to 300 % of the return without, 1.7 to 5 % with them).
    * No control, where there is any candidate but the first. The control jumps where the best candidate changes.
    """

    def __init__(self, problem: Problem, value: Field, pace: Pace) -> None:
        self.problem, self.value, self.pace = problem, value, pace

    def __call__(self, x: Tensor) -> Tensor:
        """Controls ``(N, m)`` at states ``(N, d)``."""
        return self.step(x)[0]

    def step(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        """Controls ``(N, m)`` at states ``(N, d)``, and where candidates were compared the moves ``(N, d)`` under them."""
        problem, cost, a_step = self.problem, self.problem.control_cost, self.problem.discount * self.pace.step
        drifted = self.pace.drift(problem, x)
        before = jet(self.value, x + drifted)
        u = cost.argmax(-pull_back(problem.control_matrix(x), before.gradient) / problem.discount)
        moved = self.pace.move(problem, x, u)
        along = (moved - drifted) / a_step
        slopes = ((end.gradient * along).sum(dim=-1) for end in (before, jet(self.value, x + moved)))
        part = kept(cost.q, self._price(u), *slopes).unsqueeze(-1) * u
        tried = [part]
        if problem.control_dim > 1 and cost.q == 2.0:
            tried.append(self._apart(x, u, part, drifted, before))
        if not math.isinf(cost.reach):
            most = farthest(cost, u)
            tried += [most, -most]
        if len(tried) == 1:
            return part, None
        # All at once: one after the other takes twice as long for few states.
        repeated = torch.cat([x] * len(tried))
        moves = self.pace.move(problem, repeated, torch.cat(tried))
        after = self.value((repeated + moves).remainder(1.0))
        tried.append(torch.zeros_like(u))
        merits = (self._price(torch.cat(tried)) + torch.cat([after, before.value]) / a_step).chunk(len(tried))
        best, way, least = part, moves[: len(x)], merits[0]
        ways = [*moves.chunk(len(tried) - 1), drifted]
        others = zip(tried[1:], ways[1:], merits[1:], strict=True)
        for other, there, merit in others:
            better = merit < least
            best, way = (torch.where(better.unsqueeze(-1), *pair) for pair in ((other, best), (there, way)))
            least = torch.where(better, merit, least)
        return best, way

    def _apart(self, x: Tensor, u: Tensor, part: Tensor, drifted: Tensor, before: Jet) -> Tensor:
        """The minimiser ``(N, m)`` for the quadratic function with the slopes of `V` at no control, ``before``, and at each
        control alone of the size of ``u``; ``part`` where that function has no minimum."""
        a_step, size = self.problem.discount * self.pace.step, u.norm(dim=-1, keepdim=True)
        size = torch.where(size > 0.0, size, 1.0)
        along, changes = list[Tensor](), list[Tensor]()
        for axis in torch.eye(u.shape[1]).to(u):
            moved = self.pace.move(self.problem, x, size * axis)
            along.append((moved - drifted) / a_step)
            changes.append(jet(self.value, x + moved).gradient - before.gradient)
        dot = lambda a, b: (a * b).sum(dim=-1)
        bend = [
            [0.5 * (dot(a, c) + dot(b, e)) for b, c in zip(along, changes, strict=True)]
            for a, e in zip(along, changes, strict=True)
        ]
        for i, row in enumerate(bend):
            row[i] = row[i] + size[:, 0].square()
        steps, bends_up = solved(bend, [-dot(a, before.gradient) for a in along])
        found = self.problem.control_cost.within(size * torch.stack(steps, dim=-1), 1.0)
        return torch.where(bends_up.unsqueeze(-1), found, part)

    def _price(self, u: Tensor) -> Tensor:
        """`R(u)` of controls within the limit, without the infinite cost of those that rounding puts beyond it."""
        return PowerCost(self.problem.control_cost.q).cost(u)


def solved(matrix: list[list[Tensor]], right: list[Tensor]) -> tuple[list[Tensor], Tensor]:
    """The solutions of `N` symmetric systems, whose entries are ``(N,)``, and where the matrix is positive definite: other
    solutions mean nothing. By elimination, in operations that can be exported."""
    rows, m = [[*row, b] for row, b in zip(matrix, right, strict=True)], len(right)
    definite = torch.ones_like(right[0], dtype=torch.bool)
    for i in range(m):
        definite = definite & (rows[i][i] > 0.0)
        pivot = torch.where(rows[i][i] > 0.0, rows[i][i], 1.0)
        rows[i] = [entry / pivot for entry in rows[i]]
        for j in range(m):
            if j != i:
                rows[j] = [entry - rows[j][i] * own for entry, own in zip(rows[j], rows[i], strict=True)]
    return [row[m] for row in rows], definite


def farthest(cost: PowerCost, u: Tensor) -> Tensor:
    """The largest controls within the limit of ``cost`` in the direction of each of ``u`` ``(N, m)``; 0 where that is 0."""
    size = u.norm(dim=-1, keepdim=True)
    return cost.within(2.0 * cost.reach * u / torch.where(size > 0.0, size, 1.0), 1.0)


def kept(q: float, cost: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """The `s` in [0, 1] at which `R(s u) + int_0^s (start + t (end - start)) dt` is least, `R(u)` being ``cost``; ``(N,)``.

    The derivative, `q R(u) s^{q - 1} + start + s (end - start)`, is 0 there, or negative up to 1. Where `V` bends down along
    the way all is kept."""
    bend = (end - start).clamp_min(0.0)
    price = q * cost
    inside = (start < 0.0) & (price + start + bend > 0.0)
    outside = torch.where(start < 0.0, 1.0, 0.0).to(start)
    # Only where the minimum is inside, so that nothing is divided by 0.
    price, bend, fall = (torch.where(inside, part, 1.0) for part in (price, bend, -start))
    if q == 2.0:
        return torch.where(inside, fall / (price + bend), outside)
    # In t = s^{q - 1} the derivative is convex, and Newton's method descends to its zero from above.
    power = 1.0 / (q - 1.0)
    tiny = torch.finfo(start.dtype).tiny
    t = torch.minimum(fall / price.clamp_min(tiny), (fall / bend.clamp_min(tiny)) ** (q - 1.0)).clamp_max(1.0)
    for _ in range(NEWTON_STEPS):
        bent = bend * t ** (power - 1.0)
        t = t - (price * t + bent * t - fall) / (price + power * bent)
    return torch.where(inside, t.clamp(0.0, 1.0) ** power, outside)
