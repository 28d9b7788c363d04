"""The rounds of a run: which step belongs to which, and how often a player that waits at their start has moved."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Rounds:
    """Round `k` (from 0) has `2^k` times as many steps as the first, which has ``length``; there are ``most`` at most."""

    length: int
    most: int

    def end(self, k: int) -> int:
        """The number of steps after which round ``k`` is over."""
        return self.length * (2 ** (k + 1) - 1)

    def progress(self, step: int, k: int) -> float:
        """The part of round ``k`` that is done after ``step`` steps."""
        return 1.0 - (self.end(k) - step) / (self.length * 2**k)

    def at(self, step: int) -> int:
        """The round that a run is in after ``step`` steps."""
        k = 0
        while step >= self.end(k) and k + 1 < self.most:
            k += 1
        return k

    def moves(self, step: int, k: int, delay: float) -> int:
        """How often a player has moved after ``step`` steps, in round ``k``, that waits for the part ``delay`` of each."""
        count, begin = 0, 0
        for earlier in range(k + 1):
            length = self.length * 2**earlier
            done = min(length, step - begin)
            count += max(0, done - math.ceil(delay * length))
            begin += length
        return count
