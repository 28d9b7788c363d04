"""Runs side by side: their certificates as rows, the smallest gap first; and what is broken or not finished."""

import math
from collections.abc import Iterable
from pathlib import Path

from ocp_torch.certificate.run import LONGEST_NAME
from ocp_torch.errors import InputError, visible
from ocp_torch.files.reading import FOLDER, kind, read_json
from ocp_torch.runs.comparison import Comparison
from ocp_torch.training.checkpoint import newest

LARGEST_CERTIFICATE = 2**22


def compare(paths: Iterable[Path]) -> Comparison:
    """All runs in ``paths`` (run folders, or folders of them), sorted by the certified gap, then by the simulated one."""
    folders: list[Path] = []
    for path in paths:
        if kind(path) != FOLDER:
            raise InputError(f"{path} is not a folder; give runs' folders, or folders that hold some.")
        folders += run_folders(path)
    rows, unfinished = [], {}
    for folder, name in named(list(dict.fromkeys(folders))).items():
        try:
            rows.append(row_of(folder, name))
        except InputError as error:
            unfinished[name] = str(error)
    rows.sort(key=lambda row: [math.inf if row[c] is None else row[c] for c in ("gap_certified", "gap_simulated")])
    return Comparison(rows, unfinished)


def run_folders(path: Path) -> list[Path]:
    """``path`` if it is a run's folder, else every run's folder below it."""
    marks = (".hydra", "checkpoints", "certificate.json")
    if any(kind(path / mark) is not None for mark in marks):
        return [path]
    return sorted({p.parent for mark in marks for p in path.rglob(mark) if "checkpoints" not in p.parent.parts[-1:]})


def named(folders: list[Path]) -> dict[Path, str]:
    """Each folder by the part of its path that it does not share with all the others, printable."""
    parents = [list(folder.absolute().parts) for folder in folders]
    shared = 0
    while len(parents) > 1 and all(len(p) > shared + 1 for p in parents) and len({p[shared] for p in parents}) == 1:
        shared += 1
    keep = slice(shared, None) if len(parents) > 1 else slice(-1, None)
    return {f: printable("/".join(p[keep])) for f, p in zip(folders, parents, strict=True)}


def printable(text: object) -> str:
    """Names come from files of strangers: nothing in them may steer a terminal, or fill it."""
    return visible(text, LONGEST_NAME)


def row_of(folder: Path, name: str) -> dict:
    """The row of one run. Raises `InputError`, saying why, when it has no certificate that can be read."""
    file = folder / "certificate.json"
    if kind(file) is None:
        raise InputError(progress_of(folder))
    try:
        certificate = read_json(file, LARGEST_CERTIFICATE)
        gap, bounds = certificate["gap"], {}
        for side in ("lower", "upper"):  # the bounds that the gap was taken from
            source = gap[f"{side}_from"]
            bounds[side] = None if source is None else number(certificate[side][source]["value"])
        gaps = {f"gap_{kind}": number(gap[kind]) for kind in ("certified", "simulated")}
        return {
            "run": name,
            **{k: printable(certificate[k]) for k in ("problem", "method")},
            **{k: int(given_number(certificate[k])) for k in ("seed", "step")},
            "train_seconds": number(certificate["train_seconds"]),
            "perf": performance(certificate),
            **bounds,
            "exact": number(certificate["exact"]),
            # None to rank by where the bounds cross, as older versions wrote them: one of them is then wrong.
            **{k: None if value is not None and value < 0.0 else value for k, value in gaps.items()},
            "share": number(certificate["share"]["certified"]),
            "stopped": printable(certificate.get("stopped", "steps")),
            "warnings": len(list(certificate["warnings"])),
        }
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        reason = visible(error if isinstance(error, InputError) else f"{type(error).__name__}: {error}", 200)
        raise InputError(f"its certificate.json is damaged ({reason}).") from None


def performance(certificate: dict) -> float | None:
    """Of the controller that was certified, which older certificates do not name: the one that was given, or that which the
    upper bounds speak of, or else the one with the smallest value that its errors allow."""
    known = {name: e for name, e in certificate["perf"].items() if e is not None and number(e["value"]) is not None}
    spoken_of = [e.get("controller") for e in certificate["upper"].values() if e is not None]
    for name in (certificate.get("controller"), "given", *spoken_of):
        if name in known:
            return number(known[name]["value"])
    at_most = lambda e: e["value"] + (number(e.get("bias")) or 0.0) + 2.0 * given_number(e["se"])
    return number(min(known.values(), key=at_most)["value"]) if known else None


def number(value) -> float | None:
    """A finite number, or `None`; `ValueError` for anything else."""
    return None if value is None else given_number(value)


def given_number(value) -> float:
    """A finite number; `TypeError` where there is none, `ValueError` for anything else."""
    if value is None:
        raise TypeError("a number is missing")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is not a number")
    return value


def progress_of(folder: Path) -> str:
    """How far a run without a certificate came."""
    try:
        state = newest(folder / "checkpoints")[0]
        total = state["config"]["trainer"]["steps"]
        return f"not finished: saved at step {int(state['step'])} of {int(total)}; resume={printable(folder)} goes on."
    except InputError as error:
        return f"not finished: {printable(error)}"
    except (KeyError, TypeError, ValueError):
        return "its checkpoint is not the state of a run."
