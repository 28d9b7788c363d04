"""What a bound is: a number on one side of the optimum, how it is found, and what it rests on."""

from abc import ABC, abstractmethod
from typing import cast

from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.contexts.recorded import RecordedContext
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.maths.supremum import Extremum
from ocp_torch.problems.needs import Need

# The sides of bounds, by their names in `certificate.json`.
LOWER = "lower"  # below `OPT`
UPPER = "upper"  # above `OPT` and the controller's performance
PERFORMANCE = "perf_lower"  # below that performance


class Bound(ABC):
    """One bound, without any state: what bounds share is a property of the `Context`, and what takes long to compute is kept
    in its `results`.

    A new bound is a subclass in a file of its own and one line in `ocp_torch.certificate.bounds.BOUNDS`. ``name`` and
    ``side`` (`LOWER`, `UPPER` or `PERFORMANCE`) say where `certificate.json` has it, ``label`` what tables call it.
    """

    name: str
    side: str
    label: str

    @abstractmethod
    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        """What the bound rests on, beside a well-posed problem: it counts where every need holds and none is guessed."""

    @abstractmethod
    def evaluate(self, context: Context) -> Estimate | None:
        """The number; `None` where ``context`` cannot give it."""

    def applies(self, context: Context) -> bool:
        """Whether certificates of ``context`` have an entry for the bound, be it an empty one."""
        return True

    def valid(self, context: Context) -> bool:
        """Whether nothing that was found shows the number to be wrong; a wrong one is not shown at all."""
        return True

    def about(self, context: Context) -> str | None:
        """The controller whose performance an upper bound bounds; `None` where it bounds `OPT` alone."""
        return context.kind

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        """Warnings that belong to the number that is ``shown``."""
        return []

    def searches(self, context: Context) -> list[str]:
        """How the suprema behind the bound were found, a sentence each."""
        return []


def recorded(context: Context) -> RecordedContext:
    """``context``, for bounds that apply only where it is `recorded`."""
    return cast(RecordedContext, context)


def sentence_on(what: str, found: Extremum) -> str:
    """How the supremum ``what`` was found."""
    return f"{what} = {found.value:.3e}, the largest of {found.points:,} sampled states and {found.ascents} ascents"
