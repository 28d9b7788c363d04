"""Noise that is given but 0 at all states tried: it takes the time that noise takes, and may be an oversight."""

import torch

from ocp_torch.problems.physical.disturbed import Disturbed
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.replaced import replaced

# States that are tried; elsewhere the noise may not be 0, so that only a sentence follows.
ASKED = 4096
# Number of their fixed design.
DESIGN = 41


@torch.no_grad()
def idle_noise(problem: Problem) -> str | None:
    """A sentence that the noise of ``problem`` is 0 at all states that were tried; `None` where it is not, or where there is
    no noise."""
    if not problem.has_simulator or not problem.noisy:
        return None
    sigma = problem.noise(*problem.probe(ASKED, DESIGN, "x"))
    if sigma is None or bool(sigma.any()):
        return None
    written = isinstance(problem, Disturbed) and not replaced(problem, "noise", Disturbed)
    name = "disturbance" if written else "noise"
    return f"{name} is 0 at all of {ASKED:,} states that were tried; where there is no noise it must give None"
