"""Where training states come from: uniform, or scrambled Sobol points; and the evaluation points that never meet them.

Points are always made on the CPU, so that the same seed gives the same states on every device.
"""

import math

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from ocp_torch.errors import InputError, require_integer
from ocp_torch.maths.seeds import Branch, derive_seed

# Points of one scrambling. Then another begins: a sequence ends, and resuming must draw again all points of the block so far.
SOBOL_BLOCK = 2**18
# Points drawn at once at least: a draw of few costs as much.
DRAWN = 4096
# Seeds that a Sobol engine takes are below this.
ENGINE_SEEDS = 2**31


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

    def draw(self, count: int) -> Tensor:
        """The next ``count`` states, ``(count, d)``."""
        return torch.rand(count, self.dim, generator=self.generator, dtype=self.dtype)

    def state_dict(self) -> dict:
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        self.generator.set_state(state["generator"])


class SobolSampler:
    """Consecutive points of a scrambled Sobol sequence, scrambled anew every `SOBOL_BLOCK` points."""

    def __init__(self, dim: int, seed: int, dtype: torch.dtype) -> None:
        self.dim, self.seed, self.dtype = dim, seed, dtype
        self.count = 0
        self._buffer, self._start = torch.empty(0, dim, dtype=dtype), -1

    def draw(self, count: int) -> Tensor:
        """The next ``count`` states, ``(count, d)``."""
        pieces = []
        while count > 0:
            block, position = divmod(self.count, SOBOL_BLOCK)
            taken = min(count, SOBOL_BLOCK - position)
            pieces.append(self._block(block, position + taken)[position : position + taken])
            self.count += taken
            count -= taken
        return torch.cat(pieces)

    def _block(self, block: int, stop: int) -> Tensor:
        """The first points of ``block``, at least up to ``stop``; kept, because an engine's start costs more than a draw."""
        if self._start != block:
            self._start, self._buffer = block, torch.empty(0, self.dim, dtype=self.dtype)
            seed = derive_seed(self.seed, Branch.TRAINING, block)
            self._engine = SobolEngine(self.dim, scramble=True, seed=seed % ENGINE_SEEDS)
        while len(self._buffer) < stop:
            fresh = self._engine.draw(max(stop - len(self._buffer), DRAWN), dtype=torch.float64)
            self._buffer = torch.cat([self._buffer, fresh.to(self.dtype).remainder(1.0)])
        return self._buffer

    def state_dict(self) -> dict:
        return {"count": self.count}

    def load_state_dict(self, state: dict) -> None:
        self.count, self._start = require_integer("count of the checkpoint", state["count"], 0, maximum=2**62), -1


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


SAMPLERS = {"uniform": UniformSampler, "sobol": SobolSampler}
