"""Where a loss or a gradient first is not finite: whose it is, of which field, and at which state of the batch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.fields.fields import Fields
from ocp_torch.objectives.objective import Objective
from ocp_torch.objectives.phase import Phase
from ocp_torch.problems.samples import Samples

DATA = {"f": "the state cost", "a": "the drift", "B": "the control matrix", "mu0": "the initial density"}
DATA |= {"div_a": "the divergence of the drift", "div_B": "the divergence of the control matrix"}

# How the sentence ends where no learning rate would help.
BROKEN_PROBLEM = "; it must be finite on the whole torus"


class NonFiniteError(ArithmeticError):
    """A loss or gradient is not finite; raised before any parameter was touched."""


def first_nonfinite(objective: Objective, fields: Fields, samples: Samples, phase: Phase) -> str:
    """The first thing that is not finite, in words; one state at a time, as slow as that is: the run is over anyway."""
    for name, parameter in fields.named_parameters():
        if not torch.isfinite(parameter).all():
            return (
                f"the loss of player {_player(objective, name)!r} is not finite at any x: the weights of {name} are not"
            )
    losses = objective.losses(fields, samples, phase)
    bad = [player for player, loss in losses.items() if not torch.isfinite(loss)]
    for one in samples.split(1):
        where = f"at x = {[round(c, 6) for c in one.x[0].tolist()]}"
        cause = _bad_data(one)
        try:
            alone = objective.losses(fields, one, phase)
        except RuntimeError:  # the loss is not a mean over states
            return f"the loss of player {bad[0]!r} is not finite" if bad else "a gradient is not finite"
        for player in bad:
            if not torch.isfinite(alone[player]):
                return f"the loss of player {player!r} is not finite {where}{cause}"
        for player in () if bad else alone:
            for field in objective.players[player]:
                if not _finite_gradient(alone[player], fields.parameters_of([field])):
                    return f"a gradient is not finite: that of player {player!r} for its {field} {where}{cause}"
    if bad:
        return f"the loss of player {bad[0]!r} is not finite: its terms are, but too large to be added up"
    return "a gradient is not finite: its terms are, but too large to be added up"


def _player(objective: Objective, parameter: str) -> str:
    owners = {field: player for player, names in objective.players.items() for field in names}
    return next((player for field, player in owners.items() if f".{field}." in f".{parameter}"), "?")


def _bad_data(one: Samples) -> str:
    for name, words in DATA.items():
        values = getattr(one, name)
        if values is not None and not torch.isfinite(values).all():
            return f", where {words} of the problem is not finite{BROKEN_PROBLEM}"
    return ""


def _finite_gradient(loss: Tensor, parameters: Sequence[Tensor]) -> bool:
    gradients = torch.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True)
    return all(g is None or bool(torch.isfinite(g).all()) for g in gradients)
