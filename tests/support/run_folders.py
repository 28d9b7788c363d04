"""What a run leaves in its folder, and whether two runs left the same."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ocp_torch.training.checkpoint import load_checkpoint
from support.bits import differences
from support.forked import certificate_in


def left_in(folder: Path) -> dict:
    """Everything a run leaves, but for the clock."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0})
    events.Reload()
    timed = ("throughput/", "hparam/", "running/")  # running estimates are made while there is time
    scalars = [tag for tag in events.Tags()["scalars"] if not tag.startswith(timed)]
    metrics = folder / "metrics.json"
    saved = load_checkpoint(folder / "checkpoints" / "last.pt")
    return {
        "state": {k: v for k, v in saved.items() if k not in ("seconds", "elapsed")},
        "weights": load_file(folder / "controller.safetensors"),
        "certificate": certificate_in(folder) | {"train_seconds": None},
        "metrics": json.loads(metrics.read_text()) if metrics.exists() else None,
        "figures": sorted(p.name for p in (*folder.glob("figures/*"), *folder.glob("*.html"))),
        "scalars": {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in scalars},
        "images": {tag: [e.step for e in events.Images(tag)] for tag in events.Tags()["images"]},
        "unfinished": (folder / "checkpoints" / "unfinished").exists(),
        "leftovers": [p.name for p in folder.rglob("*") if p.name.startswith(".") and p.name != ".hydra"],
    }


def assert_same_run(folder: Path, whole: Path) -> None:
    """State and weights of ``folder`` are those of ``whole`` to the bit, the rest is equal, and nothing is left half done."""
    one, other = left_in(folder), left_in(whole)
    for part in ("state", "weights"):
        assert differences(one.pop(part), other.pop(part)) == []
    for part in one:
        assert one[part] == other[part], part
    assert not one["unfinished"]
    assert one["leftovers"] == []
