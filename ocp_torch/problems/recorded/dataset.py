"""A problem known only through recorded samples: no simulator, no formula, nothing to evaluate anywhere else."""

import copy
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_flag, require_integer, require_number
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.problem import MARGIN, Problem
from ocp_torch.problems.recorded.implied import completed, same_everywhere
from ocp_torch.problems.recorded.recording import Recording, read
from ocp_torch.problems.samples import Samples

# Part of the samples that are not held out on which evaluations during training are made.
VALIDATION_PART = 0.1
# Fewest samples in each of the three parts.
FEWEST = 32


def _unknown(what: str) -> Callable[..., Tensor]:
    """A method that raises `InputError`, as ``what`` is unknown between samples."""

    def refuse(self: Problem, x: Tensor) -> Tensor:
        raise InputError(
            f"the {what} of a data set is known at its recorded states only; nothing can be simulated with it."
        )

    return refuse


class Dataset(Problem):
    """The samples of ``path`` (a file of `recording`), split at random by ``seed``: ``held_out`` of them, a part
    in (0, 1), for the certificate alone, a tenth of the rest to choose by while training, and the others to train on.

    ``discount``, ``exponent`` and ``control_limit`` where not given are those of the file. ``wrap`` takes states modulo 1.
    Where `B` is the same at all samples it is known everywhere, and the controller from `V` with it; otherwise only
    `w / mu` can be handed out. ``dim``, ``control_dim`` and ``constant_matrix`` stand for the file until its samples are
    asked for: a saved controller needs no data. Raises `InputError` for whatever is wrong with the file.
    """

    has_simulator = False
    incidental = ("path",)
    state_cost, initial_density = _unknown("state cost"), _unknown("initial density")
    drift = drift_divergence = _unknown("drift")
    noise = noise_divergences = _unknown("noise")  # type: ignore[assignment] # neither gives anything

    def __init__(
        self,
        path: str,
        discount: float | None = None,
        exponent: float | None = None,
        control_limit: Limit = None,
        held_out: float = 0.2,
        seed: int = 0,
        wrap: bool = False,
        dim: int | None = None,
        control_dim: int | None = None,
        constant_matrix: list | None = None,
    ) -> None:
        if not isinstance(path, str | Path):
            raise InputError(f"problem.path is {path!r}, but must name an .npz or .safetensors file.")
        self.path = str(Path(path).absolute())
        self.wrap, self.seed = require_flag("problem.wrap", wrap), require_integer("problem.seed", seed, 0)
        self.held_out_part = require_number("problem.held_out", held_out, at_least=0.01, at_most=0.99)
        self._recording = read(self.path, self.wrap) if dim is None else None
        if self._recording is not None:
            samples, numbers = self._recording.samples, self._recording.numbers
            dim, control_dim = samples.B.shape[1:]
            discount = numbers.get("discount") if discount is None else discount
            exponent = numbers.get("exponent", 2.0) if exponent is None else exponent
            control_limit = numbers.get("control_limit") if control_limit is None else control_limit
            constant_matrix = samples.B[0].tolist() if same_everywhere(samples.B) else None
        if discount is None:
            raise InputError("problem.discount is missing: the file does not hold it; give problem.discount=...")
        super().__init__(dim, control_dim, discount, exponent, control_limit)  # type: ignore[arg-type] # refused there
        self._B = None if constant_matrix is None else torch.tensor(constant_matrix, dtype=torch.float64)
        self.constant_matrix = None if self._B is None else self._B.tolist()
        self.knows_control_matrix = self._B is not None
        if self._B is not None and self._B.shape != (self.dim, self.control_dim):
            raise InputError(f"problem.constant_matrix has shape {tuple(self._B.shape)}, but must be (d, m).")
        if self._recording is not None:
            self._split(self._recording)

    @property
    def parameters(self) -> dict:
        return {**super().parameters, "held_out": self.held_out_part}

    @property
    def recording(self) -> Recording:
        """What the file holds, read when it is first asked for."""
        if self._recording is None:
            found = read(self.path, self.wrap)
            if (sizes := tuple(found.samples.B.shape[1:])) != (self.dim, self.control_dim):
                raise InputError(f"{self.path} is of d, m = {sizes}, not {(self.dim, self.control_dim)}.")
            self._split(found)
            self._recording = found
        return self._recording

    def _split(self, found: Recording) -> None:
        """Split the samples into three parts, and take over units and the largest cost. Raises `InputError` for too few."""
        samples, self.measures = found.samples, found.measures
        # An estimate from the samples, with head-room; the certificate calls it one.
        self.state_cost_bound = MARGIN * float(samples.f.max())
        samples = completed(samples)
        count = len(samples)
        held = round(self.held_out_part * count)
        chosen_by = max(FEWEST, round(VALIDATION_PART * (count - held)))
        if held < FEWEST or count - held - chosen_by < FEWEST:
            raise InputError(
                f"problem.held_out = {self.held_out_part:g} of {count} samples leaves too few on one side; each part needs "
                f"at least {FEWEST}."
            )
        generator = torch.Generator().manual_seed(derive_seed(self.seed, Branch.DATASET_SPLIT))
        rows = torch.randperm(count, generator=generator).split([held, chosen_by, count - held - chosen_by])
        self._held_out, self._validation, self._training = (samples.take(part) for part in rows)

    @property
    def training(self) -> Samples:
        """The samples to train on."""
        _ = self.recording
        return self._training

    @property
    def held_out(self) -> Samples:
        """The samples for the certificate alone: nothing was trained on them or chosen by them."""
        _ = self.recording
        return self._held_out

    @property
    def validation_view(self) -> "Dataset":
        """This problem with the validation samples as held-out ones, for evaluations by which choices are made."""
        _ = self.recording
        other = copy.copy(self)
        other._held_out = self._validation
        return other

    def samples(self, places: Tensor, divergences: bool = True) -> Samples:
        """The training samples of the rows ``places``, with the recorded divergences whether asked for or not."""
        return self.training.take(places.to("cpu"))

    def probe(self, count: int, branch: int, *columns: str) -> tuple[Tensor, ...]:
        return tuple(getattr(self.training, name)[:count] for name in columns)

    def independent_samples(self, count: int) -> Samples:
        return self.training.take(slice(count))

    @property
    def rows(self) -> int:
        """The number of samples to train on."""
        return len(self.training)

    @property
    def driftless(self) -> bool:
        return not bool(self.recording.samples.a.any())

    @property
    def noisy(self) -> bool:
        return self.training.noise is not None

    @property
    def unknown_divergences(self) -> str:
        found = {"a": self.training.div_a, "B": self.training.div_B}
        found |= {"D": self.training.div_D} if self.noisy else {}
        return " and ".join(name for name, column in found.items() if column is None)

    def control_matrix(self, x: Tensor) -> Tensor:
        if self._B is None:
            raise InputError(
                "B varies over the recorded samples, so the controller from V is not known between them; "
                "train with method=pd, which hands out w / mu."
            )
        return self._like(x, "B", self._B).expand(len(x), self.dim, self.control_dim)

    def control_divergence(self, x: Tensor) -> Tensor:
        self.control_matrix(x[:1])
        return x.new_zeros(len(x), self.control_dim)
