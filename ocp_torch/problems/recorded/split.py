"""Recorded samples in three parts: to train on, to choose by while training, and held out for the certificate."""

from __future__ import annotations

from dataclasses import replace

import torch

from ocp_torch.errors import InputError
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.samples import Samples

TRAINING, VALIDATION, HELD_OUT = "training", "validation", "held_out"
# The part of what is not held out that evaluations during training are made on.
VALIDATION_PART = 0.1
# Fewest samples of a part that anything is estimated from.
FEWEST = 32


def split(samples: Samples, held_out: float, seed: int) -> dict[str, Samples]:
    """The parts by name, drawn at random by ``seed``; ``held_out`` in (0, 1) is the size of that part.

    Raises `InputError` where a part would be too small.
    """
    count = len(samples)
    generator = torch.Generator().manual_seed(derive_seed(seed, Branch.DATASET_SPLIT))
    order = torch.randperm(count, generator=generator)
    held = round(held_out * count)
    chosen_by = max(FEWEST, round(VALIDATION_PART * (count - held)))
    if held < FEWEST or count - held - chosen_by < FEWEST:
        raise InputError(
            f"problem.held_out = {held_out:g} of {count} samples leaves too few on one side; each part needs "
            f"at least {FEWEST}."
        )
    rows = order.split([held, chosen_by, count - held - chosen_by])
    return {name: samples.take(part) for name, part in zip((HELD_OUT, VALIDATION, TRAINING), rows, strict=True)}


def with_divergences(samples: Samples, constant_matrix: bool) -> Samples:
    """``samples`` with the divergences that are 0: of `a` where there is no drift, of `B` where it is the same everywhere."""
    zero = torch.zeros_like(samples.f)
    if samples.div_a is None and not samples.a.any():
        samples = replace(samples, div_a=zero)
    if samples.div_B is None and constant_matrix:
        samples = replace(samples, div_B=zero.unsqueeze(-1).expand(-1, samples.B.shape[-1]))
    return samples
