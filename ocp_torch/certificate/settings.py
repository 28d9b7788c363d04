"""What is asked of a certificate: its run, its effort and its confidence; and whether that can be had."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

from ocp_torch.certificate.statistics.estimate import CONFIDENCE
from ocp_torch.errors import InputError, require_choice, require_flag, require_integer, require_number, visible
from ocp_torch.files.limits import require_memory
from ocp_torch.maths.runge_kutta import MAX_DOUBLINGS
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.steppers.fitting import LARGEST_RATE

# Longest name of a problem or a method, in characters: a longer one would break tables.
LONGEST_NAME = 120
# How performance deals with the infinite horizon: stop late and bound the rest, or stop at an exponential time.
TRUNCATED, RANDOM = "truncated", "random"
# Which controller is handed out: the one with the lowest simulated performance, or with the lowest bound without simulation.
SIMULATED, CERTIFIED = "simulated", "certified"
DOUBLE = 8  # bytes of a number
AT_ONCE = 4  # numbers in memory at once, at least, per coordinate of states and controls: those of a Runge-Kutta step

# Called with the name of each part of a certificate as it begins; `silent` ignores it.
Progress = Callable[[str], None]
silent: Progress = lambda part: None


@dataclass(frozen=True)
class Run:
    """Which run a certificate is of; ``step`` and ``samples`` (states drawn) are at its end, 0 where nothing was trained."""

    problem: str
    method: str
    seed: int = 0
    step: int = 0
    samples: int = 0
    train_seconds: float = 0.0
    stopped: str = "steps"  # why training ended: see `ocp_torch.training.stopping`

    @classmethod
    def read(cls, certificate: dict) -> "Run":
        """The run that ``certificate``, read from a file, names. Raises `InputError` where a field is missing or absurd."""
        said = {name: certificate[name] for name in cls.__dataclass_fields__ if name in certificate}
        for name in ("problem", "method", *({"stopped"} & said.keys())):
            if not isinstance(said.get(name), str):
                raise InputError("the controller's certificate does not say which problem and method it is of.")
            said[name] = visible(said[name], LONGEST_NAME)
        for name in {"seed", "step", "samples"} & said.keys():
            require_integer(f"{name} of the certificate", said[name], 0, maximum=2**63)
        if "train_seconds" in said:
            require_number("train_seconds of the certificate", said["train_seconds"], at_least=0.0)
        return cls(**said)


@dataclass(frozen=True)
class StageSettings:
    """Budget of policy evaluation, `certificate.stage` of a configuration. Raises `InputError` on a wrong value."""

    steps: int = 300  # least-squares steps in the first round; 0 for none at all
    rounds: int = 3  # at most, each twice as long as the one before; where the slack is steep the last one alone
    good_excess: float = 1e-4  # part of the Lagrangian bound that comes from the residual, below which rounds end
    batch: int = 256  # states per step; twice as many where the slack is steep
    lr: float = 1.0e-2  # learning rate, with cosine decay in each round

    def __post_init__(self) -> None:
        require_integer("certificate.stage.steps", self.steps, 0)
        require_integer("certificate.stage.rounds", self.rounds, 1, maximum=16)
        require_number("certificate.stage.good_excess", self.good_excess, above=0.0)
        require_integer("certificate.stage.batch", self.batch, 1)
        require_number("certificate.stage.lr", self.lr, above=0.0, at_most=LARGEST_RATE)


@dataclass(frozen=True)
class CertificateSettings:
    """Effort and level of a certificate. Raises `InputError` on counts that cannot give a standard error."""

    points: int = 16384  # states per replicate for the integrals and sampled suprema
    replicates: int = 8  # independent randomised point sets behind each standard error
    trajectories: int = 256  # simulated starts per replicate; 0 skips every simulation
    ascents: int = 32  # local ascents from the worst sampled states; 64 times as many start where a slack is steep
    mollify: bool | None = None  # train on and average V for the bound without M; None: where there is no M
    bound_steps: int | None = None  # by which V is trained on for that bound; None: 2,000, with noise 700; 0: none
    occupation_states: int = 144  # where the supremum of the occupation density is looked for; 0 skips it
    rigorous: bool = False  # a lower bound proved over cells, in one and two dimensions: a second, or some minutes
    confidence: float = CONFIDENCE  # how often an interval covers the truth, by Student's t over the replicates
    tolerance: float = 5e-5  # relative; a trajectory's steps are halved until its cost changes by less
    horizon: str = TRUNCATED  # truncated: bounded tail in `bias`; random: an exponential time, no tail and more noise
    prefer: str = SIMULATED  # hand out the controller of the lowest performance, simulated or certified
    stage: StageSettings = field(default_factory=StageSettings)  # the fit to the closed loop
    # Whether a few trajectories are simulated once more, on far finer steps, for the bias, and suprema for the bound without
    # M sought in steep places too: no claim may do without, so that this is no field of a configuration.
    audited: ClassVar[bool] = True
    doublings: ClassVar[int] = MAX_DOUBLINGS  # of the steps of a simulation without noise, at most

    def __post_init__(self) -> None:
        least = {"points": 1, "replicates": 2, "trajectories": 0, "ascents": 1, "occupation_states": 0}
        for name, minimum in least.items():
            require_integer(f"certificate.{name}", getattr(self, name), minimum)
        if self.bound_steps is not None:
            require_integer("certificate.bound_steps", self.bound_steps, 0)
        if self.mollify is not None:
            require_flag("certificate.mollify", self.mollify)
        require_flag("certificate.rigorous", self.rigorous)
        require_number("certificate.confidence", self.confidence, above=0.0, at_most=0.999999)
        require_number("certificate.tolerance", self.tolerance, above=0.0)
        require_choice("certificate.horizon", self.horizon, (TRUNCATED, RANDOM))
        require_choice("certificate.prefer", self.prefer, (SIMULATED, CERTIFIED))

    def searches(self, constants: Constants) -> bool:
        """Whether the bound without `M` is sought among functions made of `V` too, for a problem of these ``constants``."""
        return constants.needs_no_M if self.mollify is None else self.mollify


def require_possible(problem: Problem, settings: CertificateSettings, trains_value: bool = True) -> None:
    """Raise `InputError`, before anything is trained, where ``settings`` ask for more memory than there is, or for a proof
    that is not available."""
    d, m, replicates = problem.dim, problem.control_dim, settings.replicates
    if settings.rigorous:
        # Imported only where a proof is asked for.
        from ocp_torch.certificate.proof.rigorous import MOST_DIMENSIONS

        if d > MOST_DIMENSIONS or not trains_value:
            why = f"d = {d}" if d > MOST_DIMENSIONS else "no V that the proof could speak of"
            raise InputError(
                "certificate.rigorous is true, but a bound is proved for a trained V in at most "
                f"{MOST_DIMENSIONS} dimensions, and here there is {why}; leave it false."
            )
    sample = DOUBLE * (2 * d + 2)  # x, f, a and mu0; a constant B takes no room
    moving = DOUBLE * AT_ONCE * (d + m)
    each = {"replicates": sample, "points": replicates * sample, "trajectories": replicates * moving}
    for name, size in {**each, "occupation_states": moving, "ascents": moving}.items():
        require_memory(f"certificate.{name}", getattr(settings, name), size)
    require_memory("certificate.stage.batch", settings.stage.batch, sample)
