"""What a run tells whoever watches it."""

from ocp_torch.certificate import Certificate
from ocp_torch.steppers import StepReport


class Observer:
    """Is told by the `Trainer` ``trainer``, and shows nothing: for tests, for use as a library, and to inherit from."""

    def stepped(self, trainer, report: StepReport, log: bool) -> None:
        """A step was taken; ``log`` says whether it is one to be recorded."""

    def evaluated(self, trainer, certificate: Certificate) -> None:
        """A quick evaluation was made."""

    def warmed(self, trainer, looked: bool) -> None:
        """A round of the warm start was made; ``looked`` says whether its controller was tried after it."""

    def refined(self, trainer, helped: bool | None) -> None:
        """Gauss-Newton steps begin (``helped`` is `None`), or have ended."""

    def extended(self, trainer) -> None:
        """Another round begins."""

    def noticed(self, sentence: str) -> None:
        """Something is wrong with the run's health."""
