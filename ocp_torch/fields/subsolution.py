"""A function whose slack bounds the optimum from below, with the states that decide its bound."""

from typing import Any

from torch import Tensor, nn

from ocp_torch.maths import jets
from ocp_torch.maths.jets import Jet


class Subsolution(nn.Module):
    """``network`` `W`, ``(N, d) -> (N,)``, and ``worst`` ``(K, d)``, the states at which its slack was found to be largest:
    a later search for the supremum begins there too, since it may miss a peak that an earlier one has met."""

    worst: Tensor

    def __init__(self, network: nn.Module, worst: Tensor) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("worst", worst)

    @classmethod
    def of(cls, network: Any, dim: int, states: int = 0, **form: Any) -> "Subsolution":
        """A subsolution with room for so many ``states``, to load weights and states into; ``network`` makes its network."""
        made = network(dim=dim, **form)
        return cls(made, next(made.parameters()).new_zeros(states, dim))

    def forward(self, x: Tensor) -> Tensor:
        return self.network(x)

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        """The jet of `W` at states ``(N, d)``, as `jets.jet` gives it."""
        return jets.jet(self.network, x, sigma)

    def curvature(self, x: Tensor, sigma: Tensor) -> Tensor:
        """`sigma sigma^T / 2 : hess` of `W` ``(N,)``, as `jets.curvature` gives it."""
        return jets.curvature(self.network, x, sigma)
