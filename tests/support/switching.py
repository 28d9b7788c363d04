"""What a bang-bang controller costs on the circle, its sliding mode included."""

from __future__ import annotations

import torch


def cost_of_switching(left: float, right: float, rho: float = 2.0) -> float:
    """Of `switched` on the circle: on the way `f + c^2/2`, and at 1/2 the mixture of both that stands still."""
    y = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000 - 0.5
    speed = torch.where(y < 0, left, right)
    arrival = y.abs() / speed
    t = arrival.unsqueeze(-1) * (torch.arange(400, dtype=torch.float64) + 0.5) / 400
    rate = (y.abs().unsqueeze(-1) - speed.unsqueeze(-1) * t).square() + 0.5 * speed.unsqueeze(-1).square()
    way = (rho * (-rho * t).exp() * rate).mean(dim=-1) * arrival
    sliding = (right * 0.5 * left**2 + left * 0.5 * right**2) / (left + right)
    return float((way + (-rho * arrival).exp() * sliding).mean())
