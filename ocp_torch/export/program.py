"""A function of one state as a list of operations on flat buffers of numbers: what each exported format is written from.

A tensor is a `View`: a buffer, and the place in it of each entry. Reshaping, transposing, slicing and broadcasting only
change the places of a view, so that no format has to know of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

# The buffer that holds the state.
STATE = 0


@dataclass(frozen=True, eq=False)
class View:
    """The entries of a tensor: numbers of ``buffer`` at ``places``, int64 and of the tensor's shape."""

    buffer: int
    places: Tensor

    @property
    def flat(self) -> list[int]:
        return self.places.flatten().tolist()

    @property
    def key(self) -> tuple[int, tuple[int, ...], bytes]:
        """A key that is equal for views of the same numbers."""
        return self.buffer, tuple(self.places.shape), self.places.contiguous().numpy().tobytes()

    def whole(self, size: int) -> bool:
        """Whether the entries are all ``size`` numbers of the buffer, in order."""
        return self.places.numel() == size and torch.equal(self.places.flatten(), torch.arange(size))


Operand = View | float


@dataclass(frozen=True, eq=False)
class Operation:
    """``name`` applied to ``operands``; the result fills ``buffer`` in row-major order.

    Most names act entry by entry, on views of one shape. `sum`, `max` and `min` of one view ``(n, r)`` act along its last
    axis, `matmul` multiplies views ``(n, k)`` and ``(k, m)``, `cat` puts the numbers of its views one after the other.
    """

    name: str
    operands: tuple[Operand, ...]
    buffer: int


@dataclass
class Program:
    """Operations from the state, in order; constants are buffers as well."""

    dim: int
    sizes: list[int] = field(default_factory=list)  # of each buffer
    constants: dict[int, np.ndarray] = field(default_factory=dict)
    operations: list[Operation] = field(default_factory=list)
    outputs: dict[str, View] = field(default_factory=dict)
    _known: dict[bytes, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.sizes = self.sizes or [self.dim]

    @property
    def state(self) -> View:
        """The state as a batch of one, ``(1, d)``."""
        return View(STATE, torch.arange(self.dim).unsqueeze(0))

    def constant(self, value: Tensor) -> View:
        """Numbers that do not depend on the state; equal ones are kept once."""
        value = value.detach().to(torch.float64)
        order = sorted(range(value.dim()), key=value.stride, reverse=True)  # a matrix and its transpose are one array
        stored = value.permute(order).contiguous()
        numbers = stored.flatten().numpy()
        key = numbers.tobytes()
        if key not in self._known:
            self._known[key] = self._buffer(len(numbers))
            self.constants[self._known[key]] = numbers
        places = torch.arange(len(numbers)).view(stored.shape)
        return View(self._known[key], places.permute([order.index(axis) for axis in range(value.dim())]))

    def add(self, name: str, operands: tuple[Operand, ...], shape: Sequence[int]) -> View:
        """The result of one more operation, in ``shape``; the old result for an operation that is there already."""
        places = torch.arange(int(np.prod(shape))).view(shape)
        key = repr((name, *(o.key if isinstance(o, View) else o for o in operands))).encode()
        if key not in self._known:
            self._known[key] = self._buffer(places.numel())
            self.operations.append(Operation(name, operands, self._known[key]))
        return View(self._known[key], places)

    def pruned(self) -> "Program":
        """The program without operations that no output needs."""
        needed = {view.buffer for view in self.outputs.values()}
        kept = []
        for operation in reversed(self.operations):
            if operation.buffer in needed:
                needed |= {operand.buffer for operand in operation.operands if isinstance(operand, View)}
                kept.append(operation)
        constants = {buffer: value for buffer, value in self.constants.items() if buffer in needed}
        return Program(self.dim, self.sizes, constants, kept[::-1], self.outputs)

    def _buffer(self, size: int) -> int:
        self.sizes.append(size)
        return len(self.sizes) - 1
