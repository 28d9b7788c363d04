"""Where in a run a loss is asked for: all that an objective may know of time."""

from __future__ import annotations

from dataclasses import dataclass

from ocp_torch.problems.constants import Constants


@dataclass(frozen=True)
class Phase:
    """Made by whoever trains, at each step, and passed on to losses: an objective has neither a clock nor a state.

    ``constants`` are `M`, `C_V` and `C_u` in force; ``progress`` is the part of the present round that is done, in [0, 1].
    """

    constants: Constants
    progress: float = 1.0
