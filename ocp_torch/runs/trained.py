"""The results of a run that was trained from Python."""

from dataclasses import dataclass, field
from pathlib import Path

from ocp_torch.certificate import table
from ocp_torch.certificate.report import gap_in_words
from ocp_torch.control.controller import Controller
from ocp_torch.errors import InputError
from ocp_torch.runs.report.report import write_report


@dataclass(frozen=True)
class History:
    """Lists of a dict for each moment, as `pandas.DataFrame(history.looks)` takes them: ``step``, ``samples`` drawn,
    ``seconds`` spent in steps, and the scalars of a `Moment`. The last of the ``looks`` is the final certificate."""

    steps: list[dict[str, float]] = field(default_factory=list)
    looks: list[dict[str, float]] = field(default_factory=list)
    warm_start: list[dict[str, float]] = field(default_factory=list)


@dataclass(frozen=True, repr=False)
class TrainedRun:
    """The result of `train`. ``certificate`` is the dict of `certificate.json`, printed as a table by `print(run)`;
    ``metrics`` that of `metrics.json`, for problems with metrics; ``folder`` the run's folder, `None` if nothing was kept.
    """

    controller: Controller
    certificate: dict
    history: History = field(default_factory=History)
    metrics: dict | None = None
    folder: Path | None = None

    def report(self) -> Path:
        """Write the run's `report.html` anew and return its path. Raises `InputError` where the run is in no folder."""
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
    """A loss stopped being finite, or the problem failed, during training; ``run`` has the results up to then."""

    def __init__(self, sentence: str, run: TrainedRun) -> None:
        super().__init__(sentence)
        self.run = run
