"""What a fit is made of beside its stepper, and the loop that all share: draw, step, average. Optimisers are `torch.optim`'s,
and SOAP from `pytorch_optimizer`; averages of the iterates those of `torch.optim.swa_utils`."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import CosineAnnealingWarmRestarts, LambdaLR, LRScheduler, StepLR
from torch.optim.swa_utils import AveragedModel, get_swa_multi_avg_fn

from ocp_torch.errors import InputError, require_call, require_choice, require_integer, require_number
from ocp_torch.fields import Fields
from ocp_torch.objectives import Objective, Phase
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers.simultaneous import Simultaneous
from ocp_torch.steppers.stepper import Stepper, StepReport

LARGEST_RATE = 1e6  # a larger learning rate is a slip: it moves weights, which are about 1, too far to learn anything
# A memory of about 1 / (1 - decay) = 50 steps: a longer one lags behind the last steps of the cosine schedule.
DECAY = 0.98
MOST_DECAY = 0.999999  # at 1 the average would never leave the first iterate


def _sgd(parameters: list[Tensor], lr: float, momentum: float = 0.0) -> Optimizer:
    return torch.optim.SGD(parameters, lr=lr, momentum=require_number("optimizer.momentum", momentum, at_least=0.0))


def _adam(parameters: list[Tensor], lr: float, betas=(0.9, 0.99)) -> Optimizer:
    return torch.optim.Adam(parameters, lr=lr, betas=_betas(betas))


def _soap(parameters: list[Tensor], lr: float, betas=(0.95, 0.95), precondition_frequency: int = 10) -> Optimizer:
    from ocp_torch.steppers.soap import ReplayedSOAP  # slow to import, and only needed here

    every = require_integer("optimizer.precondition_frequency", precondition_frequency, 1)
    return ReplayedSOAP(parameters, lr=lr, betas=_betas(betas), weight_decay=0.0, precondition_frequency=every)


def _betas(betas) -> tuple[float, float]:
    if not isinstance(betas, list | tuple) or len(betas) != 2:
        raise InputError(f"optimizer.betas is {betas!r}, but must be two numbers, as in [0.95, 0.95].")
    first, second = (require_number("optimizer.betas", b, at_least=0.0, at_most=0.999999) for b in betas)
    return first, second


OPTIMIZERS = {"sgd": _sgd, "adam": _adam, "soap": _soap}


def optimizer_maker(name: str, lr: float, **options) -> Callable[[list[Tensor]], Optimizer]:
    """A maker of the optimiser ``name`` with learning rate ``lr``; other options as in its configuration file."""
    make = OPTIMIZERS[require_choice("optimizer.name", name, OPTIMIZERS)]
    rate = require_number("optimizer.lr", lr, above=0.0, at_most=LARGEST_RATE)
    require_call(make, "optimizer", options, parameters=None, lr=rate)
    return lambda parameters: make(parameters, lr=rate, **options)


def schedule_maker(
    name: str,
    steps: int,
    decay: float = 0.75,
    every: int = 20000,
    exponent: float = 0.5,
) -> Callable[..., LRScheduler]:
    """A maker of the learning-rate schedule of an optimiser whose player waits for the part ``delay`` of ``steps``.

    ``constant``; ``cosine`` to zero over the player's own moves, and again over twice as many in each further round;
    ``decay``, a factor ``decay`` every ``every`` moves (the paper decreases by 25 % every 20,000); ``power``, a factor
    `k^-exponent` at move `k`; or ``horizon``, the factor `n^-exponent` throughout a first round of `n` moves, as in the
    paper's theorems (2/3 for the dual, 1/2 for the primal and the primal-dual).
    """
    require_choice("schedule.name", name, ("constant", "cosine", "decay", "power", "horizon"))
    factor = require_number("schedule.decay", decay, above=0.0, at_most=1.0)
    period = require_integer("schedule.every", every, 1)
    exponent = require_number("schedule.exponent", exponent, at_least=0.0, at_most=1.0)

    def make(optimizer: Optimizer, delay: float = 0.0) -> LRScheduler:
        moves = max(1, steps - math.ceil(delay * steps))
        if name == "cosine":
            return CosineAnnealingWarmRestarts(optimizer, T_0=moves, T_mult=2)
        if name == "decay":
            return StepLR(optimizer, step_size=period, gamma=factor)
        factors = {
            "power": lambda moved: (moved + 1.0) ** -exponent,
            "horizon": lambda moved: float(moves) ** -exponent,
        }
        return LambdaLR(optimizer, factors.get(name, lambda moved: 1.0))

    return make


class Average(AveragedModel):
    """A running average, ``module``, of the iterates that `count` was given."""

    module: Fields
    rule: Callable[..., None]

    @torch.no_grad()
    def count(self, iterate: Sequence[Tensor]) -> None:
        """Take ``iterate``, all parameters in the order of those of the fields, into the average, as `update_parameters` does
        for a module in four times the time on a GPU."""
        own: list[Any] = list(self.module.parameters())
        if self.n_averaged == 0:
            torch._foreach_copy_(own, list(iterate))
        else:
            self.rule(own, list(iterate), self.n_averaged)
        self.n_averaged += 1


def exponential(decay: float) -> Callable[..., None]:
    """The rule of an average that keeps the part ``decay`` of itself at each step, but at the `n`-th at most
    `(1 + n) / (10 + n)`, so that the first iterates, which are far off, are soon forgotten: after 40 steps on the circle the
    controller is .2 % off the optimum, and 19 % without."""

    def rule(own: list[Tensor], iterate: list[Tensor], count: Tensor) -> None:
        n = int(count)
        torch._foreach_lerp_(own, iterate, 1.0 - min(decay, (1.0 + n) / (10.0 + n)))

    return rule


def averaged(fields: Fields, kind: str = "ema", decay: float = DECAY) -> Average:
    """A running average of ``fields``: ``ema`` (exponential with ``decay``), ``uniform`` as in the paper, or ``none``.

    Raises `InputError` for another ``kind``, or a ``decay`` outside of [0, 0.999999].
    """
    require_choice("averaging.kind", kind, ("ema", "uniform", "none"))
    decay = require_number("averaging.decay", decay, at_least=0.0, at_most=MOST_DECAY)
    average = Average(fields, use_buffers=False).requires_grad_(False)
    # With a decay of 0 it is the last iterate.
    average.rule = get_swa_multi_avg_fn() if kind == "uniform" else exponential(decay if kind == "ema" else 0.0)
    return average


def advance(stepper: Stepper, average: Average, draw: Callable[[Phase], Samples], phase: Phase) -> StepReport:
    """One step at ``phase`` on as many batches of ``draw`` as the stepper takes; its iterate is counted in ``average``.

    Raises `NonFiniteError` as `Stepper.step` does; nothing is counted then.
    """
    # The next draw of a replay is written over the one before.
    kept = stepper.replay.captures and stepper.draws > 1
    batches = [draw(phase).copied() if kept else draw(phase) for _ in range(stepper.draws)]
    report = stepper.step(batches, phase)
    average.count(report.counted)
    return report


def short_fit(
    fields: Fields, objective: Objective, lr: float, steps: int, unit: float = 1.0, **options
) -> tuple[Simultaneous, Average]:
    """Stepper and average of a fit without configuration: SOAP with a learning rate that falls from ``lr`` to 0 in ``steps``.

    ``unit`` is what losses are divided by (see `cost_unit`); ``options`` are those of SOAP.
    """
    makers = {player: optimizer_maker("soap", lr, **options) for player in objective.players}
    stepper = Simultaneous(fields, objective, makers, schedule_maker("cosine", steps), unit=unit)
    return stepper, averaged(fields)
