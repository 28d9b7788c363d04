"""A recorder for replays where there is no GPU: it runs functions again, and leaves what they find in the same tensors."""

from __future__ import annotations


class Rerun:
    """Captures nothing, and runs nothing when it is asked to, as a graph does."""

    def __init__(self) -> None:
        self.calls = self.captures = 0

    def call(self, function):
        self.calls += 1
        return function()

    def capture(self, function):
        self.captures += 1
        kept = []

        def replay():
            found = function()
            if not kept:
                kept.extend(None if t is None else t.clone() for t in found)
            for old, new in zip(kept, found, strict=True):
                if old is not None:
                    old.copy_(new)
            return list(kept)

        return replay
