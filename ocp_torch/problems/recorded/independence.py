"""Whether recorded samples can be independent draws: bounds are means over some that training has not seen."""

from pathlib import Path

import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.recorded.plausible import SURE
from ocp_torch.problems.samples import Samples

# Copies are looked for in cubes of two sizes, in which chance puts so many samples beside another: one in a thousand files,
# and one in a hundred samples. Those that are left out are no farther apart than the third number, in turns; rounding puts
# all that is nearer than the fourth into one place.
ONCE, SELDOM, LITTLE, GRAIN = 1e-3, 1e-2, 1e-4, 2.0**-23


def without_copies(samples: Samples) -> Samples:
    """``samples`` without those at the state of an earlier one, or as near to it as rounding or a little noise has them; all
    of them where chance explains these."""
    for shift in (0.25, 0.75):  # a pair that one division into cubes parts is in one cube of the other
        near, chance = _beside(samples, ONCE, shift, LITTLE)
        samples = samples.take(~near) if _beyond(near, chance) else samples
    return samples


def _beyond(near: Tensor, chance: float) -> int:
    """How many more are ``near`` ``(N,)`` than by ``chance``, 0 where that may be."""
    count = int(near.sum())
    return round(count - chance) if count > chance + SURE * chance**0.5 else 0


def _beside(samples: Samples, wanted: float, shift: float = 0.25, largest: float = 1.0) -> tuple[Tensor, float]:
    """Which samples ``(N,)`` share a cube with an earlier one, and how many would by chance: as many as are ``wanted``, fewer
    where cubes are the ``largest``, and more where they are as small as states are recorded."""
    count, dim = samples.x.shape
    pairs = 0.5 * count * (count - 1) * float((1.0 / samples.weight).mean())  # in a cube of volume 1, on average
    grain = _grain(samples.x)
    sides = grain * (min((wanted / pairs) ** (1.0 / dim), largest) / grain).ceil()
    # Numbers of cubes: rows of as many columns as there are coordinates take ten times as long to compare.
    mixed = torch.randint(2**62, (dim,), generator=fixed_generator())
    cubes, cube = ((samples.x / sides + shift).floor().long() * mixed).sum(dim=1).unique(return_inverse=True)
    rows = torch.arange(count)
    first = torch.full((len(cubes),), count).scatter_reduce(0, cube, rows, "amin")
    return rows != first[cube], pairs * float(sides.prod())


def _grain(x: Tensor) -> Tensor:
    """How finely each coordinate is recorded, ``(d,)``, as to three decimals: hardly any of its values are nearer to the next
    than that."""
    steps = [column[column > GRAIN] for column in x.sort(dim=0).values.diff(dim=0).T]
    return torch.stack([s.kthvalue(1 + len(s) // 100).values if len(s) else s.new_tensor(GRAIN) for s in steps])


def dependence_notes(path: Path, samples: Samples) -> tuple[str, ...]:
    """Signs that the ``samples`` of ``path`` are no independent draws: near copies, and the correlation of consecutive state
    costs."""
    notes = list[str]()
    same = len(samples) - len(samples.x.unique(dim=0))
    if same > SELDOM * len(samples):
        notes.append(
            f"{same:,} samples of {path.name} are at the state of another, as x has few digits: some are trained on and held "
            "out, and bounds may be wrong by more than their intervals."
        )
    if count := max(_beyond(*_beside(samples, wanted)) for wanted in (ONCE, SELDOM * len(samples))):
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
