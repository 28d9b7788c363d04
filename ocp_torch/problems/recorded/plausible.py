"""Whether recorded arrays can be what they are called: signs, the range of states, the distribution they were drawn from."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError
from ocp_torch.maths.plane_waves import plane_waves
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.samples import Samples

# Standard errors that a mean may be from what it must be: a normal variable is further off once in 5e8 times.
SURE = 6.0
# What is forgiven beside that, absolutely, of a mean that must be 0 or 1.
FORGIVEN = 1e-3
# Rounding of states and costs, relative to their size: files may be in single precision.
ROUNDING = 1e-6
# Of more samples than that the divergences of so many at least are looked at: of all of a million in twelve coordinates it
# took minutes.
TESTED = 2**14
# Copies are looked for in cubes of two sizes, in which chance puts so many samples beside another: one in a thousand files,
# and one in a hundred samples. Those that are left out are no farther apart than the third number, in turns; rounding puts
# all that is nearer than the fourth into one place.
ONCE, SELDOM, LITTLE, GRAIN = 1e-3, 1e-2, 1e-4, 2.0**-23


def samples_of(path: Path, arrays: dict[str, np.ndarray], wrap: bool) -> Samples:
    """The ``arrays`` of the file ``path``, of known names and shapes and finite, as samples; with ``wrap`` states are taken
    modulo 1. Raises `InputError` where values cannot be what their names say."""
    x, f = arrays["x"], arrays["f"]
    outside = (x < -ROUNDING) | (x > 1.0 + ROUNDING)
    if outside.any() and not wrap:
        row = int(outside.any(axis=1).argmax())
        raise InputError(
            f"{path}: x is {x[row].tolist()} at row {row}, outside [0, 1); scale each coordinate to period 1, "
            "and set problem.wrap=true if whole turns should be taken off."
        )
    if (f < -ROUNDING * np.abs(f).max()).any():
        row = int((f < 0.0).argmax())
        raise InputError(f"{path}: f is {f[row]:g} at row {row}, but must not be negative.")
    for name, what in (("density", "positive"), ("mu0", "at least 0")):
        array = arrays.get(name)
        if array is not None and ((array <= 0.0) if name == "density" else (array < 0.0)).any():
            raise InputError(f"{path}: {name} falls to {array.min():g}, but must be {what}.")
    columns = {name: torch.from_numpy(array) for name, array in arrays.items()}
    one = torch.ones(len(f), dtype=torch.float64)
    density = columns.pop("density", None)
    columns |= {"x": columns["x"].remainder(1.0), "f": columns["f"].clamp_min(0.0)}
    samples = Samples(**{"mu0": one, "weight": one if density is None else 1.0 / density} | columns)
    _require_distribution(path, samples, density is not None)
    return samples


def _require_distribution(path: Path, samples: Samples, given: bool) -> None:
    """The weighted means of what integrates to a known number: 1, `mu0`, and waves along each coordinate."""

    def off(values: Tensor, truth: float) -> float:
        """Standard errors between the weighted mean and ``truth``, less `FORGIVEN`."""
        terms = samples.weight * values
        error = float(terms.std()) / len(terms) ** 0.5
        return max(0.0, abs(float(terms.mean()) - truth) - FORGIVEN) / max(error, 1e-12)

    if off(torch.ones_like(samples.weight), 1.0) > SURE:
        mean = float(samples.weight.mean())
        raise InputError(f"{path}: the mean of 1 / density is {mean:.4g}, but must be 1: density is not that of x.")
    if off(samples.mu0, 1.0) > SURE:
        mean = float(samples.mean(samples.mu0))
        raise InputError(f"{path}: mu0 has mean {mean:.4g} over the torus, but a density must have mean 1.")
    if samples.div_D is not None and samples.div_div_D is not None:
        columns = {"div_div_D": samples.div_div_D, **{f"div_D[{i}]": c for i, c in enumerate(samples.div_D.T)}}
        for name, values in columns.items():
            if off(values, 0.0) > SURE:
                mean = float(samples.mean(values))
                raise InputError(
                    f"{path}: {name} has mean {mean:.4g} over the torus, but a divergence must have mean 0."
                )
    waves = plane_waves(samples.x.shape[1])
    for k in waves[(waves != 0.0).sum(dim=1).argsort(stable=True)]:  # those of a single coordinate say most
        angle = 2.0 * torch.pi * samples.x @ k
        if bool(k.any()) and max(off(angle.cos(), 0.0), off(angle.sin(), 0.0)) > SURE:
            uniform = "the uniform law; give the density of the law it was drawn from"
            law = "the density it comes with; density must be that of x" if given else uniform
            which = k.nonzero().squeeze(-1).tolist()
            together = f"coordinates {which} of x together do" if len(which) > 1 else f"coordinate {which[0]} of x does"
            raise InputError(f"{path}: {together} not follow {law}.")


def stray_divergences(samples: Samples) -> dict[str, str]:
    """Columns of divergences, and of what each is not the divergence: `E[phi div F + F . grad phi] = 0` by parts, for plane
    waves `phi`, unless some of `div F` is hidden in jumps of `F`, or in places too small for a sample to be in one."""
    samples = samples.take(slice(None, None, max(1, len(samples) // TESTED)))
    D = None if samples.noise is None else 0.5 * samples.noise @ samples.noise.mT
    columns = {
        ("div_a", "a"): (samples.a.unsqueeze(-1), samples.div_a),
        ("div_B", "B"): (samples.B, samples.div_B),
        ("div_D", "noise"): (D, samples.div_D),
        ("div_div_D", "div_D"): (samples.div_D, samples.div_div_D),
    }
    waves, count = 2.0 * torch.pi * plane_waves(samples.x.shape[1]), len(samples)
    found = {}
    for (name, of), (field, divergence) in columns.items():
        if field is None or divergence is None:
            continue
        F, div_F = field.reshape(*samples.x.shape, -1), divergence.reshape(count, -1)
        weight = samples.weight.unsqueeze(-1)
        for k in waves:
            phase, along = torch.polar(weight, -(samples.x @ k).unsqueeze(-1)), torch.einsum("ndm,d->nm", F, k)
            terms = torch.view_as_real(phase * torch.complex(div_F, -along))
            error, size = terms.std(dim=0) / count**0.5, terms.abs().mean(dim=0)
            if bool((terms.mean(dim=0).abs() > SURE * error + FORGIVEN * size).any()):
                found[name] = of
                break
    return found


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


def remarks(path: Path, samples: Samples) -> tuple[str, ...]:
    """What a user should be told of the ``samples`` of ``path``: divergences that are not, and signs that they are no
    independent draws, which are near copies and the correlation of consecutive state costs."""
    notes = [
        f"by these samples {name} of {path.name} is not the divergence of its {of}: one of them is in another order or unit, "
        f"or {of} jumps, or nearly so where none of them is; bounds take it as it is."
        for name, of in stray_divergences(samples).items()
    ]
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
