"""Composition without reading every file again: for tests that compose hundreds of command lines."""

from __future__ import annotations

import contextlib

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ocp_torch.cli import compose as composition


def is_field(override: str) -> bool:
    """Whether it sets a field, not a choice of a group: ``trainer.steps=3``, ``seed=1``."""
    name = override.split("=")[0]
    return ("." in name and "@" not in name) or name in ("seed", "resume")


@contextlib.contextmanager
def quickly():
    """Within, each choice of files is composed once, and fields are then set in a copy; what is not plainly the setting of
    a field that is there, or goes wrong, is composed from the files."""
    real, kept = composition.compose, {}

    def compose(config_name, overrides=(), **options):
        files = tuple(o for o in overrides if not is_field(o))
        fields = composition.parsed([o for o in overrides if is_field(o)])
        if any(o.is_sweep_override() or o.is_delete() or o.is_add() for o in fields):
            return real(config_name, list(overrides), **options)
        if (config_name, files) not in kept:
            kept[config_name, files] = real(config_name, list(files), **options)
        config = kept[config_name, files].copy()
        OmegaConf.set_struct(config, True)
        try:
            for field in fields:
                OmegaConf.update(config, field.key_or_group, field.value(), force_add=field.is_force_add())
        except OmegaConfBaseException:
            return real(config_name, list(overrides), **options)
        return config

    composition.compose = compose
    try:
        yield
    finally:
        composition.compose = real


def oracle(x):
    """The plainest simulator there is, in two dimensions: for tests that need one by name."""
    return np.ones(len(x)), None, np.broadcast_to(np.eye(2), (len(x), 2, 2))
