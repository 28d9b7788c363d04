"""Suprema that hide in steep places: local maxima to which ascents from the largest of random values do not lead."""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.maths.jets import Field
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import Extremum, batched, climb, peaks_in_reach, supremum

# Ascents of a search in steep places for each ascent from the largest values: peaks of .09 and .30 % of a bound were then
# found with 8 of 8 seeds in three and two coordinates; of one of 1.07 % in five coordinates .75 to 1.07 % was.
STEEP_ASCENTS = 64
STATES_PER_ASCENT = 8  # random states among which a search chooses the steepest, for each of its ascents
MOST_SEARCHES = 8  # searches at most
FRUITLESS = 2  # searches in a row without a higher peak after which no other is made
# Highest ends of a search that climb on in double precision: a peak of .09 % of a bound was .03 % high before.
FINISHED = 32
NEGLIGIBLE = 1e-5  # peaks are sought that are higher than the known supremum by more than this part of a unit


class Peaks(NamedTuple):
    """States ``x`` ``(K, d)`` where the highest of so many ``ascents`` ended."""

    x: Tensor
    ascents: int


def steep_peaks(
    function: Field,
    rough: Field,
    dim: int,
    starts: int,
    known: float,
    unit: float,
    generator: torch.Generator | None = None,
) -> Peaks:
    """Peaks of ``function`` in steep places, by searches until `FRUITLESS` in a row have found nothing higher.

    A search climbs from the random states, at most ``starts``, within whose reach the function may be largest, if that is
    above ``known`` by more than `NEGLIGIBLE` times ``unit``. It climbs ``rough``, the function in single precision, in half
    the time, and then ``function`` from the highest ends. Bounds draw the same states each time; training gives another
    ``generator``.
    """
    found: list[Tensor] = []
    generator, fruitless = generator or fixed_generator(), 0
    while fruitless < FRUITLESS and len(found) < MOST_SEARCHES:
        x = torch.rand(STATES_PER_ASCENT * starts, dim, generator=generator, dtype=torch.float64)
        enough = known + NEGLIGIBLE * abs(unit)
        ends, values = peaks_in_reach(rough, x, starts, enough)
        if len(ends) == 0:
            found.append(ends)
            break
        ends = ends[values.topk(min(FINISHED, len(ends))).indices]
        ends, values = climb(function, ends, batched(function, ends))
        found.append(ends.remainder(1.0))
        higher = bool((values > enough).any())
        known, fruitless = (float(values.max()), 0) if higher else (known, fruitless + 1)
    return Peaks(torch.cat(found), starts * len(found))


def climbed_from(function: Field, values: Tensor, states: Tensor, ascents: int) -> Extremum:
    """The supremum of a ``function`` whose ``values`` ``(N,)`` at ``states`` are known: the largest of those, then local
    ascents from the largest; an estimate from below."""
    start = states[values.topk(min(ascents, len(values))).indices]
    return replace(supremum(function, start, ascents=ascents), points=len(states))
