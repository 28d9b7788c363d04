r"""Which plane waves `e^{2 pi i k . x}` a problem's data are made of: features that its value function is likely to want.

Coordinates that act together, as phases that differ or joint angles that add up, show as wave vectors `k` with several
entries. A network that gets only single coordinates must learn such products one factor at a time; here they are found
beforehand, from the Fourier coefficients of `f`, `a`, `B` and `mu0` at random states.
"""

import itertools
import math

import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.samples import Samples

WAVE_STATES = 8192  # from which Fourier coefficients are estimated
MIXTURES = 4  # random mixtures that stand for all entries of `a`, and as many for those of `B`
MOST_SUMS = 1_000_000  # candidates at most, which are sums `l + r` of wave vectors of two lists
HIGHEST_HARMONIC = 6  # largest entry of a candidate
# Under sampling noise alone, the chance that any coefficient of any function passes the bar is e^-MARGIN, 5 %.
MARGIN = 3.0
# A standard deviation below this part of the mean size is rounding in single precision: the function is constant.
ROUNDING = 1e-5


def prominent_waves(samples: Samples, count: int) -> Tensor:
    """At most ``count`` wave vectors ``(W, d)``, most prominent first, of at least two non-zero entries each.

    A wave counts only where its coefficient is beyond what sampling noise shows anywhere: none is found in data without
    interaction. Of `k` and `-k` one is given.
    """
    return waves_of(samples.x, _channels(samples), count, entries=2)


def waves_of(x: Tensor, functions: list[Tensor], count: int, entries: int = 1) -> Tensor:
    """At most ``count`` wave vectors ``(W, d)``, chosen as in `prominent_waves`, of ``functions`` ``(N,)`` with mean 0 and
    variance 1 at random states ``x`` ``(N, d)``: of at least ``entries`` non-zero entries each."""
    dim = x.shape[1]
    if count == 0 or dim < entries or not functions:
        return torch.zeros(0, dim, dtype=torch.float32)
    left, right = (k.float() for k in candidate_parts(dim))
    score = torch.zeros(len(left), len(right), dtype=torch.float32)
    significant = torch.zeros(score.shape, dtype=torch.bool)
    E_left, E_right = (conjugate(x.float() @ k.T) for k in (left, right))
    bar = math.log(score.numel() * len(functions)) + MARGIN
    for y in functions:
        # Under noise alone N |c|^2 is exponential with mean 1.
        power = len(x) * ((E_left * y.float().unsqueeze(-1)).T @ E_right / len(x)).abs().square()
        score += power
        significant |= power > bar
    order = torch.where(significant, score, 0.0).flatten().argsort(descending=True)[: int(significant.sum())]
    found: dict[tuple, None] = {}
    for i in order.tolist():
        wave = left[i // len(right)] + right[i % len(right)]
        first = next((e for e in wave.tolist() if e), 0.0)
        if int((wave != 0).sum()) >= entries:
            found.setdefault(tuple((wave * math.copysign(1.0, first)).tolist()))
        if len(found) == count:
            break
    return torch.tensor(list(found), dtype=torch.float32).reshape(-1, dim)


def conjugate(turns: Tensor) -> Tensor:
    """`e^{-2 pi i t}`."""
    return torch.polar(torch.ones_like(turns), -2.0 * math.pi * turns)


def looks_at_all(dim: int) -> bool:
    """Whether the candidates are all wave vectors with entries up to 2, or more."""
    return 5**dim <= MOST_SUMS


def candidate_parts(dim: int) -> tuple[Tensor, Tensor]:
    """Two lists of wave vectors, ``(L, d)`` and ``(R, d)``; the candidates are all sums of one of each.

    A full grid over both halves of the coordinates where that is affordable, else waves of few coordinates.
    """
    half = dim // 2
    for K in range(HIGHEST_HARMONIC, 1, -1):
        if (2 * K + 1) ** dim <= MOST_SUMS:
            axis = torch.arange(-K, K + 1.0)
            grid = lambda n, axis=axis: torch.cartesian_prod(*[axis] * n).reshape(-1, n) if n else torch.zeros(1, 0)
            pad = lambda waves, before: torch.nn.functional.pad(waves, (before, dim - before - waves.shape[1]))
            return pad(grid(half), 0), pad(grid(dim - half), half)
    zero = torch.zeros(1, dim)
    single = torch.cat([zero, *(k * torch.eye(dim) for k in (1.0, -1.0, 2.0, -2.0))])
    if (1 + 4 * dim + math.comb(4 * dim, 2)) * len(single) > MOST_SUMS:  # said before they fill the memory
        return single, single
    pair = torch.cat([single, torch.stack([a + b for a, b in itertools.combinations(single[1:], 2)])])
    for left, right in ((pair, pair), (pair, single)):
        if len(left) * len(right) <= MOST_SUMS:
            return left, right
    return single, single


def _channels(samples: Samples) -> list[Tensor]:
    """The data as scalar functions ``(N,)`` of mean 0 and variance 1; what is constant is left out."""
    generator = fixed_generator()
    raw = [samples.f, samples.mu0]
    for entries in (samples.a, samples.B.flatten(1)):
        spread = entries.float().std(dim=0)
        mix = (
            torch.randn(entries.shape[1], MIXTURES, generator=generator, dtype=torch.float32)
            / torch.where(spread > 0, spread, 1.0)[:, None]
        )
        raw += list((entries.float() @ mix).T)
    channels = []
    for y in raw:
        channels += standardised(y.float() * samples.weight.float())
    return channels


def standardised(y: Tensor) -> list[Tensor]:
    """``y`` with mean 0 and variance 1, as a list; empty where it is constant."""
    centred = y - y.mean()
    spread = float(centred.std())
    return [centred / spread] if spread > ROUNDING * float(y.abs().mean()) else []
