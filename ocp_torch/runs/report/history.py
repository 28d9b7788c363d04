"""The curves of a run, from the events that it wrote for TensorBoard."""

import math
from pathlib import Path

from ocp_torch.files.reading import FILE, kind

EVENTS = "events.out.tfevents.*"
# Bytes of events that are read, and different curves, at most; a long run has written a hundredth of either.
LARGEST_EVENTS, MOST_CURVES = 2**27, 500

Curves = dict[str, list[tuple[float, float]]]


def curves(folder: Path) -> Curves:
    """Name -> points ``(step, value)`` of all scalars that the run in ``folder`` wrote, in the order of their steps; empty
    where its events are gone, damaged or no run's."""
    files = sorted(folder.glob(EVENTS))
    if any(kind(file) != FILE for file in files) or sum(file.stat().st_size for file in files) > LARGEST_EVENTS:
        return {}
    # TensorBoard takes a while to import: only to read.
    from tensorboard.backend.event_processing.event_file_loader import LegacyEventFileLoader

    found: dict[str, dict[float, float]] = {}
    try:
        for file in files:
            for event in LegacyEventFileLoader(str(file)).Load():
                for value in event.summary.value:
                    if value.WhichOneof("value") == "simple_value" and len(found) < MOST_CURVES:
                        # What a resume wrote again takes the place of what was there.
                        found.setdefault(value.tag, {})[float(event.step)] = value.simple_value
    except Exception:  # the library has no one type for damage
        return {}
    finite = lambda points: [(x, y) for x, y in sorted(points.items()) if math.isfinite(y)]
    return {tag: finite(points) for tag, points in found.items()}


def group(found: Curves, name: str) -> Curves:
    """Those whose names begin with ``name`` and a slash, by the rest of it."""
    return {tag.partition("/")[2]: points for tag, points in found.items() if tag.partition("/")[0] == name}
