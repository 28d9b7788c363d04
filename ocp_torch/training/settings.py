"""The trainer's own settings, validated where they are made, and the rounds of steps that follow from them."""

import math
from dataclasses import dataclass

import torch

from ocp_torch.errors import InputError, require_choice, require_flag, require_integer, require_number

# Many more threads than any machine has cores crash the thread pool.
MOST_THREADS = 1024


@dataclass(frozen=True)
class TrainerSettings:
    """Budget, precision, device and rhythm of a run. Raises `InputError`, naming the field, on a wrong value."""

    steps: int  # updates of every player, in the first round
    rounds: int  # rounds at most, each twice as long as the one before; the next starts only while good_gap is not met
    good_gap: float  # relative gap between the lower bound and the simulated performance that needs no further round
    batch: int  # states per draw
    dtype: str  # float32 or float64, for networks and samples; certificates are always float64
    device: str  # auto (a GPU where there is one), cpu or cuda
    threads: int  # CPU threads; one is fastest for small networks
    log_every: int  # steps between scalars
    evaluate_every: int  # steps between quick bounds; 0 for none
    checkpoint_every: int  # steps between checkpoints; 0 for one at the end
    keep: int  # checkpoints kept: last.pt, last-1.pt, ...
    target_gap: float | None  # stop once this certified gap is reached; null for never
    max_seconds: float | None  # of training, those before a resume included; null for no limit
    figures: bool  # draw figures at the end and in TensorBoard
    progress: bool  # a progress bar, where the output is a terminal
    newton_steps: int = 0  # Gauss-Newton steps on V at the end of a round; runs from before there were any do not say
    newton_after: int = 0  # steps of the first round after which they are tried, and may end training; 0 for never
    effort: float = 1.0  # by which null steps of training, warm start and certificate have been multiplied
    graphs: bool = True  # on a GPU, steps are replayed from CUDA graphs; runs from before there were any do not say

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "log_every"):
            require_integer(f"trainer.{name}", getattr(self, name), 1)
        require_integer("trainer.rounds", self.rounds, 1, maximum=16)
        require_number("trainer.good_gap", self.good_gap, above=0.0)
        require_integer("trainer.threads", self.threads, 1, maximum=MOST_THREADS)
        for name in ("graphs", "figures", "progress"):
            require_flag(f"trainer.{name}", getattr(self, name))
        for name in ("newton_steps", "newton_after", "evaluate_every", "checkpoint_every"):
            require_integer(f"trainer.{name}", getattr(self, name), 0)
        require_integer("trainer.keep", self.keep, 1, maximum=1000)
        for name in ("target_gap", "max_seconds"):
            if getattr(self, name) is not None:
                require_number(f"trainer.{name}", getattr(self, name), above=0.0)
        if self.target_gap is not None and not self.evaluate_every:
            raise InputError("trainer.evaluate_every is 0, but trainer.target_gap needs quick evaluations on the way.")
        require_choice("trainer.dtype", self.dtype, ("float32", "float64"))
        require_choice("trainer.device", self.device, ("auto", "cpu", "cuda"))
        if self.device == "cuda" and not torch.cuda.is_available():
            raise InputError("trainer.device is 'cuda', but no CUDA device is available here; use auto or cpu.")

    @property
    def torch_dtype(self) -> torch.dtype:
        return getattr(torch, self.dtype)

    @property
    def torch_device(self) -> torch.device:
        available = "cuda" if torch.cuda.is_available() else "cpu"
        return torch.device(available if self.device == "auto" else self.device)

    def start(self, k: int) -> int:
        """The number of steps after which round ``k`` begins."""
        return self.steps * (2**k - 1)

    def end(self, k: int) -> int:
        """The number of steps after which round ``k`` (from 0), which has `2^k` times as many as the first, is over."""
        return self.steps * (2 ** (k + 1) - 1)

    def part_done(self, step: int, k: int) -> float:
        """The part of round ``k`` that is done after ``step`` steps."""
        return (step - self.start(k)) / (self.steps * 2**k)

    def round_at(self, step: int) -> int:
        """The round that a run is in after ``step`` steps."""
        return next((k for k in range(self.rounds - 1) if step < self.end(k)), self.rounds - 1)

    def moves(self, step: int, k: int, delay: float) -> int:
        """How often a player that waits for the part ``delay`` of each round has moved by ``step``, a step of round ``k``."""
        count = 0
        for j in range(k + 1):
            length = self.steps * 2**j
            count += max(0, min(length, step - self.end(j - 1)) - math.ceil(delay * length))
        return count
