r"""A density that is constant on each of a partition of the torus into boxes, to sample from and to be fitted to scores.

The estimate `g(x) / p(x)` of `int g`, with `x` from `p`, has the second moment `int g^2 / p`. On a partition into boxes `b`
of volume `v_b` it is least for probabilities `P_b` proportional to `sqrt(v_b int_b g^2)`, and is then the square of their
sum (Cauchy and Schwarz). Every split of a box lowers that sum or leaves it, so boxes are split where it falls most.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError

BINS = 8  # equal parts of an edge, between two of which a box may be split
LEAST_STATES = 24  # on each side of a split: the density rests on their mean
LEAST_GAIN = 1e-3  # part by which a split lowers the sum over all boxes


@dataclass(frozen=True)
class Boxes:
    """A binary tree of `K` boxes, the torus `[0, 1)^d` first; a box that is not split is a leaf, and its own child."""

    low: Tensor  # (K, d) corners, float64
    size: Tensor  # (K, d) edges, float64
    probability: Tensor  # (K,), above 0, float64
    axis: Tensor  # (K,) that it is split along, int64
    children: Tensor  # (K, 2) the halves, lower one first, int64

    @classmethod
    def whole(cls, dim: int) -> "Boxes":
        """The uniform density."""
        edge, none = torch.ones(1, dim, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.int64)
        return cls(torch.zeros_like(edge), edge, edge[:, 0].clone(), none[:, 0].clone(), none)

    @property
    def leaves(self) -> Tensor:
        """Which of the boxes are not split; they tile the torus."""
        return (self.children[:, 0] == torch.arange(len(self.axis))).nonzero().squeeze(-1)

    @property
    def weight(self) -> Tensor:
        """The inverse of the mean density in each box, ``(K,)``."""
        return self.size.prod(dim=1) / self.probability

    def place(self, u: Tensor) -> tuple[Tensor, Tensor]:
        r"""States ``(N, d)`` and their weights ``(N,)`` from uniform points ``u`` of the torus, ``(N, d)``.

        Each split moves its border from where it halves the volume as the boxes do to where it halves the probability: points
        that are evenly spread stay so, leaf by leaf. A state is in the leaf `b` with probability `P_b`, and uniform there. So
        `E[weight g] = sum_b P_b (v_b / P_b) (1 / v_b) int_b g = int g` for every integrable `g`, whatever the boxes were
        fitted to, as long as that does not depend on ``u``.
        """
        v, box = u.double(), torch.zeros(len(u), dtype=torch.int64)
        share = self.probability[self.children[:, 0]] / self.probability
        while bool((self.children[box, 0] != box).any()):
            axis, lower = self.axis[box].unsqueeze(-1), share[box].unsqueeze(-1)
            at = v.gather(1, axis)
            upper = at >= lower
            v = v.scatter(1, axis, torch.where(upper, (at - lower) / (1.0 - lower), at / lower))
            box = self.children[box].gather(1, upper.long()).squeeze(-1)
        return self.low[box] + v * self.size[box], self.weight[box]

    def require_density(self, dim: int) -> None:
        """Raise `InputError` unless these are boxes in ``dim`` coordinates, of volume 1 and probability 1 in all."""
        count = len(self.axis)
        shapes = {
            "low": (count, dim),
            "size": (count, dim),
            "probability": (count,),
            "axis": (count,),
            "children": (count, 2),
        }
        floats = ("low", "size", "probability")
        plain = all(
            tuple((t := getattr(self, name)).shape) == shape
            and t.dtype == (torch.float64 if name in floats else torch.int64)
            for name, shape in shapes.items()
        )
        if plain and bool(((self.children >= 0) & (self.children < count)).all()):
            own = torch.arange(count)
            split = self.children[:, 0] != own
            after = (self.children > own.unsqueeze(-1)).all(dim=-1) | ~split  # no circles
            measures = torch.stack([self.size.prod(dim=-1), self.probability])
            halves = torch.where(split, measures[:, self.children].sum(dim=-1), measures)
            inside = (self.low >= 0.0) & (self.size > 0.0) & (self.low + self.size <= 1.0 + 1e-12)
            axes = (self.axis >= 0) & (self.axis < dim)
            full = (measures[:, 0] - 1.0).abs().max() < 1e-9
            even = ((halves - measures).abs() < 1e-9) & (measures > 0.0)
            if bool(full & after.all() & inside.all() & axes.all() & even.all()):
                return
        raise InputError(f"the checkpoint holds boxes that are no density of {dim} coordinates.")

    def density(self, x: Tensor) -> Tensor:
        """The density at states ``(N, d)``, ``(N,)``."""
        at, low, size = x.double().unsqueeze(1), self.low[self.leaves], self.size[self.leaves]
        inside = ((at >= low) & (at < low + size)).all(dim=-1)
        return (inside.double() / self.weight[self.leaves]).sum(dim=1)


def fitted(x: Tensor, weight: Tensor, score: Tensor, uniform: float) -> Boxes:
    """Boxes for integrands of size about ``score`` ``(N,)`` at states ``x`` ``(N, d)`` of the given ``weight``.

    The part ``uniform`` of the probability is spread evenly, so that no weight is above ``1 / uniform``. Scores that are not
    finite count as 0.
    """
    square = np.nan_to_num((weight * score.square()).double().numpy(), nan=0.0, posinf=0.0, neginf=0.0)
    dim, total = x.shape[1], square.sum()
    if not 0.0 < total < np.inf:
        return Boxes.whole(dim)
    rows: list[list] = []
    _grow(rows, x.double().numpy(), square / total, np.zeros(dim), np.ones(dim))
    low, size, mass, axis, children = zip(*rows, strict=True)
    boxes = Boxes(*(torch.from_numpy(np.array(column)) for column in (low, size, mass, axis, children)))
    volume, share = boxes.size.prod(dim=1), torch.zeros_like(boxes.probability)
    share[boxes.leaves] = (volume * boxes.probability).sqrt()[boxes.leaves]
    for box in range(len(share) - 1, -1, -1):  # halves come after the whole
        if children[box][0] != box:
            share[box] = share[children[box][0]] + share[children[box][1]]
    mixed = uniform * volume + (1.0 - uniform) * share / share[0]
    return Boxes(boxes.low, boxes.size, mixed, boxes.axis, boxes.children)


def _grow(rows: list[list], x: np.ndarray, square: np.ndarray, low: np.ndarray, size: np.ndarray) -> int:
    """Append to ``rows`` the box at ``low``, then all its parts, with the sum of ``square`` in each. Returns its number."""
    own, cut = len(rows), _best_cut(x, square, low, size)
    rows.append([low, size, square.sum(), 0, (own, own)])
    if cut is not None:
        axis, part = cut
        left, first, second, start = x[:, axis] < low[axis] + part * size[axis], size.copy(), size.copy(), low.copy()
        first[axis] *= part
        second[axis] -= first[axis]
        start[axis] += first[axis]
        lower = _grow(rows, x[left], square[left], low, first)
        rows[own][3:] = axis, (lower, _grow(rows, x[~left], square[~left], start, second))
    return own


def _best_cut(x: np.ndarray, square: np.ndarray, low: np.ndarray, size: np.ndarray) -> tuple[int, float] | None:
    """The axis and the part of the edge at which a cut lowers `sqrt(volume * square)` most; `None` where none is worth it."""
    n, dim = x.shape
    if n < 2 * LEAST_STATES:
        return None
    bins = np.clip(((x - low) / size * BINS).astype(int), 0, BINS - 1) + BINS * np.arange(dim)
    within = lambda each: np.bincount(bins.ravel(), np.repeat(each, dim), dim * BINS).reshape(dim, BINS).cumsum(axis=1)
    count, mass = within(np.ones(n))[:, :-1], within(square)[:, :-1]
    part = np.arange(1, BINS) / BINS
    halves = np.sqrt(part * mass) + np.sqrt((1.0 - part) * (square.sum() - mass).clip(0.0))
    gain = np.sqrt(size.prod()) * (np.sqrt(square.sum()) - halves)
    gain[(count < LEAST_STATES) | (n - count < LEAST_STATES)] = 0.0
    axis, place = np.unravel_index(gain.argmax(), gain.shape)
    return (int(axis), float(part[place])) if gain[axis, place] > LEAST_GAIN else None
