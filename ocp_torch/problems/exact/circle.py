r"""The paper's example (section 4.4): `dx/dt = u` on the circle, `f(x) = x(x-1) + 1/4`, `q = 2`, uniform start."""

from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.exact.torus import Torus


class Circle(Torus):
    r"""`V* = alpha (x - 1/2)^2` with `alpha = (sqrt(1 + 8/rho^2) - 1) rho^2 / 4` and `OPT = alpha / 12`.

    `mu*` is bounded exactly when `rho > 1`; then its supremum is `rho / (rho - 2 alpha / rho)`. With a ``control_limit``
    below `alpha / rho` none of this is exact any more, and none of it is claimed.
    """

    def __init__(self, discount: float = 2.0, control_limit: Limit = None, noise: float = 0.0) -> None:
        super().__init__(dim=1, shear="none", discount=discount, control_limit=control_limit, noise=noise)
