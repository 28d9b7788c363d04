"""The curves of a run, from the events that it wrote for TensorBoard."""

import math
from pathlib import Path

from ocp_torch.files.reading import FILE, kind

EVENTS = "events.out.tfevents.*"
# Bytes of events that are read, at most; a long run has written a hundredth of this.
LARGEST_EVENTS = 2**27
# Different curves that are read, at most; a long run has written a hundredth of this.
MOST_CURVES = 500

Curves = dict[str, list[tuple[float, float]]]


def curves(folder: Path) -> Curves:
    """Name -> points ``(step, value)``, in the order of the steps, of all scalars that the run in ``folder`` wrote; empty
    where its events are missing, damaged or too large."""
    files = sorted(folder.glob(EVENTS))
    if any(kind(file) != FILE for file in files) or sum(file.stat().st_size for file in files) > LARGEST_EVENTS:
        return {}
    # Imported here, as TensorBoard takes a while to import.
    from tensorboard.backend.event_processing.event_file_loader import LegacyEventFileLoader

    found: dict[str, dict[float, float]] = {}
    try:
        for file in files:
            for event in LegacyEventFileLoader(str(file)).Load():
                for value in event.summary.value:
                    if value.WhichOneof("value") == "simple_value" and len(found) < MOST_CURVES:
                        # A later value at the same step, written by a resume, replaces the earlier one.
                        found.setdefault(value.tag, {})[float(event.step)] = value.simple_value
    except Exception:  # the library has no one type for damage
        return {}
    finite = lambda points: [(x, y) for x, y in sorted(points.items()) if math.isfinite(y)]
    return {tag: finite(points) for tag, points in found.items()}


def group(found: Curves, name: str) -> Curves:
    """The curves whose names begin with ``name`` and a slash, by the rest of their names."""
    return {tag.partition("/")[2]: points for tag, points in found.items() if tag.partition("/")[0] == name}
