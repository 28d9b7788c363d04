r"""A problem in physical units: what a user writes in radians, metres and newtons, made a problem on the torus."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_number
from ocp_torch.maths import jets
from ocp_torch.maths.mixtures import Mixture
from ocp_torch.problems.physical.chart import Chart
from ocp_torch.problems.physical.coordinates import Control, Coordinate, require_controls, require_coordinates
from ocp_torch.problems.physical.disturbed import Disturbed
from ocp_torch.problems.physical.measures import Measures
from ocp_torch.problems.physical.prices import positive_each, scaled_limit, weight_roots
from ocp_torch.problems.physical.start import Density, Start, start_density
from ocp_torch.problems.problem import VectorFields
from ocp_torch.problems.replaced import replaced

# States at which the largest cost in the box is sought.
COST_STATES = 2**14
# Methods whose answers all come from one evaluation of `dynamics`.
TOGETHER = ("drift", "control_matrix", "drift_divergence", "control_divergence")


class System(Disturbed):
    r"""Base class: override `cost` and `dynamics`, and where there is noise `disturbance`, all in physical units.

    minimise  rho E int e^{-rho t} (cost(s_t) + sum_i r_i u_i^2 / 2) dt,   ds = (a(s) + B(s) u) dt + sigma(s) dW

    States `s` ``(N, d)`` are in the units of ``coordinates``, a list of `Angle` and `Interval`; controls `u` ``(N, m)`` in
    those of ``controls``, as in ``["force [N]"]``; time is in seconds if units are. Functions are batched, differentiable,
    and work in the precision and on the device of `s`; angles have no preferred turn, so functions of them are periodic.

    On the torus `x_i = (s_i - centre_i) / length_i` and `v_i = r_i^{1/q} u_i`. The model is exact in the box of the
    intervals. Beyond, time slows to a stop at the seam (`a`, `B` and `sigma` times a twice differentiable cut-off `chi`),
    which is never crossed, and the cost becomes ``failure_cost`` (`chi cost + (1 - chi) failure_cost`): leaving the box is a
    failure that costs so much for ever. By default that is the largest cost met in the box. Costs keep their unit.

    ``discount`` is `rho` per unit of time, ``exponent`` `q` (the price is `sum_i r_i |u_i|^q / q` where all weights are the
    same, as they must be for `q < 2`), ``control_weight`` `r > 0` or one for each control, ``control_limit`` a limit on `|u|`
    (which needs equal weights) or a list of one for each `|u_i|`; with ``nominal_control``, one or one for each, both are of
    the `u_i` in those units. ``start`` is as in `start_density`, by default all of the box; ``noise`` that of `Problem`, in
    units of the torus, which does cross seams. Raises `InputError` for wrong ones.
    """

    # The attribute of that name is a limit of `v`, not what was given.
    not_arguments = ("control_limit",)
    # Whether neither `a` nor a column of `B` has a divergence, in physical units.
    divergence_free = False
    # The environment of Gymnasium's that this is a model of, if any: `observed` and `action` say how.
    gymnasium: str | None = None

    def __init__(
        self,
        coordinates: Sequence[Coordinate],
        controls: Sequence[str | Control],
        discount: float = 2.0,
        exponent: float = 2.0,
        control_weight: float | Sequence[float] = 1.0,
        control_limit: float | Sequence[float] | None = None,
        start: Start = None,
        noise: float | Sequence[float] = 0.0,
        failure_cost: float | None = None,
        nominal_control: float | Sequence[float] = 1.0,
    ) -> None:
        self.coordinates, self.controls = require_coordinates(coordinates), require_controls(controls)
        q = require_number("problem.exponent", exponent, above=1.0, at_most=2.0)
        roots = weight_roots(control_weight, len(self.controls), q)
        nominal = positive_each("problem.nominal_control", nominal_control, len(roots))
        limit = scaled_limit(control_limit, roots)
        super().__init__(len(self.coordinates), len(self.controls), discount, q, limit, noise)
        self.chart = Chart(self.coordinates)
        self.start = start
        # A function of the user's own may need what a subclass has yet to set.
        self._density: Density | None = None if callable(start) else start_density(self.chart, start)
        self._roots = torch.tensor(roots, dtype=torch.float64) / torch.tensor(nominal, dtype=torch.float64)
        self.measures = Measures(self.coordinates, self.controls, tuple(self._roots.tolist()))
        self._factor = 1.0 / (self.chart.length.unsqueeze(-1) * self._roots)
        if failure_cost is not None:
            require_number("problem.failure_cost", failure_cost, at_least=0.0)
        self.failure_cost = failure_cost

    def observed(self, observation: Any) -> np.ndarray:
        """The physical state ``(d,)`` that an observation of the environment ``gymnasium``, an array or a dict, shows."""
        raise InputError(f"{type(self).__name__} must define observed(observation), as it names an environment.")

    def action(self, control: np.ndarray) -> np.ndarray:
        """The action of the environment ``gymnasium`` that applies the physical ``control`` ``(m,)``."""
        raise InputError(f"{type(self).__name__} must define action(control), as it names an environment.")

    def from_observation(self, env: str, observation: np.ndarray | dict) -> np.ndarray:
        """The torus state ``(d,)`` of an observation of `gymnasium`; coordinates beyond a seam are moved to it."""
        if env != self.gymnasium:
            return super().from_observation(env, observation)
        seen = observation if isinstance(observation, dict) else np.asarray(observation, dtype=np.float64)
        s = np.asarray(self.observed(seen), dtype=np.float64)
        if s.shape != (self.dim,):  # one number would be taken for all coordinates
            raise InputError(
                f"observed of {type(self).__name__} gave shape {s.shape}, but must give ({self.dim},), a physical state."
            )
        return self.chart.clipped(torch.as_tensor(s).unsqueeze(0))[0].numpy()

    def to_action(self, env: str, control: np.ndarray) -> np.ndarray:
        if env != self.gymnasium:
            return super().to_action(env, control)
        v = torch.as_tensor(np.asarray(control), dtype=torch.float64)
        return np.asarray(self.action(self.from_controls(v).numpy()))

    def _unknown(self, env: str) -> InputError:
        must = f"its gymnasium is {self.gymnasium!r}; set it, and define observed and action"
        return InputError(f"{type(self).__name__} does not know the environment {env}: {must}.")

    def cost(self, s: Tensor) -> Tensor:
        """Running cost `>= 0`, ``(N,)``, per unit of time."""
        raise InputError(f"{type(self).__name__} must define cost(s), the running cost of shape (N,).")

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """`a` ``(N, d)``, in units of coordinates per unit of time, and `B` ``(N, d, m)``, the same per unit of control."""
        raise InputError(f"{type(self).__name__} must define dynamics(s), which gives a and B.")

    def divergences(self, s: Tensor) -> tuple[Tensor, Tensor] | None:
        """`div a` ``(N,)`` and that of each column of `B` ``(N, m)``, of `dynamics`; `None` leaves them to autograd. An
        override is faster."""
        return (torch.zeros_like(s[:, 0]), s.new_zeros(len(s), self.control_dim)) if self.divergence_free else None

    def to_torus(self, s: Tensor) -> Tensor:
        """Physical states ``(N, d)`` as states of the torus; raises `InputError` for one beyond a seam."""
        return self.chart.to_torus(s)

    def from_torus(self, x: Tensor) -> Tensor:
        """States of the torus ``(N, d)`` as physical ones."""
        return self.chart.from_torus(x)

    def to_controls(self, u: Tensor) -> Tensor:
        """Physical controls ``(N, m)`` as those of the torus problem, whose price is `|v|^q / q`."""
        return u * self._like(u, "roots", self._roots)

    def from_controls(self, v: Tensor) -> Tensor:
        """Controls ``(N, m)`` of the torus problem in their units."""
        return v / self._like(v, "roots", self._roots)

    def state_cost(self, x: Tensor) -> Tensor:
        s = self._places(x)
        if not self.chart.boxed:
            return self.cost(s)
        chi = self.chart.cut(s)
        return chi * self.cost(s) + (1.0 - chi) * self._failure

    def drift(self, x: Tensor) -> Tensor:
        return self._moved(x)[0]

    def control_matrix(self, x: Tensor) -> Tensor:
        return self._moved(x)[1]

    def _moved(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`a` ``(N, d)`` and `B` ``(N, d, m)`` on the torus."""
        s = self._places(x)
        return self._scaled(*self.dynamics(s), self.chart.cut(s) if self.chart.boxed else None)

    def _scaled(self, a: Tensor, B: Tensor, chi: Tensor | None) -> tuple[Tensor, Tensor]:
        """``a`` and ``B`` of `dynamics` on the torus, times `chi` ``(N,)`` where there is a box."""
        lengths, factor = self.chart.lengths(a), self._like(a, "factor", self._factor)
        if chi is not None:
            chi = chi.unsqueeze(-1)
            return chi / lengths * a, chi.unsqueeze(-1) * factor * B
        # A constant matrix stays an expanded view, which takes no memory for each state.
        return a / lengths, (B[:1] * factor).expand(B.shape) if B.stride(0) == 0 else B * factor

    def _places(self, x: Tensor) -> Tensor:
        """`from_torus`, up to whole turns where there are only angles: functions of them are periodic."""
        return self.from_torus(x) if self.chart.boxed else x * self.chart.lengths(x)

    def vector_fields(self, x: Tensor, divergences: bool = True) -> VectorFields:
        """`Problem.vector_fields` from one evaluation of `dynamics`, unless one of its parts is replaced."""
        if any(replaced(self, name, System) for name in TOGETHER):
            return super().vector_fields(x, divergences)
        return self._together(x, divergences)

    def _together(self, x: Tensor, divergences: bool = True) -> VectorFields:
        """`vector_fields` from one evaluation of `dynamics`, and a reverse pass through it for each entry that varies where
        `divergences` gives none: `d(chi a_i / length_i) / dx_i = d(chi a_i) / ds_i`, and `grad chi` is known."""
        if not divergences:
            return *self._moved(x), None, None
        s, chi = self._places(x).detach(), None
        known = self.divergences(s)
        a, B, div_a, div_B = self._differentiated(s) if known is None else (*self.dynamics(s), *known)
        if self.chart.boxed:
            chi, slope = self.chart.cut_with_slope(s)
            div_a = chi * div_a + (slope * a).sum(dim=-1)
            div_B = chi.unsqueeze(-1) * div_B + torch.einsum("nd,ndm->nm", slope, B.expand(len(s), -1, -1))
        return *self._scaled(a, B, chi), div_a, div_B / self._like(x, "roots", self._roots)

    def _differentiated(self, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`dynamics` and its divergences, by autograd."""
        at = s.requires_grad_(True)
        with torch.enable_grad():
            a, B = self.dynamics(at)
            div_a, div_B = jets.column_divergences(a.unsqueeze(-1), at).squeeze(-1), jets.column_divergences(B, at)
        s.requires_grad_(False)
        return a.detach(), B.detach(), div_a, div_B

    def drift_divergence(self, x: Tensor) -> Tensor | None:
        return self._together(x)[2]

    def control_divergence(self, x: Tensor) -> Tensor | None:
        return self._together(x)[3]

    def initial_density(self, x: Tensor) -> Tensor:
        if self.start is None and not self.chart.boxed:
            return super().initial_density(x)
        if self._density is None:
            self._density = start_density(self.chart, self.start)
        return self._density(self.from_torus(x)) * self.chart.volume

    @property
    def initial_mixture(self) -> Mixture | None:
        if replaced(self, "initial_density", System):
            return None
        return getattr(self._density, "mixture", None)

    def outside(self, x: Tensor) -> Tensor:
        """Whether states of the torus ``(N, d)`` are outside the box, where the model is slowed down, ``(N,)``."""
        return self.chart.outside(self.from_torus(x))

    @cached_property
    @torch.no_grad()
    def _failure(self) -> float:
        """The cost of a state at a seam: ``failure_cost``, or the largest cost met in the box."""
        if self.failure_cost is not None:
            return self.failure_cost
        return float(self.cost(self.chart.spread(COST_STATES)).max())
