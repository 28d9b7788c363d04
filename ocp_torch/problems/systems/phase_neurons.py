r"""Spiking neurons reduced to their phases under one stimulus: break their synchrony, as deep brain stimulation should."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_choice, require_integer, require_number
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.physical.coordinates import Angle
from ocp_torch.problems.systems.oscillators import DESYNCHRONISE, Oscillators

TYPE_1, TYPE_2 = "type1", "type2"


class PhaseNeurons(Oscillators):
    r"""`dtheta_i/dt = omega_i + (coupling / n) sum_j sin(theta_j - theta_i) + Z(theta_i) p`.

    The phase reduction of Brown, Moehlis and Holmes (Neural Computation 16, 2004), one stimulus for all as in Wilson and
    Moehlis (SIAM Review 57, 2015): `m = 1`. The response `Z` is `1 - cos theta` for neurons of type1 (near
    a saddle-node on a circle), `-sin theta` for type2 (near a Hopf bifurcation); a neuron spikes at phase 0. ``frequencies``,
    ``coupling`` and the stimulus `p` are in rad/s, its price is `|u|^q / q` of `u = p` in units of ``strength``. Cost:
    ``weight`` times `r^2` to desynchronise, `1 - r^2` to synchronise, `r` the order parameter.

    ``frequencies`` is a list, or null for ``frequency`` times equally spaced factors from `1 - spread / 2` to `1 + spread /
    2`; ``phase_noise`` is in rad/sqrt(s), one for all neurons or each. The drift is not in the range of `B`, so the paper's
    assumption A2 fails; see `Dubins` for what then still holds. Where all phases agree the stimulus cannot part them.
    Raises `InputError` for wrong arguments.
    """

    def __init__(
        self,
        neurons: int = 2,
        response: str = TYPE_2,
        goal: str = DESYNCHRONISE,
        frequencies: list[float] | None = None,
        frequency: float = 2.0,
        spread: float = 0.2,
        coupling: float = 0.5,
        strength: float = 1.0,
        weight: float = 1.0,
        discount: float = 0.7,
        exponent: float = 2.0,
        control_limit: Limit = None,
        phase_noise: float | Sequence[float] = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        self.neurons = n = require_integer("problem.neurons", neurons, 2, maximum=512)
        self.strength = require_number("problem.strength", strength, above=0.0)
        phases, stimulus = [Angle(f"phase {i}") for i in range(n)], ["stimulus [rad/s]"]
        super().__init__(
            phases, stimulus, discount, exponent, 1.0, control_limit, noise=noise, nominal_control=self.strength
        )
        self.aim(goal, weight)
        self.response = require_choice("problem.response", response, (TYPE_1, TYPE_2))
        self.frequency = require_number("problem.frequency", frequency)
        self.spread = require_number("problem.spread", spread, at_least=0.0)
        factors = 1.0 + self.spread * torch.linspace(-0.5, 0.5, n, dtype=torch.float64)
        given = (self.frequency * factors).tolist() if frequencies is None else frequencies
        self.run_at(given, n, coupling)
        self.shake(phase_noise, torch.eye(n, dtype=torch.float64))

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        cosine, sine = self.circular(s)
        pulled = cosine * sine.mean(dim=-1, keepdim=True) - sine * cosine.mean(dim=-1, keepdim=True)
        Z = 1.0 - cosine if self.response == TYPE_1 else -sine
        return self._like(s, "omega", self._omega) + self.coupling * pulled, Z.unsqueeze(-1)

    def divergences(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """`div a = -coupling (n r^2 - 1)`, where -1 takes out each neuron's own term, and `div B`, the sum of `Z'`."""
        slope = s.sin() if self.response == TYPE_1 else -s.cos()
        return self.coupling * (1.0 - self.neurons * self.square_order(s)), slope.sum(dim=-1, keepdim=True)
