"""What a configuration may not lack."""

from __future__ import annotations

from typing import cast

from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from ocp_torch.cli.explain import CONFIGS
from ocp_torch.errors import InputError


def require_places(overrides: list[Override]) -> None:
    """Raise `InputError` where a field or a group of ours is left out: defaults stand in the configuration alone. A class of
    a user's own may do without some of the problem's, or all."""
    own = any(o.key_or_group == "problem._target_" and not o.is_delete() for o in overrides)
    for override in overrides:
        name = override.key_or_group
        if own and name == "problem":
            continue
        if override.is_delete() and not name.startswith(("hydra", "problem.", "experiment")):
            raise InputError(f"~{name} leaves out {name}, which is needed; set it to another value instead.")


def require_sections(data: dict, config_name: str) -> dict:
    """``data``, if each group and field at the top of the configuration has a place in it; else `InputError`."""
    loaded = OmegaConf.load(CONFIGS / f"{config_name}.yaml")
    file = cast(dict, OmegaConf.to_container(loaded, resolve=False))  # at the top of our own files there are names
    chosen = [item for entry in file.pop("defaults", []) if isinstance(entry, dict) for item in entry.items()]
    groups = [(key.partition("@")[2] or key).split(".")[0] for key, choice in chosen if choice is not None]
    for name in dict.fromkeys([*groups, *file]):
        if name not in data and not name.startswith(("hydra", "override ")):
            raise InputError(f"{name} is missing; give {name}=... on the command line.")
    return data
