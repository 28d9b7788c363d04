"""Processes of this machine: whose children live, and waiting for what they do."""

from __future__ import annotations

import os
import time

import pytest

linux = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="looks for processes in /proc")


def descendants(process: int) -> set[int]:
    """All living processes that ``process`` started, or that these did."""
    parents = {}
    for name in filter(str.isdecimal, os.listdir("/proc")):
        try:
            with open(f"/proc/{name}/stat") as file:
                state, parent = file.read().rpartition(")")[2].split()[:2]
        except OSError:
            continue
        if state != "Z":
            parents[int(name)] = int(parent)
    found, fresh = set(), {process}
    while fresh:
        fresh = {p for p, parent in parents.items() if parent in fresh} - found
        found |= fresh
    return found


def wait_until(true, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def alive(processes: set[int]) -> set[int]:
    return {p for p in processes if os.path.exists(f"/proc/{p}") and open(f"/proc/{p}/stat").read().split()[2] != "Z"}
