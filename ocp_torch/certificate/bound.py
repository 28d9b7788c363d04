"""What a bound is: a number on one side of the optimum, how it is found, and what it rests on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, cast

from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.maths.supremum import Extremum
from ocp_torch.problems.needs import Need

if TYPE_CHECKING:
    from ocp_torch.certificate.context import Context
    from ocp_torch.certificate.external.dataset import RecordedContext

# The sides, named as `certificate.json` names them: below `OPT`, above `OPT` and the controller's performance, and below
# that performance.
LOWER, UPPER, PERFORMANCE = "lower", "upper", "perf_lower"


class Bound(ABC):
    """One bound, without any state: what it computes that others share is a property of the `Context`, and what takes long
    the context keeps in its `results`.

    A new bound is a subclass in a file of its own and one line in `ocp_torch.certificate.bounds.BOUNDS`. ``name`` and
    ``side`` (`LOWER`, `UPPER` or `PERFORMANCE`) say where `certificate.json` has it, ``label`` what tables call it.
    """

    name: str
    side: str
    label: str

    @abstractmethod
    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        """What it rests on, beside a problem that is one: it counts where every need holds and none is guessed."""

    @abstractmethod
    def evaluate(self, context: Context) -> Estimate | None:
        """The number; `None` where ``context`` cannot give it."""

    def applies(self, context: Context) -> bool:
        """Whether certificates of ``context`` have an entry for it, be it an empty one."""
        return True

    def valid(self, context: Context) -> bool:
        """Whether nothing that was found shows the number to be wrong. One that is wrong is not shown at all."""
        return True

    def about(self, context: Context) -> str | None:
        """Of an upper bound: the controller whose performance it bounds; `None` where it bounds `OPT` alone."""
        return context.kind

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        """What a user should be told beside the number that is ``shown``."""
        return []

    def searches(self, context: Context) -> list[str]:
        """How the suprema behind it were found, a sentence each."""
        return []


def recorded(context: Context) -> RecordedContext:
    """``context``, for bounds that apply only where it is `recorded`."""
    return cast("RecordedContext", context)  # its module imports bounds, so that its class cannot be asked for here


def sentence_on(what: str, found: Extremum) -> str:
    """How the supremum ``what`` was found."""
    return f"{what} = {found.value:.3e}, the largest of {found.points:,} sampled states and {found.ascents} ascents"
