"""Noise that is there as a function, but 0 wherever it was asked: it costs what noise costs, and may be an oversight."""

import torch

from ocp_torch.problems.physical.disturbed import Disturbed
from ocp_torch.problems.problem import Problem

# States that are asked: at others the noise may differ, so that nothing but a sentence follows.
ASKED, DESIGN = 4096, 41


@torch.no_grad()
def idle_noise(problem: Problem) -> str | None:
    """That the noise of ``problem`` is 0 at all states that were asked, in words; `None` where it is not, or where there
    is none."""
    if not problem.has_simulator or not problem.noisy:
        return None
    sigma = problem.noise(*problem.probe(ASKED, DESIGN, "x"))
    if sigma is None or bool(sigma.any()):
        return None
    written = isinstance(problem, Disturbed) and type(problem).noise is Disturbed.noise
    name = "disturbance" if written else "noise"
    return f"{name} is 0 at all of {ASKED:,} states that were tried; where there is no noise it must give None"
