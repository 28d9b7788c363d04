"""Whether recorded columns are functions of the state: then neighbouring samples have similar values."""

from pathlib import Path

import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.recorded.plausible import TESTED
from ocp_torch.problems.samples import Samples

COLUMNS = ("f", "a", "B", "mu0", "noise")
ASKED = 2**10  # samples whose nearest neighbours are looked for
AT_ONCE = 2**9  # of these, which bounds the memory
# Samples, and values other than the commonest, below which nothing is said.
FEWEST = 64
# Nearest neighbours are near enough for the test if waves of so many periods in a turn have, between them, at most the part
# 1 - NEAR of the mean square difference of any two samples.
PERIODS = 4
NEAR = 0.5
# A column has nothing to do with the state if the mean square difference of its ranks is less than this part smaller between
# neighbours than between any two samples, by so many standard errors.
PART = 0.3
STANDARD_ERRORS = 3.0
# A column whose values differ by less, relative to 1 + the largest, is constant: files may be in single precision.
CONSTANT = 1e-5


def neighbour_notes(path: Path, samples: Samples) -> tuple[str, ...]:
    """A sentence for each column of ``path`` in which neighbours are hardly more alike than any two of ``samples``."""
    return tuple(
        f"{name} of {path.name} has nothing to do with x by these samples, as it differs between neighbours almost as much "
        "as between any two: its rows are in another order, or it varies faster, or is noisier, than they show; bounds take "
        "it as it is."
        for name in unrelated(samples)
    )


def unrelated(samples: Samples) -> list[str]:
    """Names of columns in which neighbours are hardly more alike than any two, with the entries where only some are."""
    if len(samples) < FEWEST:
        return []
    samples = samples.take(slice(None, None, max(1, len(samples) // TESTED)))
    turns = 2.0 * torch.pi * samples.x
    circles = lambda periods: torch.cat([(periods * turns).cos(), (periods * turns).sin()], dim=1)
    asked = torch.arange(0, len(samples), max(1, len(samples) // ASKED))
    nearest = torch.cat([_nearest(circles(1), rows) for rows in asked.split(AT_ONCE)])
    waves = circles(PERIODS)
    left = (waves[asked] - waves[nearest]).square().mean(dim=0)
    if bool((left > (1.0 - NEAR) * 2.0 * waves.var(dim=0)).any()):
        return []
    found = list[str]()
    for name in COLUMNS:
        column = getattr(samples, name)
        entries = [] if column is None else list(column.reshape(len(samples), -1).T)
        wrong = [k for k, values in enumerate(entries) if _strange(values, asked, nearest)]
        which = "" if len(wrong) == len(entries) else " at " + ", ".join(map(str, wrong))
        found += [name + which] if wrong else []
    return found


def _nearest(points: Tensor, rows: Tensor) -> Tensor:
    """For each of ``rows`` ``(K,)`` the nearest other row of ``points`` ``(N, k)``, ``(K,)``."""
    apart = torch.cdist(points[rows], points)
    apart[torch.arange(len(rows)), rows] = torch.inf
    return apart.argmin(dim=1)


def _strange(values: Tensor, asked: Tensor, nearest: Tensor) -> bool:
    """Whether ``values`` ``(N,)``, by their ranks, differ between neighbours almost as much as between any two."""
    if float(values.max() - values.min()) <= CONSTANT * (1.0 + float(values.abs().max())):
        return False
    _, place, counts = values.unique(return_inverse=True, return_counts=True)
    ranks = (counts.cumsum(0) - 0.5 * counts.double())[place] / len(values)
    here = ranks[asked]
    if int((here != here.mode().values).sum()) < FEWEST:
        return False
    other = nearest[
        torch.randperm(len(nearest), generator=fixed_generator())
    ]  # rows may have an order: take random pairs
    any_two, beside = (here - ranks[other]).square(), (here - ranks[nearest]).square()
    lost = any_two - beside
    return float(lost.mean()) + STANDARD_ERRORS * float(lost.std()) / len(lost) ** 0.5 < PART * float(any_two.mean())
