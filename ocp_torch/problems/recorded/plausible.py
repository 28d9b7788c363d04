"""Whether recorded arrays can be what they are called: signs, the range of states, their distribution, divergences."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError
from ocp_torch.maths.plane_waves import plane_waves
from ocp_torch.problems.samples import Samples

# Standard errors that a mean may be from what it must be: a normal variable is further off once in 5e8 times.
SURE = 6.0
# Absolute error of a mean that must be 0 or 1 that is allowed beside that.
FORGIVEN = 1e-3
# Rounding of states and costs, relative to their size: files may be in single precision.
ROUNDING = 1e-6
# Divergences of longer recordings are tested at no fewer samples than this: all of a million in twelve coordinates took
# minutes.
TESTED = 2**14


def samples_of(path: Path, arrays: dict[str, np.ndarray], wrap: bool) -> Samples:
    """The finite ``arrays`` of the file ``path``, whose names and shapes were checked, as samples; ``wrap`` takes states
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
    """Raise where the weighted mean of a function with a known integral is off: of 1, `mu0`, divergences and plane waves."""

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
    for k in waves[
        (waves != 0.0).sum(dim=1).argsort(stable=True)
    ]:  # waves of a single coordinate first: they tell most
        angle = 2.0 * torch.pi * samples.x @ k
        if bool(k.any()) and max(off(angle.cos(), 0.0), off(angle.sin(), 0.0)) > SURE:
            uniform = "the uniform law; give the density of the law it was drawn from"
            law = "the density it comes with; density must be that of x" if given else uniform
            which = k.nonzero().squeeze(-1).tolist()
            together = f"coordinates {which} of x together do" if len(which) > 1 else f"coordinate {which[0]} of x does"
            raise InputError(f"{path}: {together} not follow {law}.")


def stray_divergences(samples: Samples) -> dict[str, str]:
    """Names of wrong divergence columns, with the field `F` that each is not the divergence of.

    By parts `E[phi div F + F . grad phi] = 0` for plane waves `phi`, unless some of `div F` is in jumps of `F`, or in places
    too small for a sample to be in one."""
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


def divergence_notes(path: Path, samples: Samples) -> tuple[str, ...]:
    """A sentence on each divergence in ``path`` that is wrong by its ``samples``."""
    return tuple(
        f"by these samples {name} of {path.name} is not the divergence of its {of}: one of them is in another order or unit, "
        f"or {of} jumps, or nearly so where none of them is; bounds take it as it is."
        for name, of in stray_divergences(samples).items()
    )
