"""A function whose slack bounds the optimum from below, with the states that decide its bound."""

from typing import Any

from torch import Tensor, nn

from ocp_torch.maths import jets
from ocp_torch.maths.jets import Jet


class Subsolution(nn.Module):
    """``network`` `W`, ``(N, d) -> (N,)``, and ``worst`` ``(K, d)``, where its slack was found to be largest: a search for
    the supremum begins there too, since others may miss a peak that this one has met."""

    worst: Tensor

    def __init__(self, network: nn.Module, worst: Tensor) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("worst", worst)

    @classmethod
    def of(cls, network: Any, dim: int, states: int = 0, **form: Any) -> "Subsolution":
        """One with room for so many ``states``, to load weights and states into; ``network`` makes its network."""
        made = network(dim=dim, **form)
        return cls(made, next(made.parameters()).new_zeros(states, dim))

    def forward(self, x: Tensor) -> Tensor:
        return self.network(x)

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        """As `jets.jet` has it."""
        return jets.jet(self.network, x, sigma)

    def curvature(self, x: Tensor, sigma: Tensor) -> Tensor:
        """As `jets.curvature` has it."""
        return jets.curvature(self.network, x, sigma)
