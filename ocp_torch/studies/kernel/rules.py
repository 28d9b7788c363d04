r"""One sample's derivative of each of the paper's objectives, with respect to field values and gradients at that sample.

A *jet* holds a field's value and gradient at one state, ``(R, 1 + d, o)`` for `R` independent runs and `o` outputs. By
the reproducing property `V(x) = <V, Phi(x)>` and `d_i V(x) = <V, d_i Phi(x)>`; so the gradient in the space is a sum of
`Phi(x)` and `d_i Phi(x)` with the coefficients a rule returns, in the direction of improvement (equations 7 and 12 and
Proposition 9 of the paper). The closed forms are Lemmas 2 and 3, written through the speed `|u| = |w| / mu`.

With noise `D:hess V(x) = <V, D:hess Phi(x)>` joins them, last: jets are ``(R, 2 + d, o)`` (the paper's remark in section
4.3).
"""

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np

from ocp_torch.errors import InputError
from ocp_torch.fields.fields import CONTROL_DENSITY, VALUE
from ocp_torch.maths.jets import Jet
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.generator import Generator, hjb_slack
from ocp_torch.problems.problem import Problem

Jets = dict[str, np.ndarray]


class Datum(NamedTuple):
    """A problem's data at one state for each of `R` runs, and the jets of the features there, if there are any."""

    x: np.ndarray  # (R, d)
    f: np.ndarray  # (R,)
    a: np.ndarray  # (R, d)
    B: np.ndarray  # (R, d, m)
    mu0: np.ndarray  # (R,)
    div_B: Any  # (R, m); None where no rule reads them
    jets: Any  # (R, 1 + d, F), with noise (R, 2 + d, F); None without features
    noise: Any = None  # (R, d, k) sigma; None where there is none


def _scalar(jet: np.ndarray, dim: int) -> Jet:
    """The jet of a field with one output."""
    curvature = jet[:, 1 + dim, 0] if jet.shape[1] > 1 + dim else None
    return Jet(jet[:, 0, 0], jet[:, 1 : 1 + dim, 0], curvature)


class Rule(ABC):
    """The update of a method: ``fields`` names the fields that move, and a call with a datum and jets gives the coefficients
    of the improving step."""

    fields: tuple[str, ...]
    needs_divergences = False
    takes_noise = False

    def __init__(self, problem: Problem, constants: Constants) -> None:
        if problem.control_limit is not None:
            raise InputError(
                f"problem.control_limit is {problem.control_limit}, but the kernel methods know no limit; use networks."
            )
        if problem.noisy and not self.takes_noise:
            raise InputError("problem.noise is above 0, but of the kernel methods only dual knows noise; use networks.")
        self.rho, self.M, self.C_V, self.q = problem.discount, constants.M, constants.C_V, problem.exponent
        self.conjugate = self.q / (self.q - 1.0)

    @abstractmethod
    def __call__(self, datum: Datum, jets: Jets) -> Jets: ...

    def _toward(self, w: np.ndarray, size: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """`grad R(u) = |u|^{q-1} w / |w|` for `u` along `w` with the given speed; 0 where `w = 0`, ``(R, m)``."""
        return (speed ** (self.q - 1.0) / np.where(size > 0.0, size, 1.0))[:, None] * w

    def _free_speed(self, c: np.ndarray) -> np.ndarray:
        """`|u|` of the free minimiser of `c mu + mu R(w / mu)`, where `R*(grad R(u)) = c`."""
        return (self.conjugate * np.maximum(c, 0.0)) ** (1.0 / self.q)


class DualRule(Rule):
    """Ascent on `V mu0 - M max(Q, 0)` (section 4.3): the sum of `(mu0 - M) Phi`, of `M d_i Phi (a + B u)_i / rho` and, with
    noise, of `M D:hess Phi / rho`; in the last two and in `M Phi` only where `Q > 0`."""

    fields = (VALUE,)
    takes_noise = True

    def __call__(self, datum: Datum, jets: Jets) -> Jets:
        jet = jets[VALUE]
        dim = datum.x.shape[1]
        generator, V = Generator(datum, self.rho), _scalar(jet, dim)
        p = generator.push(V)
        size = np.sqrt(np.square(p).sum(axis=1))
        u = p if self.q == 2.0 else (size ** (self.conjugate - 2.0))[:, None] * p
        slack = hjb_slack(V.value, datum.f, generator.transport(V), size**self.conjugate / self.conjugate)
        weight = np.where(slack > 0.0, self.M, 0.0)
        step = np.empty_like(jet)
        step[:, 0, 0] = datum.mu0 - weight
        step[:, 1 : 1 + dim, 0] = (weight / self.rho)[:, None] * (datum.a + np.matmul(datum.B, u[:, :, None])[:, :, 0])
        step[:, 1 + dim :, 0] = (weight / self.rho)[:, None]
        return {VALUE: step}


class PrimalRule(Rule):
    """Descent on `Gamma(w, x) = min_mu` of the integrand of `J` without drift (section 5.3, Lemma 2).

    Its derivative in `beta = mu0 - div(B w) / rho` is `f - R*(grad R(u))`, between 0 (mass is free) and `C_V` (mass is lost).
    """

    fields = (CONTROL_DENSITY,)
    needs_divergences = True

    def __call__(self, datum: Datum, jets: Jets) -> Jets:
        jet = jets[CONTROL_DENSITY]
        w = jet[:, 0]
        flux = (datum.div_B * w).sum(axis=1) + (datum.B * jet[:, 1:]).sum(axis=(1, 2))
        inflow = datum.mu0 - flux / self.rho
        size = np.sqrt(np.square(w).sum(axis=1))
        fastest = self._free_speed(datum.f)
        bound = np.where(inflow > 0.0, size / np.where(inflow > 0.0, inflow, 1.0), np.inf)
        speed = np.clip(bound, self._free_speed(datum.f - self.C_V), fastest)
        push = (datum.f - speed**self.q / self.conjugate) * (bound < fastest) / self.rho
        step = np.empty_like(jet)
        step[:, 0] = push[:, None] * datum.div_B - self._toward(w, size, speed)
        step[:, 1:] = push[:, None, None] * datum.B
        return {CONTROL_DENSITY: step}


class SaddleRule(Rule):
    """Ascent in `V` and descent in `w` on `Psi(V, w, x)` of PD (section 6.2, Lemma 3)."""

    fields = (VALUE, CONTROL_DENSITY)

    def __call__(self, datum: Datum, jets: Jets) -> Jets:
        of_value, of_density = jets[VALUE], jets[CONTROL_DENSITY]
        generator, V, w = Generator(datum, self.rho), _scalar(of_value, datum.x.shape[1]), of_density[:, 0]
        beta = generator.reduced_cost(V)
        size = np.sqrt(np.square(w).sum(axis=1))
        speed = np.maximum(size / self.M, self._free_speed(beta))
        mu = np.where(speed > 0.0, size / np.where(speed > 0.0, speed, 1.0), np.where(beta > 0.0, 0.0, self.M))
        up, down = np.empty_like(of_value), np.zeros_like(of_density)
        up[:, 0, 0] = datum.mu0 - mu
        up[:, 1:, 0] = (np.matmul(datum.B, w[:, :, None])[:, :, 0] + mu[:, None] * datum.a) / self.rho
        down[:, 0] = generator.push(V) - self._toward(w, size, speed)
        return {VALUE: up, CONTROL_DENSITY: down}


RULES: dict[str, type[Rule]] = {"dual": DualRule, "primal": PrimalRule, "pd": SaddleRule}
