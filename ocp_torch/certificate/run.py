"""What a certificate says about the run it belongs to."""

from __future__ import annotations

from dataclasses import dataclass

from ocp_torch.errors import InputError, require_integer, require_number, visible

# Of the name of a problem or a method, in characters: a longer one would break tables.
LONGEST_NAME = 120


@dataclass(frozen=True)
class Run:
    """Which run; ``step`` and ``samples``, the states drawn, are those of its end, 0 where nothing was trained."""

    problem: str
    method: str
    seed: int = 0
    step: int = 0
    samples: int = 0
    train_seconds: float = 0.0
    stopped: str = "steps"  # why training ended: steps, target_gap, max_seconds, not_finite or failed

    @classmethod
    def read(cls, certificate: dict) -> Run:
        """What ``certificate``, as a file has it, says. Raises `InputError` where it does not say it, or absurdly."""
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
