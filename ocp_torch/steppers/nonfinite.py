"""Where a loss or a gradient first is not finite: whose it is, of which field, and at which state of the batch."""

import torch

from ocp_torch.fields import Fields
from ocp_torch.objectives import Objective, Phase
from ocp_torch.problems.samples import Samples

DATA = {"f": "the state cost", "a": "the drift", "B": "the control matrix", "mu0": "the initial density"}
DATA |= {"div_a": "the divergence of the drift", "div_B": "the divergence of the control matrix"}
DATA |= {"noise": "the noise", "div_D": "the divergence of its D", "div_div_D": "the divergence of that"}

# How the sentence ends where no learning rate would help.
BROKEN_PROBLEM = "; it must be finite on the whole torus"


class NonFiniteError(ArithmeticError):
    """A loss or gradient is not finite; raised before any parameter was touched."""


def first_nonfinite(objective: Objective, fields: Fields, samples: Samples, phase: Phase) -> str:
    """The first thing that is not finite, in words; sought one state at a time, slowly, as the run is over anyway."""
    owners = {field: player for player, names in objective.players.items() for field in names}
    for name, parameter in fields.named_parameters():
        if not parameter.isfinite().all():
            player = owners.get(name.split(".")[1], "?")  # as in networks.value.hidden.0.weight
            return f"the loss of player {player!r} is not finite at any x: the weights of {name} are not"
    losses = objective.losses(fields, samples, phase)
    bad = [player for player, loss in losses.items() if not loss.isfinite()]
    what = f"the loss of player {bad[0]!r} is not finite" if bad else "a gradient is not finite"
    for one in samples.split(1):
        where = f"at x = {[round(c, 6) for c in one.x[0].tolist()]}{_bad_data(one)}"
        try:
            alone = objective.losses(fields, one, phase)
        except RuntimeError:  # the loss is not a mean over states
            return what
        for player in bad:
            if not alone[player].isfinite():
                return f"the loss of player {player!r} is not finite {where}"
        for player in () if bad else alone:
            for field in objective.players[player]:
                parameters = fields.parameters_of([field])
                gradients = torch.autograd.grad(alone[player], parameters, retain_graph=True, allow_unused=True)
                if not all(g is None or g.isfinite().all() for g in gradients):
                    return f"{what}: that of player {player!r} for its {field} {where}"
    return f"{what}: its terms are, but too large to be added up"


def _bad_data(one: Samples) -> str:
    for name, words in DATA.items():
        values = getattr(one, name)
        if values is not None and not torch.isfinite(values).all():
            return f", where {words} of the problem is not finite{BROKEN_PROBLEM}"
    return ""
