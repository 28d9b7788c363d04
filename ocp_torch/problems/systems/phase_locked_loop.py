r"""Lock an oscillator to a noisy reference: phase and frequency error, and the two paths of a second-order loop."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_number, require_numbers
from ocp_torch.problems.physical.coordinates import Angle, Interval
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.systems.rest import bound_at_rest


class PhaseLockedLoop(System):
    r"""`d phi = (w - u_1) dt + phase_noise dW_1`, `dw = -u_2 dt + frequency_noise dW_2`, errors against the reference.

    `u_1`, in rad/s, tunes the oscillator for as long as it lasts, `u_2`, in rad/s^2, for good: the proportional and the
    integral path of the classical loop filter (Gardner, *Phaselock Techniques*, chapter 2), here free functions of the
    state. Noise of frequency that is white, in rad/sqrt(s), and that walks, in rad/s/sqrt(s): the two-state model of clocks
    (Zucca and Tavella, 2005). Cost: `1 - cos phi + (frequency_weight w^2 + k_1 u_1^2 + k_2 u_2^2) / 2`, with the
    ``tuning_weight`` `k`. The box is `|w| <= max_frequency` in rad/s; it starts within ``pull_in``,
    at any phase.

    Without noise `mu*` is declared unbounded where the linear loop gathers mass at lock faster than the discount forgets it;
    with noise nothing is known of it. Raises `InputError` for wrong arguments.
    """

    divergence_free = True

    def __init__(
        self,
        max_frequency: float = 4.0,
        pull_in: float = 2.0,
        frequency_weight: float = 0.2,
        tuning_weight: Sequence[float] = (0.2, 0.2),
        failure_cost: float | None = None,
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: float | Sequence[float] | None = None,
        phase_noise: float = 0.3,
        frequency_noise: float = 0.3,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        self.max_frequency = require_number("problem.max_frequency", max_frequency, above=0.0)
        self.pull_in = require_number("problem.pull_in", pull_in, above=0.0)
        self.frequency_weight = require_number("problem.frequency_weight", frequency_weight, at_least=0.0)
        self.tuning_weight = require_numbers("problem.tuning_weight", tuning_weight, 2, above=0.0)
        self.phase_noise = require_number("problem.phase_noise", phase_noise, at_least=0.0)
        self.frequency_noise = require_number("problem.frequency_noise", frequency_noise, at_least=0.0)
        box: list[Angle | Interval] = [
            Angle("phase"),
            Interval("frequency", -self.max_frequency, self.max_frequency, "rad/s"),
        ]
        super().__init__(
            box,
            ["proportional [rad/s]", "integral [rad/s^2]"],
            discount,
            exponent,
            control_weight=self.tuning_weight,
            control_limit=control_limit,
            start={"frequency": (-self.pull_in, self.pull_in)},
            noise=noise,
            failure_cost=failure_cost,
        )
        self.disturb(torch.tensor([self.phase_noise, self.frequency_noise], dtype=torch.float64).diag())
        fastest = torch.tensor([[torch.pi, 0.5 * box[1].length]], dtype=torch.float64)
        self.state_cost_bound = max(float(self.cost(fastest)), self._failure)
        self.occupation_bound = bound_at_rest(self, [0.0, 0.0])

    def cost(self, s: Tensor) -> Tensor:
        phase, frequency = s.unbind(-1)
        return 2.0 * (0.5 * phase).sin().square() + 0.5 * self.frequency_weight * frequency.square()

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        a = torch.stack([s[:, 1], torch.zeros_like(s[:, 1])], dim=-1)
        return a, -torch.eye(2, dtype=s.dtype, device=s.device).expand(len(s), 2, 2)
