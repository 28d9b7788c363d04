"""The commands as functions, for scripts and notebooks: `from ocp_torch import train, reference, compare`."""

import contextlib
import logging
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ocp_torch.cli.asked import Asked, data_of, flat
from ocp_torch.cli.job import isolated
from ocp_torch.cli.single import require_writable, told
from ocp_torch.compute.processes import joined
from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError, require_integer, shown
from ocp_torch.files.reading import kind, read_json, require_path, require_unlinked
from ocp_torch.files.storage import only_writer
from ocp_torch.problems import Problem
from ocp_torch.problems.blame import blamed
from ocp_torch.runs.build import build_problem, checked_problem
from ocp_torch.runs.compare import Comparison, ranked, row_from
from ocp_torch.runs.compare import compare as compared
from ocp_torch.runs.configuration import keep_configuration, locate, next_subfolder
from ocp_torch.runs.finish import missing
from ocp_torch.runs.metrics.trial import METRICS
from ocp_torch.runs.report.report import REPORT, write_report
from ocp_torch.runs.resume import result_of
from ocp_torch.runs.run import TrainingRun, ending, handed_out, training_run
from ocp_torch.runs.trained import History, TrainedRun, TrainingFailed
from ocp_torch.runs.watch import Callback, CallbackFailed, Moment, Watch
from ocp_torch.studies.reference.reference import Reference, solve_reference
from ocp_torch.training.checkpoint import LAST
from ocp_torch.training.settings import MOST_THREADS
from ocp_torch.training.stopping import Preempted

__all__ = ["Callback", "History", "Moment", "TrainedRun", "TrainingFailed", "compare", "reference", "train"]

log = logging.getLogger(__name__)


def train(
    problem: Asked,
    *,
    method: str | None = None,
    steps: int | None = None,
    seed: int | None = None,
    folder: str | Path | None = None,
    resume: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    callback: Callback | None = None,
    progress: bool | None = None,
    **parameters: Any,
) -> TrainedRun:
    """Train a controller for ``problem`` and certify it: `python scripts/train.py`, to the same bits where PyTorch's default
    dtype is float32, which it is unless somebody changes it.

    ``problem`` is a `Problem`, or the name of one, with its ``parameters``: `train("pendulum", torque_noise=0.3)`.
    ``settings`` sets any field by its name on the command line: `{"trainer.batch": 256, "optimizer": "adam"}`; ``method``,
    ``steps`` and ``progress`` (of the trainer) and ``seed`` are short for such. What is left out is as in `configs/`.

    ``folder`` is a new one for all that a run leaves but its log, which Python's `logging` has; without it nothing is kept,
    nor figures drawn. ``resume`` goes on with the run of a folder, in it. ``callback`` is given a `Moment` at every logged
    step and look at the bounds, and stops the run by returning `True`; it is then certified as it is.

    Raises `InputError` where the command line would refuse, `TrainingFailed` where a run under way fails, and what a callback
    raises. Ctrl-C ends the step in hand, saves what has a folder, and raises `KeyboardInterrupt`; a second one does so at
    once. Random generators, threads, signal handlers and Hydra are left as they were.
    """
    if joined().size > 1:
        raise InputError("torchrun shares the runs of scripts/train.py alone among processes; call train() without it.")
    if not (callback is None or callable(callback)):
        raise InputError(f"callback is {shown(callback)}, but must be a function of one Moment, or None.")
    short = {"method": method, "trainer.steps": steps, "seed": seed, "resume": resume, "trainer.progress": progress}
    fields = {name: value for name, value in short.items() if value is not None}
    changed = flat(settings or {})
    for name in fields.keys() & changed.keys():
        raise InputError(f"{name} is set twice; leave one of them out.")
    unseen = {} if folder or resume else {"trainer.figures": False}
    history = History()
    try:
        with isolated():
            with told():
                config = data_of("train", problem, parameters, {**unseen, **fields, **changed})
                run = training_run(config, problem if isinstance(problem, Problem) else None)
                place = _place(config, None if folder is None else require_path("folder", folder))
                done = None if place is None else _finished(run, place)
            return done or _trained(run, place, history, partial(Watch, history=history, callback=callback))
    except CallbackFailed as failure:
        raise failure.__cause__ or failure from None
    except Preempted as stop:
        if stop.number == signal.SIGTERM:  # leave it to the handler that was there before
            signal.raise_signal(stop.number)
        raise KeyboardInterrupt(f"stopped by {stop}") from None


def _trained(run: TrainingRun, place: Path | None, history: History, watch: Callable[..., Watch]) -> TrainedRun:
    """The results of ``run``, trained to its end in the folder ``place``, or with nothing kept."""
    for note in run.notes:
        log.warning("warning: %s", note)
    with _kept(run, place) as where:
        try:
            end = ending(run.trainer, run.settings, where, watch, exits=False)
        except (Exception, SystemExit) as error:
            raise blamed(error) or error from None
    made = TrainedRun(end.controller, end.controller.certificate, history, end.metrics, place)
    if end.failed is not None:
        raise TrainingFailed(
            f"{end.failed.rstrip('.')}; its run has the controller of {handed_out(run.trainer)}.", made
        )
    return made


def _place(config: dict, folder: Path | None) -> Path | None:
    """The folder for the run of ``config``: ``folder``, or that of the run it resumes. Raises `InputError`."""
    own = None if config["resume"] is None else locate(Path(config["resume"]))[0]
    if own is not None and folder is not None and own.resolve() != folder.resolve():
        raise InputError(f"folder is {shown(str(folder))}, but a resume goes on in {own}; leave folder out.")
    place = own or folder
    if place is not None:
        require_writable(place, "folder")
        require_unlinked(place)
    if place is not None and own is None and (place / "checkpoints" / LAST).exists():
        raise InputError(
            f"{place} holds a run already; go on with it by resume={str(place)!r}, or give another folder."
        )
    return place


def _finished(run: TrainingRun, place: Path) -> TrainedRun | None:
    """The results of the run in ``place`` if it is finished already, else `None`."""
    done = None if run.state is None else result_of(place, run.state, run.trainer.config)
    lacking = missing(place, run.trainer, run.settings)
    if done is None or lacking not in (None, REPORT):
        return None
    if lacking == REPORT:  # made of the other files
        write_report(place, run.trainer.problem, run.trainer.config)
    controller = load_controller(place / "controller.safetensors", problem=run.trainer.problem)
    metrics = read_json(place / METRICS) if kind(place / METRICS) is not None else None
    return TrainedRun(controller, controller.certificate, metrics=metrics, folder=place)


@contextlib.contextmanager
def _kept(run: TrainingRun, place: Path | None) -> Iterator[Path]:
    """The folder that ``run`` is written to: ``place`` with its configuration, or a temporary one."""
    if place is None:
        with tempfile.TemporaryDirectory(prefix="ocp_torch_") as gone:
            yield Path(gone)
    else:
        place.mkdir(parents=True, exist_ok=True)
        with only_writer(place):
            (place / next_subfolder(place)).mkdir(parents=True, exist_ok=True)
            keep_configuration(place, run.config)
            yield place


def reference(
    problem: Asked, *, side: int | None = None, memory: float = 4.0, threads: int = 1, **parameters: Any
) -> Reference:
    """`OPT` of ``problem``, in one to three dimensions, with `V` and `u` from grids: `python scripts/reference.py`.

    ``problem`` and ``parameters`` are as in `train`; ``side`` nodes a coordinate has the finest of three grids (`None`: by
    dimension), which may take ``memory`` gigabytes. Raises `InputError`.
    """
    with isolated(), told():
        if isinstance(problem, Problem) and not parameters:
            made = checked_problem(problem)
        else:
            made = build_problem(data_of("reference", problem, parameters, {})["problem"])
        torch.set_num_threads(require_integer("threads", threads, 1, maximum=MOST_THREADS))
        return solve_reference(made, side, memory)


def compare(runs: TrainedRun | str | Path | Iterable[TrainedRun | str | Path]) -> Comparison:
    """``runs``, as `train` gives them, or folders of one or many, side by side: `python scripts/compare.py`.

    The smallest gap comes first; runs that are in no folder are named by their place among ``runs``. Raises `InputError`.
    """
    given = list(runs) if isinstance(runs, Iterable) and not isinstance(runs, str) else [runs]
    found = compared([require_path("a run", run) for run in given if not isinstance(run, TrainedRun)])
    names = {k: str(run.folder or f"run {k}") for k, run in enumerate(given) if isinstance(run, TrainedRun)}
    rows = [row_from(run.certificate, names[k]) for k, run in enumerate(given) if isinstance(run, TrainedRun)]
    folders = {names[k]: run.folder for k, run in enumerate(given) if isinstance(run, TrainedRun) and run.folder}
    return Comparison(ranked([*found.rows, *rows]), found.unfinished, {**found.folders, **folders})
