"""Fields that compute in single precision for states in double precision, in about half the time."""

import copy

from torch import Tensor, nn

from ocp_torch.maths import jets
from ocp_torch.maths.jets import Field, Jet


class Rounded(nn.Module):
    """``network`` in float32, from and to float64; off by about 1e-6 of its size. States are wrapped and then rounded."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).float()

    def forward(self, x: Tensor) -> Tensor:
        return self.network((x - x.floor()).float()).double()

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        """The jet of a scalar network at states ``(N, d)``, as `jets.jet` has it."""
        here = (x - x.floor()).float()
        return jets.jet(self.network, here, None if sigma is None else sigma.float()).map(Tensor.double)

    def curvature(self, x: Tensor, sigma: Tensor) -> Tensor:
        """`sigma sigma^T / 2 : hess` ``(N,)`` of a scalar network, as `jets.curvature` gives it."""
        return jets.curvature(self.network, (x - x.floor()).float(), sigma.float()).double()


def rounded(field: Field) -> Field:
    """``field`` in single precision where it has a property ``rounded``, or is a network of this package (known by its method
    ``jet``); else as it is."""
    own = getattr(field, "rounded", None)
    return own or (Rounded(field) if isinstance(field, nn.Module) and hasattr(field, "jet") else field)
