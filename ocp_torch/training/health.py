"""Whether a run is going anywhere: its best evaluation so far, and signs that it diverges or learns nothing."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor

from ocp_torch.certificate import Certificate
from ocp_torch.certificate.statistics.estimate import known
from ocp_torch.errors import notes
from ocp_torch.fields.fields import Fields, typical_sizes
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants

# Growth of weights and losses since the run began that is reported as divergence: smaller factors would also report the
# growth of a run that learns.
GROWN_WEIGHTS = 100.0
GROWN_LOSS = 1e4
CONSTANT_STATES = 2**13  # on which the bound of the best constant V is computed
CONTRADICTED = "bounds contradicted each other at step"
# A lower bound this little below that of the best constant, relatively, is as good: both are sampled.
ROUNDING = 1e-4


@dataclass(frozen=True)
class Evaluation:
    """What the bounds were at ``step``; ``noise`` is half of the intervals of both sides, in the units of ``gap``.

    Where bounds contradict each other nothing counts: there is then neither a gap nor a performance.
    """

    step: int
    gap: float | None  # relative, from the lower bound to the simulated performance, between the far ends of both
    perf: float | None  # simulated, the upper end of its interval
    noise: float
    # The gap if `F_M` counts as well: whether its `M` is large enough is for the full certificate to see.
    supposed: float | None = None

    @classmethod
    def at(cls, step: int, certificate: Certificate, by_gap: bool = True) -> "Evaluation":
        """What ``certificate`` says; without the gaps where its lower bound decides nothing (not ``by_gap``)."""
        lower, perf = certificate.best_lower, certificate.best_perf
        gap, supposed = (certificate.gap["simulated"], certificate.supposed_gap) if by_gap else (None, None)
        ends = [certificate.lower[lower[0]]] if lower else []
        ends += [certificate.perf[perf[0]]] if perf else []
        errors = sum(e.half_width(certificate.confidence) for e in ends if e is not None)
        unit = lower[1] if lower and gap is not None else perf[1] if perf else 1.0
        noise = errors / abs(unit) if unit else 0.0
        return cls(step, gap, perf[1] if perf else None, noise, supposed)

    def better_than(self, other: "Evaluation | None", sure: bool = False) -> bool:
        """Whether this has the only or the smaller gap, or the smaller performance where neither has a gap; with ``sure``, by
        more than the noise of both, and not where the other would have the smaller gap if `F_M` counts."""
        if other is None:
            return self.gap is not None or self.perf is not None
        if sure and self.supposed is not None and other.supposed is not None and self.supposed > other.supposed:
            return False
        margin = self.noise + other.noise if sure else 0.0
        if self.gap is not None and other.gap is not None:
            return self.gap + margin < other.gap
        if self.gap is not None or other.gap is not None:
            return self.gap is not None
        if self.perf is not None and other.perf is not None:
            return self.perf + margin * abs(other.perf) < other.perf
        return self.perf is not None

    def in_words(self) -> str:
        """The gap or performance that fields are judged by, as words for the user."""
        if self.gap is not None:
            return f"a gap of {100 * self.gap:.3g} %"
        return f"a performance of {math.nan if self.perf is None else self.perf:.6g}"


@dataclass(eq=False)
class Health:
    """The health of a run, followed as it goes on."""

    unit: float  # the size of the problem's costs
    best: Evaluation | None = None  # so far
    fields: dict | None = None  # the averaged fields it was of
    certificate: Certificate | None = None  # what it said; not kept in checkpoints
    notes: list[str] = field(default_factory=list)  # what a user should be told of the run's health
    warned: bool = False  # that a certificate was no better than not having trained
    start: dict[str, float] = field(default_factory=dict)  # how large losses and weights were

    @classmethod
    def of(cls, problem: Problem) -> "Health":
        """The health of a run on ``problem`` before its first step."""
        (mean, spread), _ = typical_sizes(problem)
        return cls(unit=abs(mean) + spread)

    def evaluated(self, evaluation: Evaluation, fields: Fields, certificate: Certificate | None = None) -> bool:
        """Take note of an ``evaluation`` of ``fields``. Returns whether it is the best so far."""
        if not evaluation.better_than(self.best):
            return False
        self.best, self.certificate = evaluation, certificate
        self.fields = {name: tensor.detach().clone() for name, tensor in fields.state_dict().items()}
        return True

    def stepped(self, step: int, losses: dict[str, Tensor], parameters: Mapping[str, Sequence[Tensor]]) -> list[str]:
        """Compare losses and weights with those at the start. Returns a sentence, once in a run, on each that diverges."""
        sizes = {f"the loss of player {p!r}": (abs(float(loss)), GROWN_LOSS, self.unit) for p, loss in losses.items()}
        for player in losses:
            norm = float(torch.nn.utils.get_total_norm(parameters[player]))
            sizes[f"the norm of the weights of player {player!r}"] = (norm, GROWN_WEIGHTS, 1e-12)
        fresh = []
        for what, (size, limit, unit) in sizes.items():
            start = self.start.setdefault(what, max(size, unit))
            if size > limit * start and not any(note.startswith(what) for note in self.notes):
                fresh.append(
                    f"{what} grew from {start:.3g} to {size:.3g} by step {step}: this run diverges; "
                    "try a smaller optimizer.lr, stepper.clip or stepper.radius."
                )
        self.notes += fresh
        return fresh

    def doubts(self, step: int, contradiction: str | None, found: list[str]) -> list[str]:
        """What the certificate at ``step`` gives reason to doubt, each said once in a run: a ``contradiction`` of bounds, and
        what was ``found`` to be no better than not having trained."""
        fresh = []
        if contradiction is not None and not any(note.startswith(CONTRADICTED) for note in self.notes):
            fresh = [f"{CONTRADICTED} {step}: {contradiction}"]
            self.notes += fresh
        self.warned |= bool(found)
        return [*fresh, *(f"step {step}: {sentence}" for sentence in found)]

    def state_dict(self) -> dict:
        told = {"notes": list(self.notes), "warned": self.warned}
        return {"best": self.best and asdict(self.best), "fields": self.fields, "start": dict(self.start), **told}

    def load_state_dict(self, state: dict) -> None:
        self.best, self.certificate = Evaluation(**state["best"]) if state["best"] else None, None
        self.fields = copy.deepcopy(state["fields"])
        self.notes, self.warned = list(notes(state["notes"])), bool(state["warned"])
        self.start = dict(state["start"])


def sanity_warnings(problem: Problem, constants: Constants, certificate: Certificate, seed: int) -> list[str]:
    """What ``certificate`` shows to be no better than not having trained."""
    found = []
    lower, zero, perf = certificate.best_lower, certificate.baseline.get("zero"), certificate.best_perf
    if certificate.counts("F_M") and any(e is not None for e in certificate.lower.values()):
        constant = best_constant(problem, constants, seed)
        estimate = certificate.lower[lower[0]] if lower else None
        if estimate is None or estimate.above < constant - ROUNDING * abs(constant):
            value = f"{estimate.value:.6g}" if estimate else "not finite"
            found.append(f"the lower bound, {value}, is worse than {constant:.6g}, that of the best constant V.")
    if perf is not None and known(zero) and perf[1] > zero.above:
        found.append("the best controller is worse than doing nothing.")
    return found


@torch.no_grad()
def best_constant(problem: Problem, constants: Constants, seed: int) -> float:
    """`max_c F_M(c) = max_c c - M E[(c - f)_+]` over constants `c`, reached at the `1 / M` quantile of `f`."""
    f, weight = problem.probe(CONSTANT_STATES, derive_seed(seed, Branch.BEST_CONSTANT), "f", "weight")
    c = torch.quantile(f, min(1.0, 1.0 / constants.M))  # any c gives a bound, also this one of unweighted states
    return float(c - constants.M * (weight * (c - f).clamp_min(0.0)).mean())
