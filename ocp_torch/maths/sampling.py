"""Training states: uniform ones, scrambled Sobol points, or Sobol points placed where they count; and evaluation points,
which never meet them.

The same seed gives the same states on every device: points are made on the CPU, or of the same whole numbers elsewhere.
"""

import math

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from ocp_torch.errors import InputError, require_integer, require_number
from ocp_torch.maths.boxes import Boxes, fitted
from ocp_torch.maths.seeds import Branch, derive_seed

CPU = torch.device("cpu")
# Points of one scrambling, after which another begins: a sequence ends, and resuming draws all points of the block again.
SOBOL_BLOCK = 2**18
LEAST_DRAWN = 4096  # points drawn at once: a draw of fewer costs as much
ON_GPU_FROM = 2**18  # coordinates from which on a GPU makes the points itself: a core takes 3 ms for so many
ENGINE_SEEDS = 2**31  # the seeds that a Sobol engine takes are below this


def scrambled_sobol(count: int, dim: int, seed: int, dtype: torch.dtype, skip: int = 0) -> Tensor:
    """``count`` scrambled Sobol points in `[0, 1)^dim`, after ``skip`` of the same scrambling; ``(count, dim)``."""
    engine = SobolEngine(dim, scramble=True, seed=seed % ENGINE_SEEDS)
    if skip:
        engine.fast_forward(skip)
    points = engine.draw(count, dtype=torch.float64)
    # Rounding to float32 can give exactly 1, the same state as 0.
    return points.to(dtype).remainder(1.0)


def evaluation_points(count: int, dim: int, replicate: int, seed: int) -> Tensor:
    """Randomised quasi-Monte Carlo states in float64, from a stream no training sampler uses; ``(count, dim)``.

    Digits beyond those the net property of ``count`` points rests on are drawn independently: with the shared digits of a
    linear scrambling, errors have heavy tails, and a few replicates give standard errors that cannot be trusted.
    """
    branch = derive_seed(seed, Branch.EVALUATION, replicate)
    points = scrambled_sobol(count, dim, branch, torch.float64)
    cells = 2.0 ** math.ceil(math.log2(count)) if count > 1 else 1.0
    jitter = torch.rand(count, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(branch))
    return ((points * cells).floor() + jitter) / cells


class UniformSampler:
    """Independent uniform states."""

    def __init__(self, dim: int, seed: int, dtype: torch.dtype) -> None:
        self.dim, self.dtype = dim, dtype
        self.generator = torch.Generator().manual_seed(derive_seed(seed, Branch.TRAINING))

    def draw(self, count: int, device: torch.device = CPU) -> Tensor:
        """The next ``count`` states, ``(count, d)``, on ``device``."""
        drawn = torch.rand(count, self.dim, generator=self.generator, dtype=self.dtype)
        return drawn.to(device)

    def state_dict(self) -> dict:
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        self.generator.set_state(state["generator"])


class SobolSampler:
    """Consecutive points of a scrambled Sobol sequence, scrambled anew every `SOBOL_BLOCK` points."""

    def __init__(self, dim: int, seed: int, dtype: torch.dtype) -> None:
        self.dim, self.seed, self.dtype = dim, seed, dtype
        self.count = 0
        self._numbers: tuple[int, Tensor, Tensor] | None = None  # block, shift and direction numbers, on a GPU
        self._buffer, self._start = torch.empty(0, dim, dtype=dtype), -1

    def draw(self, count: int, device: torch.device = CPU) -> Tensor:
        """The next ``count`` states, ``(count, d)``, on ``device``."""
        there, pieces = device.type != "cpu" and count * self.dim >= ON_GPU_FROM, []
        while count > 0:
            block, position = divmod(self.count, SOBOL_BLOCK)
            taken = min(count, SOBOL_BLOCK - position)
            piece = block, position, taken
            pieces.append(self._made(*piece, device) if there else self._drawn(*piece).to(device))
            self.count += taken
            count -= taken
        return torch.cat(pieces)

    def _drawn(self, block: int, position: int, count: int) -> Tensor:
        """Points of ``block`` from ``position`` on. All before are kept, because an engine's start costs more than a draw."""
        if self._start != block:
            self._start, self._buffer = block, torch.empty(0, self.dim, dtype=self.dtype)
            self._engine = self._scrambled(block)
        stop = position + count
        while len(self._buffer) < stop:
            fresh = self._engine.draw(max(stop - len(self._buffer), LEAST_DRAWN), dtype=torch.float64)
            self._buffer = torch.cat([self._buffer, fresh.to(self.dtype).remainder(1.0)])
        return self._buffer[position:stop]

    def _scrambled(self, block: int) -> SobolEngine:
        return SobolEngine(self.dim, scramble=True, seed=derive_seed(self.seed, Branch.TRAINING, block) % ENGINE_SEEDS)

    def _made(self, block: int, position: int, count: int, device: torch.device) -> Tensor:
        """Points of ``block`` from ``position`` on, each by itself: the direction numbers at the ones of its Gray code, added
        without carry."""
        if self._numbers is None or self._numbers[0] != block:
            engine = self._scrambled(block)
            self._numbers = block, engine.shift.to(device), engine.sobolstate.to(device)
        _, whole, directions = self._numbers
        n = torch.arange(position, position + count, device=device)
        gray = (n ^ (n >> 1)).unsqueeze(-1)
        for bit in range((position + count).bit_length()):
            whole = whole ^ ((gray >> bit & 1) * directions[:, bit])
        points = whole.double() * 2.0**-SobolEngine.MAXBIT
        if position == 0:
            points[0] = points[0].float().double()  # as an engine rounds its first one
        return points.to(self.dtype).remainder(1.0)

    def state_dict(self) -> dict:
        return {"count": self.count}

    def load_state_dict(self, state: dict) -> None:
        self.count, self._start = require_integer("count of the checkpoint", state["count"], 0, maximum=2**62), -1


class ImportanceSampler:
    """Sobol points placed by a piecewise constant density (`Boxes`), which is fitted anew to scores again and again.

    Every ``every`` draws, ``pool`` states of the present density are to be scored (`pool`, `learn`). The part ``uniform``
    of the probability is uniform, so that no weight is above ``1 / uniform``. The pool is drawn apart from what trains:
    given the boxes, weighted means over a batch are unbiased whatever the scores were (`Boxes.place`), as far as Sobol
    points of one scrambling are: what was learnt from earlier ones knows them. The pool's states are evaluations of the
    problem beside those of the batches.
    """

    def __init__(
        self, dim: int, seed: int, dtype: torch.dtype, uniform: float = 0.5, every: int = 50, pool: int = 4096
    ) -> None:
        self.uniform = require_number("sampler.uniform", uniform, above=0.0, at_most=1.0)
        self.every = require_integer("sampler.every", every, 1)
        self.size = require_integer("sampler.pool", pool, 1, maximum=2**20)
        self.dim, self.dtype, self.boxes, self.drawn = dim, dtype, Boxes.whole(dim), 0
        self.points = SobolSampler(dim, seed, torch.float64)
        self.generator = torch.Generator().manual_seed(derive_seed(seed, Branch.POOL))

    def draw(self, count: int) -> Tensor:
        """The next ``count`` states, ``(count, d)``."""
        return self.draw_weighted(count)[0]

    def draw_weighted(self, count: int) -> tuple[Tensor, Tensor]:
        """The next ``count`` states, ``(count, d)``, and one over the density of each, ``(count,)``."""
        self.drawn += 1
        return self._rounded(self.boxes.place(self.points.draw(count)))

    @property
    def due(self) -> bool:
        """Whether scores are wanted before the next draw."""
        return self.drawn > 0 and self.drawn % self.every == 0

    def pool(self) -> tuple[Tensor, Tensor]:
        """States to score ``(size, d)``, and their weights ``(size,)``."""
        u = torch.rand(self.size, self.dim, dtype=torch.float64, generator=self.generator)
        return self._rounded(self.boxes.place(u))

    def learn(self, x: Tensor, weight: Tensor, score: Tensor) -> None:
        """Change the density to one that suits ``score`` ``(N,)`` at the states ``x`` of a `pool`."""
        self.boxes = fitted(x.cpu(), weight.cpu(), score.cpu(), self.uniform)

    def _rounded(self, placed: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        return placed[0].to(self.dtype).remainder(1.0), placed[1].to(self.dtype)

    def state_dict(self) -> dict:
        boxes = {name: tensor.clone() for name, tensor in vars(self.boxes).items()}
        return {
            **self.points.state_dict(),
            "drawn": self.drawn,
            "generator": self.generator.get_state(),
            "boxes": boxes,
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore what `state_dict` gave. Raises `InputError` where the boxes are no density."""
        self.points.load_state_dict(state)
        self.drawn = require_integer("drawn of the checkpoint", state["drawn"], 0, maximum=2**62)
        self.generator.set_state(state["generator"])
        self.boxes = Boxes(**state["boxes"])
        self.boxes.require_density(self.dim)


class RowSampler:
    """Rows of a recording, drawn independently and with replacement; ``digest`` is that of the recording."""

    def __init__(self, rows: int, seed: int, digest: str) -> None:
        self.rows, self.digest = rows, digest
        self.generator = torch.Generator().manual_seed(derive_seed(seed, Branch.TRAINING))

    def draw(self, count: int) -> Tensor:
        """The next ``count`` rows, ``(count,)``."""
        return torch.randint(self.rows, (count,), generator=self.generator)

    def state_dict(self) -> dict:
        return {"generator": self.generator.get_state(), "digest": self.digest}

    def load_state_dict(self, state: dict) -> None:
        if state["digest"] != self.digest:
            raise InputError("the data set is not the one this run was trained on: its contents have changed.")
        self.generator.set_state(state["generator"])


SAMPLERS = {"uniform": UniformSampler, "sobol": SobolSampler, "importance": ImportanceSampler}
