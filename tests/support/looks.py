"""Looks at the bounds that cost nothing: certificates with a gap of the test's choosing."""

from __future__ import annotations

from collections.abc import Callable

from ocp_torch.certificate import Certificate, Run
from ocp_torch.certificate.certify import examined
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.statistics.estimate import Estimate

LOWER = 0.05  # above any constant's bound on the circle, below what doing nothing costs


def certificate(run, gap: float | None, certified: float | None = None, zero: float = 1.0) -> Certificate:
    """A lower bound with a simulated performance ``gap`` above it, and an upper bound ``certified`` above it; examined for
    contradictions as those of a run are, since a ``gap`` below 0 is one."""
    above = lambda part: None if part is None else Estimate(LOWER * (1.0 + part), 0.0, 0.0)
    made = Certificate(
        run=run,
        exact=None,
        lower={"F_M": None if gap is None else Estimate(LOWER, 0.0), "shifted": None},
        upper={"J": None, "G": None, "lagrangian": above(certified)},
        perf={"value": above(gap), "density": None},
        baseline={"zero": Estimate(zero, 0.0, 0.0)},
        assumptions=Assumptions(1.0, 1.0, 1.0, None, None, True, True, True),
    )
    return examined(made)


def quick(gap: Callable[[Run], float | None], **rest) -> Callable:
    """In place of `Evaluator.evaluate`: the gap is a function of the run, that is of its step."""
    return lambda evaluator, run: certificate(run, gap(run), **rest)
