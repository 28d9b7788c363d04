r"""Model-predictive control of a problem, with a trained `V` as the cost of everything after the horizon.

At each time the receding horizon minimises

    rho int_0^T e^{-rho t} (f(x_t) + R(u_t)) dt + e^{-rho T} V(x_T)

over controls that are constant on each step, and applies the first of them. The factors are those of the problem: `V` is
`rho` times a discounted integral, as `OPT` is, so the running cost carries `rho`, and what comes after `T` counts only
`e^{-rho T}`. With `V = V*` every horizon gives the optimal control; with `V = 0` only a long one does.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ocp_torch.control.exported import TORUS, example_states
from ocp_torch.errors import require_integer, require_number
from ocp_torch.export import lowered
from ocp_torch.export.casadi_function import casadi_function, require_casadi
from ocp_torch.problems import Problem

# `|u|^q` has no second derivative at 0 for q < 2: `(|u|^2 + s)^{q/2}` has.
SMOOTHING = 1e-8
QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 300, "ipopt.tol": 1e-7}


class RecedingHorizon:
    """The control at a state by IPOPT, by multiple shooting on ``steps`` steps of ``step`` units of time, each by RK4.

    ``terminal`` is a `casadi.Function` of a state of the torus whose output `value` is `V`, such as
    `controller.export("V.casadi", coordinates="torus")` writes; its output `control` gives the first plan. `None` for no cost
    after the horizon. ``failed`` counts the states at which IPOPT did not converge; the control is then its last iterate's.
    Raises `InputError` for a wrong size, without CasADi, and for a problem whose functions cannot be traced.
    """

    def __init__(self, problem: Problem, steps: int, step: float, terminal: Any = None) -> None:
        self.problem, self.steps = problem, require_integer("steps", steps, 1, maximum=10_000)
        self.step = require_number("step", step, above=0.0)
        self.casadi = require_casadi()
        d, m = problem.dim, problem.control_dim
        start, states = self.casadi.MX.sym("start", d), self.casadi.MX.sym("states", d, steps)
        controls = self.casadi.MX.sym("controls", m, steps)
        advanced, decay = self._advanced(), math.exp(-problem.discount * step)
        before = self.casadi.horzcat(start, states[:, :-1])
        reached, costs = advanced.map(steps)(before, controls)
        discounts = np.power(decay, np.arange(steps))[None]
        total = (1.0 - decay) * self.casadi.sum2(discounts * costs)
        if terminal is not None:
            total += decay**steps * terminal(state=states[:, -1])["value"]
        limit, cost = problem.control_limit, problem.control_cost
        squares = self.casadi.sum1(controls**2).T if isinstance(limit, float) else self.casadi.MX(0, 1)
        gaps = self.casadi.vec(reached - states)
        unknowns = self.casadi.vertcat(self.casadi.vec(states), self.casadi.vec(controls))
        program = {"x": unknowns, "p": start, "f": total, "g": self.casadi.vertcat(gaps, squares)}
        self._solver = self.casadi.nlpsol("horizon", "ipopt", program, QUIET)
        sides = np.broadcast_to(np.asarray(np.inf if limit is None else limit, dtype=float), (m,))
        box = np.concatenate([np.full(d * steps, np.inf), np.tile(sides, steps)])
        self._bounds = dict(lbx=-box, ubx=box, lbg=np.r_[np.zeros(d * steps), np.full(squares.shape[0], -np.inf)])
        self._bounds["ubg"] = np.r_[np.zeros(d * steps), np.full(squares.shape[0], cost.reach**2)]
        self._advance, self._terminal = advanced, terminal
        self._plan: np.ndarray | None = None
        self.failed = 0

    def reset(self) -> None:
        """Forget the last plan, which the next one starts from."""
        self._plan = None

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The control ``(m,)`` at a state of the torus ``(d,)``."""
        d, m, steps = self.problem.dim, self.problem.control_dim, self.steps
        if self._plan is None:
            self._plan = self._first_plan(x)
        # Whole turns between the state and where the last plan expected it are taken off that.
        states = self._plan[: d * steps].reshape(steps, d)
        states = states - np.round(states[0] - x)
        guess = np.concatenate([states.ravel(), self._plan[d * steps :]])
        found = self._solver(x0=guess, p=x, **self._bounds)["x"].full().ravel()
        self.failed += not self._solver.stats()["success"]
        states, controls = found[: d * steps].reshape(steps, d), found[d * steps :].reshape(steps, m)
        shifted = np.concatenate([states[1:], states[-1:]]), np.concatenate([controls[1:], controls[-1:]])
        self._plan = np.concatenate([part.ravel() for part in shifted])
        return controls[0]

    def _first_plan(self, x: np.ndarray) -> np.ndarray:
        """The trajectory of the controller that came with ``terminal``; without one, the trajectory without control."""
        controlled = self._terminal is not None and "control" in self._terminal.name_out()
        states, controls = [], []
        for _ in range(self.steps):
            controls.append(
                self._terminal(state=x)["control"].full().ravel() if controlled else np.zeros(self.problem.control_dim)
            )
            x = self._advance(x, controls[-1])[0].full().ravel()
            states.append(x)
        return np.concatenate([*states, *controls])

    def _advanced(self) -> Any:
        """The `casadi.Function` from state and control to the state one step later and the mean running cost on the way."""
        problem, casadi = self.problem, self.casadi
        data = model(problem)
        x, u = casadi.MX.sym("x", problem.dim), casadi.MX.sym("u", problem.control_dim)

        def rates(at: Any) -> tuple[Any, Any]:
            found = data(state=at)
            B = casadi.reshape(found["B"], problem.dim, problem.control_dim)
            return found["a"] + B @ u, found["f"]

        h, (v1, f1) = self.step, rates(x)
        v2, f2 = rates(x + 0.5 * h * v1)
        v3, f3 = rates(x + 0.5 * h * v2)
        v4, f4 = rates(x + h * v3)
        q = problem.exponent
        price = casadi.sumsqr(u) / 2.0 if q == 2.0 else (casadi.sumsqr(u) + SMOOTHING) ** (0.5 * q) / q
        end, cost = x + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4), (f1 + 2.0 * f2 + 2.0 * f3 + f4) / 6.0 + price
        return casadi.Function("advanced", [x, u], [end, cost])


def model(problem: Problem) -> Any:
    """`f` ``(1,)``, `a` ``(d,)`` and `B` ``(m d,)``, column by column, of ``problem`` at a state of the torus, as a
    `casadi.Function`. Raises `InputError` where these functions cannot be traced."""

    @torch.no_grad()
    def data(x: Tensor) -> dict[str, Tensor]:
        B = problem.control_matrix(x).transpose(1, 2)
        return {"f": problem.state_cost(x), "a": problem.drift(x), "B": B.expand(len(x), *B.shape[1:])}

    return casadi_function(lowered(data, example_states(problem, TORUS)), "model")
