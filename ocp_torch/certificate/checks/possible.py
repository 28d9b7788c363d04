"""Whether a certificate of the settings asked for can be had of a problem: told before anything is trained."""

from __future__ import annotations

from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.errors import InputError
from ocp_torch.files.limits import require_memory
from ocp_torch.problems.problem import Problem

DOUBLE = 8  # bytes of a number
# Numbers that a simulated trajectory and a state of the occupation's supremum have in memory at once, at least, per
# coordinate of states and controls: those of a Runge-Kutta step.
AT_ONCE = 4


def require_possible(problem: Problem, settings: CertificateSettings, trains_value: bool = True) -> None:
    """Raise `InputError` where ``settings`` ask for more memory than there is, or for a proof that there is none of."""
    d, m, replicates = problem.dim, problem.control_dim, settings.replicates
    if settings.rigorous:
        _require_provable(d, trains_value)
    sample = DOUBLE * (2 * d + 2)  # x, f, a and mu0; a constant B takes no room
    moving = DOUBLE * AT_ONCE * (d + m)
    require_memory("certificate.replicates", replicates, sample)
    require_memory("certificate.points", settings.points, replicates * sample)
    require_memory("certificate.trajectories", settings.trajectories, replicates * moving)
    require_memory("certificate.occupation_states", settings.occupation_states, moving)
    require_memory("certificate.ascents", settings.ascents, moving)
    require_memory("certificate.stage.batch", settings.stage.batch, sample)


def _require_provable(dim: int, trains_value: bool) -> None:
    from ocp_torch.certificate.proof.obstacle import MOST_DIMENSIONS  # a proof is loaded only where one is asked for

    if dim > MOST_DIMENSIONS or not trains_value:
        why = f"d = {dim}" if dim > MOST_DIMENSIONS else "no V that the proof could speak of"
        raise InputError(
            f"certificate.rigorous is true, but a bound is proved for a trained V in at most {MOST_DIMENSIONS} dimensions, "
            f"and here there is {why}; leave it false."
        )
