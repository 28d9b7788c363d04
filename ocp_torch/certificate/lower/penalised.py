r"""`F_M(V) = E[V mu0 - M max(Q, 0)] <= OPT` for every `M >= sup mu*` (section 4.1 of the paper).

A constant `c` taken off `V` takes `c` off its slack: for every `c` there is the bound `E[V mu0] - c - M E[max(Q - c, 0)]`. It
is highest where `Q > c` on the part `1 / M` of the torus: what is then taken off `E[V mu0]` is the mean of `Q` over that
part, its conditional value at risk (Rockafellar and Uryasev, 2000), and never more than `sup Q`, as in the shifted bound.
"""

from dataclasses import replace

import torch
from torch import Tensor

from ocp_torch.certificate.lower.levels import best_level
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.lower.shifted import Shift
from ocp_torch.certificate.lower.slack import SlackParts
from ocp_torch.certificate.statistics.estimate import Estimate, starting_level, starting_mean
from ocp_torch.certificate.statistics.tails import rarity, unmet
from ocp_torch.maths.jets import Field
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.recorded.dataset import Dataset
from ocp_torch.problems.samples import Samples

FEWEST_ABOVE = 16  # states of a half that must lie above the constant taken off `V`: with fewer none is sought
MOST_TRAINED = 2**15  # training samples at most that are compared with the held-out ones


def penalised(V: SampledValue, M: float) -> Estimate:
    """`F_M` of `V` itself, no constant taken off."""
    slacks = [part.slack(1.0) for part in V.own.parts]
    return _penalised(V.initial, V.sets, slacks, [0.0] * len(slacks), M)


def levelled(shift: Shift, M: float) -> Estimate:
    """`F_M(theta W - c)` for the value `W` of ``shift``, its best multiple and the best constant; the shifted bound where
    hardly any state would lie above the constant. Each half of the sets takes multiple and constant from the other half, so
    that the search does not flatter the bound."""
    if FEWEST_ABOVE * M > sum(map(len, shift.sets[1::2])):
        return shift.estimate
    weights = [samples.weight for samples in shift.sets]
    mean = sum(shift.initial) / len(shift.initial)
    found = [best_level(SlackParts.join(shift.parts[k::2]), torch.cat(weights[k::2]), mean, M) for k in (0, 1)]
    thetas, levels, _ = zip(*(found[1 - i % 2] for i in range(len(shift.sets))), strict=True)
    slacks = [part.slack(theta) for part, theta in zip(shift.parts, thetas, strict=True)]
    initial = [theta * e for theta, e in zip(thetas, shift.initial, strict=True)]
    return _penalised(initial, shift.sets, slacks, list(levels), M)


def penalised_on_records(problem: Dataset, sets: list[Samples], value: Field, M: float) -> Estimate:
    """`F_M` of ``value``, a weighted mean over the held-out samples in ``sets``; the interval is widened by what these show
    less of than training samples do."""
    trained = Generator.of(problem, problem.training.take(slice(MOST_TRAINED)))
    known = trained.chunked_jet(value)
    level = starting_level(trained.data, known.value)
    seen = [(generator := Generator.of(problem, s), generator.chunked_jet(value)) for s in sets]
    initial = [starting_mean(g.data, V.value, level) for g, V in seen]
    slacks = [g.hjb_slack(V) for g, V in seen]
    found = _penalised(initial, sets, slacks, [0.0] * len(sets), M)
    # A violation, or a start, that is larger in training samples than in any held-out one was missed there by chance.
    violated = lambda data, V, slack: float((data.weight * slack.clamp_min(0.0)).max())
    started = lambda data, V, slack: float((data.weight * data.mu0 * (V.value - level).abs()).max())
    missed = 0.0
    for shown, counted in ((violated, M), (started, 1.0)):
        largest = shown(trained.data, known, trained.hjb_slack(known))
        if largest > max(shown(g.data, V, slack) for (g, V), slack in zip(seen, slacks, strict=True)):
            missed += counted * unmet(largest, sum(map(len, sets)))
    return replace(found, bias=(found.bias or 0.0) + missed) if missed else found


def _penalised(
    initial: list[float], sets: list[Samples], slacks: list[Tensor], levels: list[float], M: float
) -> Estimate:
    """`E[V mu0] - c - M E[max(Q - c, 0)]`, with a level `c` for each set; the interval is widened where a few states carry
    the last mean."""
    parts = zip(sets, slacks, levels, strict=True)
    violations = [samples.weight * (slack - c).clamp_min(0.0) for samples, slack, c in parts]
    terms = zip(initial, levels, violations, strict=True)
    found = Estimate.of([e - c - M * float(v.mean()) for e, c, v in terms])
    rare = rarity(torch.cat(violations), sum(initial) / len(initial) / M)
    return replace(found, bias=M * rare) if rare > 0.0 else found
