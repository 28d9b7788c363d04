"""`V = beta W V + c` for the interpolation matrix `W` of one policy: direct if small, else by iteration."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

# Unknowns up to which the matrix is factored.
DIRECT = 1200
KRYLOV_ITERATIONS = 150
# Sweeps contract by beta; so many times those that should do are tried.
PATIENCE = 1.5
BREAKDOWN = 1e4


def solve_fixed_point(W: Tensor, beta: float, c: Tensor, start: Tensor, tolerance: float) -> Tensor:
    """`V` with `|V - beta W V - c| <= tolerance` at every node, or the closest met; ``W`` is sparse."""
    if len(c) <= DIRECT:
        return torch.linalg.solve(torch.eye(len(c), dtype=c.dtype) - beta * W.to_dense(), c)
    apply = lambda v: beta * (W @ v)
    best = bi_conjugate_gradients(apply, c, start, tolerance)
    size = float((best - apply(best) - c).abs().max())
    sweeps = math.ceil(PATIENCE * max(math.log(max(size, tolerance) / tolerance), 0.0) / -math.log(beta))
    v = best
    for _ in range(sweeps):
        following = apply(v) + c
        change = float((following - v).abs().max())
        if change < size:
            best, size = v, change
        if change <= tolerance or not math.isfinite(change):
            break
        v = following
    return best


def bi_conjugate_gradients(apply: Callable[[Tensor], Tensor], c: Tensor, start: Tensor, tolerance: float) -> Tensor:
    """The stabilised method (van der Vorst) for `v - apply(v) = c`; the best iterate met before the end or a breakdown."""
    x, r = start, c - start + apply(start)
    shadow, p = r.clone(), r.clone()
    inner = torch.dot(shadow, r)
    best, smallest = x, float(r.abs().max())
    for _ in range(KRYLOV_ITERATIONS):
        if smallest <= tolerance:
            break
        Ap = p - apply(p)
        alpha = inner / torch.dot(shadow, Ap)
        s = r - alpha * Ap
        As = s - apply(s)
        omega = torch.dot(As, s) / torch.dot(As, As)
        x, r = x + alpha * p + omega * s, s - omega * As
        size = float(r.abs().max())
        if not size < BREAKDOWN * smallest:
            break
        if size < smallest:
            best, smallest = x, size
        following = torch.dot(shadow, r)
        p = r + (following / inner) * (alpha / omega) * (p - omega * Ap)
        inner = following
    return best
