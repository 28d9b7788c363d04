"""How much is spent on a certificate, and how sure its intervals are."""

from __future__ import annotations

from dataclasses import dataclass, field

from ocp_torch.certificate.estimate import CONFIDENCE
from ocp_torch.certificate.upper.policy_evaluation import StageSettings
from ocp_torch.errors import require_choice, require_flag, require_integer, require_number
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem

# However few the states of a certificate, its problem is scanned as if there were so many: a feature that is missed is one
# that every bound misses.
LEAST_SCANNED = 2**17
# How performance deals with the infinite horizon: stop late and bound the rest, or stop at an exponential time.
TRUNCATED, RANDOM = "truncated", "random"


@dataclass(frozen=True)
class CertificateSettings:
    """Effort and level of a certificate. Raises `InputError` on counts that cannot give a standard error."""

    points: int = 16384  # states per replicate for the integrals and sampled suprema
    replicates: int = 8  # independent randomised point sets behind each standard error
    trajectories: int = 256  # simulated starts per replicate; 0 skips every simulation
    ascents: int = 32  # local ascents from the worst sampled states
    mollify: bool | None = None  # recombine and average V for the bound without M; None: where there is no M
    occupation_states: int = 144  # where the supremum of the occupation density is looked for; 0 skips it
    rigorous: bool = False  # a lower bound proved over cells, in one and two dimensions: a second, or up to two minutes
    confidence: float = CONFIDENCE  # how often an interval covers the truth, by Student's t over the replicates
    tolerance: float = 5e-5  # relative; a trajectory's steps are halved until its cost changes by less
    horizon: str = TRUNCATED  # truncated: bounded tail in `bias`; random: an exponential time, no tail and more noise
    stage: StageSettings = field(default_factory=StageSettings)  # the fit to the closed loop

    def __post_init__(self) -> None:
        require_integer("certificate.points", self.points, 1)
        require_integer("certificate.replicates", self.replicates, 2)
        require_integer("certificate.trajectories", self.trajectories, 0)
        require_integer("certificate.ascents", self.ascents, 1)
        if self.mollify is not None:
            require_flag("certificate.mollify", self.mollify)
        require_integer("certificate.occupation_states", self.occupation_states, 0)
        require_flag("certificate.rigorous", self.rigorous)
        require_number("certificate.confidence", self.confidence, above=0.0, at_most=0.999999)
        require_number("certificate.tolerance", self.tolerance, above=0.0)
        require_choice("certificate.horizon", self.horizon, (TRUNCATED, RANDOM))

    def scanned(self, problem: Problem) -> int:
        """How many states the data of ``problem`` are scanned at for narrow features."""
        return problem.scan_factor * max(self.points * self.replicates, LEAST_SCANNED)

    def searches(self, constants: Constants) -> bool:
        """Whether the bound without `M` is sought among functions made of `V` too, for a problem of these ``constants``."""
        return constants.needs_no_M if self.mollify is None else self.mollify
