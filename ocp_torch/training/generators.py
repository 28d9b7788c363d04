"""The process's own random generators: a problem of a user's may draw from them, so a run seeds and keeps them too."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch

from ocp_torch.maths.seeds import Branch, derive_seed


def seed_generators(seed: int) -> None:
    """Start every global generator from ``seed`` alone."""
    branch = derive_seed(seed, Branch.GLOBAL_GENERATORS)
    torch.manual_seed(branch)
    np.random.seed(branch % 2**32)  # noqa: NPY002 (the global one is what a user's code draws from)
    random.seed(branch)


def generator_states() -> dict:
    """Their states, as tensors and plain numbers that a checkpoint can hold."""
    state: Any = np.random.get_state()  # noqa: NPY002
    name, keys, *rest = state
    version, words, spare = random.getstate()
    states = {
        "torch": torch.get_rng_state(),
        "numpy": [name, keys.tolist(), *map(float, rest)],
        "python": [version, list(words), spare],
    }
    if torch.cuda.is_initialized():
        states["cuda"] = torch.cuda.get_rng_state_all()
    return states


def restore_generators(states: dict) -> None:
    """Put every global generator where `generator_states` found it."""
    torch.set_rng_state(states["torch"])
    name, keys, position, has_gauss, cached = states["numpy"]
    state = (str(name), np.array(keys, dtype=np.uint32), int(position), int(has_gauss), float(cached))
    np.random.set_state(state)  # noqa: NPY002
    version, words, spare = states["python"]
    random.setstate((int(version), tuple(map(int, words)), spare))
    if "cuda" in states and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(states["cuda"])
