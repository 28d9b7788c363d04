"""Problems of the package by the names that files of earlier versions have for them."""

from __future__ import annotations

from typing import Any

PACKAGE = "ocp_torch.problems"
# Class in an earlier version -> class now.
RENAMED = {"Callable": "Simulator"}


def current_target(target: Any) -> Any:
    """The class that ``target``, of a configuration of any version, names now: classes of the package have had other names
    and lain in other modules of it. Anything else comes back as it is."""
    from ocp_torch import problems  # which imports this room's other modules

    package, _, name = str(target).rpartition(".")
    now = RENAMED.get(name, name)
    ours = package == PACKAGE or package.startswith(f"{PACKAGE}.")
    return f"{PACKAGE}.{now}" if ours and now in problems.__all__ else target


def current_section(section: Any) -> Any:
    """``section``, the problem of a configuration, with its `current_target`; as it is where it names none."""
    if not isinstance(section, dict) or "_target_" not in section:
        return section
    return {**section, "_target_": current_target(section["_target_"])}


def current_name(name: object, section: object) -> object:
    """The name by which the problem of ``section``, saved under ``name``, goes now."""
    target = str(section.get("_target_")) if isinstance(section, dict) else ""
    cls = target.rpartition(".")[2]
    renamed = cls in RENAMED and current_target(target) != target
    return RENAMED[cls].lower() if renamed and name == cls.lower() else name
