"""What a certifier tells while it works: the name of each part as it begins. It prints nothing itself."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str], None]


def silent(part: str) -> None:
    """Nobody wants to know."""
