"""Averages of the iterates, by `torch.optim.swa_utils`."""

from __future__ import annotations

from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn, get_swa_multi_avg_fn

from ocp_torch.errors import require_choice, require_number

# At 1 the average would never leave the first iterate.
MOST_DECAY = 0.999999


def averaged(fields: nn.Module, kind: str = "ema", decay: float = 0.98) -> AveragedModel:
    """A running average of ``fields``: ``ema`` (exponential with ``decay``), ``uniform`` as in the paper, or ``none``.

    Call ``update_parameters(fields)`` at each iterate that counts; the average is in ``.module``.
    """
    require_choice("averaging.kind", kind, ("ema", "uniform", "none"))
    decay = require_number("averaging.decay", decay, at_least=0.0, at_most=MOST_DECAY)
    rules = {"ema": lambda: get_ema_multi_avg_fn(decay), "uniform": get_swa_multi_avg_fn, "none": lambda: _latest}
    average = AveragedModel(fields, multi_avg_fn=rules[kind](), use_buffers=False)
    return average.requires_grad_(False)


def _latest(averages: list, currents: list, count) -> None:
    for average, current in zip(averages, currents, strict=True):
        average.copy_(current)
