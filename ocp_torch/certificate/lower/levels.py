"""The best multiple of a value function, and the best constant taken off it, for `F_M`."""

from torch import Tensor

from ocp_torch.certificate.lower.slack import MAX_THETA, SlackParts
from ocp_torch.maths.quantiles import upper_quantile
from ocp_torch.maths.supremum import minimiser


def best_level(parts: SlackParts, weights: Tensor, initial: float, M: float) -> tuple[float, float, float]:
    """The `theta` in `[0, MAX_THETA]` and the `c` that maximise `F_M(theta W - c)`, concave in both, on sampled states, and
    that maximum; ``initial`` is `E[W mu0]`."""

    def level(theta: float) -> float:
        return upper_quantile(parts.slack(theta), weights, 1.0 / M)

    def loss(theta: float) -> float:
        c = level(theta)
        return c + M * float((weights * (parts.slack(theta) - c).clamp_min(0.0)).mean()) - theta * initial

    theta = minimiser(loss, 0.0, MAX_THETA)
    return theta, level(theta), -loss(theta)
