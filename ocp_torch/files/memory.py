"""Whether what is asked for fits into this machine's memory: told before it is tried."""

from __future__ import annotations

import os
from pathlib import Path

from ocp_torch.errors import InputError

GIGABYTE = 1e9
# A container's own limit, in both generations of control groups.
LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def memory() -> float:
    """Bytes that this process could ever have; infinite where nobody says."""
    found = []
    if {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= os.sysconf_names.keys():
        found.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
    for limit in LIMITS:
        try:
            found.append(float(limit.read_text()))
        except (OSError, ValueError):  # there is none, or it is the word max
            continue
    return min((size for size in found if size > 0.0), default=float("inf"))


def require_memory(name: str, value: int, each: float) -> None:
    """Raise `InputError` when ``value`` things of ``each`` bytes, at least, are more than the machine has."""
    most = memory()
    if value * each > most:
        raise InputError(
            f"{name} is {value}, which needs {value * each / GIGABYTE:,.3g} GB of memory or more, but this machine has "
            f"{most / GIGABYTE:.3g}; at most {int(most / each)} fit."
        )
