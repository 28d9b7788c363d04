"""Whether recorded samples can be independent draws, as the means over held-out samples take them to be."""

from pathlib import Path

import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.recorded.plausible import SURE
from ocp_torch.problems.samples import Samples

# Samples that chance puts beside another in the smaller cubes, in a whole file: one in a thousand files.
COPIES_IN_FILE = 1e-3
# Samples that chance puts beside another in the larger cubes, as a part of all samples.
COPIES_PER_SAMPLE = 1e-2
# Largest side, in turns, of the cubes in which a sample counts as a copy and is left out.
COPY_SIDE = 1e-4
# Values that differ by no more are the same but for rounding in single precision.
GRAIN = 2.0**-23


def without_copies(samples: Samples) -> Samples:
    """``samples`` without copies of earlier ones, at the same state but for rounding or a little noise; unchanged where
    chance explains as many."""
    for shift in (0.25, 0.75):  # a pair that one division into cubes parts is in one cube of the other
        near, chance = _beside(samples, COPIES_IN_FILE, shift, COPY_SIDE)
        samples = samples.take(~near) if _beyond(near, chance) else samples
    return samples


def _beyond(near: Tensor, chance: float) -> int:
    """How many more samples are ``near`` ``(N,)`` than the ``chance`` number; 0 within `SURE` standard errors of that."""
    count = int(near.sum())
    return round(count - chance) if count > chance + SURE * chance**0.5 else 0


def _beside(samples: Samples, wanted: float, shift: float = 0.25, largest: float = 1.0) -> tuple[Tensor, float]:
    """Which samples ``(N,)`` share a cube with an earlier one, and how many would by chance.

    Cubes are sized so that this is ``wanted``: fewer where ``largest`` limits their side, more where they are as small as the
    resolution of the states."""
    count, dim = samples.x.shape
    pairs = 0.5 * count * (count - 1) * float((1.0 / samples.weight).mean())  # in a cube of volume 1, on average
    grain = _grain(samples.x)
    sides = grain * (min((wanted / pairs) ** (1.0 / dim), largest) / grain).ceil()
    # Cubes by one number each: comparing rows of `dim` columns takes ten times as long.
    mixed = torch.randint(2**62, (dim,), generator=fixed_generator())
    cubes, cube = ((samples.x / sides + shift).floor().long() * mixed).sum(dim=1).unique(return_inverse=True)
    rows = torch.arange(count)
    first = torch.full((len(cubes),), count).scatter_reduce(0, cube, rows, "amin")
    return rows != first[cube], pairs * float(sides.prod())


def _grain(x: Tensor) -> Tensor:
    """The resolution of each coordinate ``(d,)``, 0.001 for three decimals: the 1 % quantile of the steps between values."""
    steps = [column[column > GRAIN] for column in x.sort(dim=0).values.diff(dim=0).T]
    return torch.stack([s.kthvalue(1 + len(s) // 100).values if len(s) else s.new_tensor(GRAIN) for s in steps])


def dependence_notes(path: Path, samples: Samples) -> tuple[str, ...]:
    """Sentences on signs that the ``samples`` of ``path`` are no independent draws: near copies, and correlated consecutive
    state costs."""
    notes = list[str]()
    same = len(samples) - len(samples.x.unique(dim=0))
    if same > COPIES_PER_SAMPLE * len(samples):
        notes.append(
            f"{same:,} samples of {path.name} are at the state of another, as x has few digits: some are trained on and held "
            "out, and bounds may be wrong by more than their intervals."
        )
    if count := max(
        _beyond(*_beside(samples, wanted)) for wanted in (COPIES_IN_FILE, COPIES_PER_SAMPLE * len(samples))
    ):
        notes.append(
            f"{count:,} samples of {path.name} are nearer to another than chance explains: they are no independent draws, "
            "some are trained on and held out, and bounds may be wrong by more than their intervals."
        )
    centred = samples.f - samples.f.mean()
    spread = float(centred.square().sum())
    correlation = float((centred[1:] * centred[:-1]).sum()) / spread if spread > 0.0 else 0.0
    if correlation * len(centred) ** 0.5 > SURE:
        alike = f"consecutive samples of {path.name} are alike (correlation {correlation:.2g})"
        notes.append(f"{alike}: they are no independent draws, and errors and intervals are too small.")
    return tuple(notes)
