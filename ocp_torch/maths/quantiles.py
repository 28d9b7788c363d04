"""Quantiles of weighted values."""

from torch import Tensor


def upper_quantile(values: Tensor, weights: Tensor, part: float) -> float:
    """The number above which ``values`` ``(N,)`` have ``weights`` ``(N,)`` of ``part * N`` in all."""
    order = values.argsort(descending=True)
    above = weights[order].cumsum(0) / len(weights)
    return float(values[order][min(int((above < part).sum()), len(values) - 1)])
