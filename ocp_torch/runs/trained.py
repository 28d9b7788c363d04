"""What a run that was trained from Python gives."""

from dataclasses import dataclass, field
from pathlib import Path

from ocp_torch.certificate import table
from ocp_torch.certificate.report import gap_in_words
from ocp_torch.control.controller import Controller
from ocp_torch.errors import InputError
from ocp_torch.runs.report.report import write_report


@dataclass(frozen=True)
class History:
    """One dict for each moment, made for `pandas.DataFrame(history.looks)`: ``step``, ``samples`` drawn, ``seconds``
    spent in steps, and the scalars of a `Moment`. The last of the ``looks`` is the final certificate."""

    steps: list[dict[str, float]] = field(default_factory=list)
    looks: list[dict[str, float]] = field(default_factory=list)
    warm_start: list[dict[str, float]] = field(default_factory=list)


@dataclass(frozen=True, repr=False)
class TrainedRun:
    """What `train` gives. ``certificate`` is the dict of `certificate.json`, printed as a table by `print(run)`; ``metrics``
    that of `metrics.json`, for problems with numbers of their own; ``folder`` where the run was written, `None` for nowhere.
    """

    controller: Controller
    certificate: dict
    history: History = field(default_factory=History)
    metrics: dict | None = None
    folder: Path | None = None

    def report(self) -> Path:
        """Write the run's `report.html` anew; its path. Raises `InputError` where the run is in no folder."""
        if self.folder is None:
            raise InputError("this run is in no folder, and a report is made of its files; train it with folder=...")
        return write_report(self.folder, self.controller.problem, self.controller.config)

    def __str__(self) -> str:
        return table(self.certificate)

    def __repr__(self) -> str:
        name, gap = "{problem}/{method}, seed {seed}, step {step}".format(**self.certificate), self.certificate["gap"]
        shown = ", ".join(f"{k}: {gap_in_words(gap[k])}" for k in ("certified", "simulated") if gap[k] is not None)
        return f"<TrainedRun {name}; gap {shown or 'unknown'}; {self.folder or 'in no folder'}>"


class TrainingFailed(InputError):
    """A loss stopped being finite, or the problem failed, under way; ``run`` is what there is of it all the same."""

    def __init__(self, sentence: str, run: TrainedRun) -> None:
        super().__init__(sentence)
        self.run = run
