"""A problem given by one plain function, somebody's simulator: a black box that is asked, and never differentiated."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections import abc
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, nearest, require_flag, require_integer
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.workers import Workers
from ocp_torch.samplers import scrambled_sobol

# Half the distance of the two states of a difference quotient, by what the oracle computes in.
STEPS = {"float64": 1e-5, "float32": 2e-3}
# Two calls may differ by so much, relative to the size of the answer, and still be a function of the state.
SAME = 1e-6
# The seam is looked at from so far on both sides; what changes by more than that part of the answer's size jumps there.
SEAM_STEP, SEAM_JUMP, SEAM_PROBES, MOST_SEAMS = 1e-7, 1e-3, 4, 32
NAMES = ("f", "a", "B", "mu0")


class Callable(Problem):
    """``target`` maps states, arrays ``(N, d)`` in `[0, 1)`, to `f` ``(N,)``, `a` ``(N, d)`` (or `None` for no drift) and `B`
    ``(N, d, m)``, as NumPy arrays, and, if it likes, to the initial density `mu0` ``(N,)`` as well; or one state ``(d,)`` to
    a number, ``(d,)`` and ``(d, m)``: which of the two is found out by asking.

    ``target`` is module:function, FILE.py:function or the function itself. Without ``differences`` there are no divergences
    of `a` and `B`, and what needs them is left out; with them they come from central differences, which takes `2 d` more
    calls a state wherever they are wanted. ``workers`` processes share each batch (the target must then be named, not
    given). Raises `InputError`, with the state, where the function fails, gives another shape or a number that is not
    finite, is not a function of the state alone, or jumps where a coordinate passes from 1 to 0.
    """

    def __init__(
        self,
        target: str | abc.Callable,
        dim: int,
        control_dim: int | None = None,
        discount: float = 2.0,
        exponent: float = 2.0,
        control_limit: float | None = None,
        differences: bool = False,
        workers: int = 1,
    ) -> None:
        super().__init__(dim, control_dim, discount, exponent, control_limit)
        self.target = target
        self.differences = require_flag("problem.differences", differences)
        self.workers = require_integer("problem.workers", workers, 1, maximum=1024)
        if self.workers > 1 and not isinstance(target, str):
            raise InputError("problem.workers needs a target by name, module:function, which each process can import.")
        self._function = resolved(target) if isinstance(target, str) else target
        if not callable(self._function):
            raise InputError(f"problem.target is {target!r}, but must be module:function or a function.")
        self._pool: Workers | None = None
        self._kept: tuple[Tensor, dict] | None = None
        self._one_by_one, self._step = False, STEPS["float64"]
        self._understand()
        self._look_at_the_seam()
        if self.workers > 1:
            self._pool = Workers(target, self.workers)

    @property
    def driftless(self) -> bool:
        return self._no_drift

    @property
    def gives_divergences(self) -> bool:
        return self.differences

    def state_cost(self, x: Tensor) -> Tensor:
        return _Ask.apply(x, self, "f")

    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x) if self._no_drift else _Ask.apply(x, self, "a")

    def control_matrix(self, x: Tensor) -> Tensor:
        return _Ask.apply(x, self, "B")

    def initial_density(self, x: Tensor) -> Tensor:
        return _Ask.apply(x, self, "mu0") if self._has_mu0 else torch.ones_like(x[:, 0])

    def drift_divergence(self, x: Tensor) -> Tensor | None:
        return self._divergences(x)[0] if self.differences else None

    def control_divergence(self, x: Tensor) -> Tensor | None:
        return self._divergences(x)[1] if self.differences else None

    @torch.no_grad()
    def _divergences(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`div a` and `div B` by central differences, all `2 d` shifted batches in one call."""
        at = x.detach().cpu().double().remainder(1.0)
        if "divergences" not in (kept := self.answers(at)):
            moves = self._step * torch.eye(self.dim, dtype=torch.float64)
            shifted = torch.cat([at + s * e for e in moves for s in (1.0, -1.0)]).remainder(1.0)
            found = self._checked(shifted)
            slopes = lambda v: (v[:, 0] - v[:, 1]) / (2.0 * self._step)  # (d, N, ...)
            a = slopes(found["a"].unflatten(0, (self.dim, 2, len(at))))
            B = slopes(found["B"].unflatten(0, (self.dim, 2, len(at))))
            kept["divergences"] = torch.einsum("ini->n", a), torch.einsum("inik->nk", B)
        return tuple(part.to(x) for part in kept["divergences"])

    def answers(self, at: Tensor) -> dict:
        """All parts at float64 states of the unit cell; those of the last batch are kept, for they are asked for in turn."""
        if self._kept is None or self._kept[0].shape != at.shape or not torch.equal(self._kept[0], at):
            self._kept = at, self._checked(at)
        return self._kept[1]

    def _checked(self, at: Tensor) -> dict[str, Tensor]:
        x = at.numpy()
        try:
            answer = self._pool.map(x, self._one_by_one) if self._pool else asked(self._function, x, self._one_by_one)
        except InputError:
            raise
        except Exception as error:  # whatever a stranger's code may raise
            raise InputError(self._failure(x, error)) from None
        found = self._shaped(answer, x)
        for name, values in found.items():
            bad = ~torch.isfinite(values).reshape(len(x), -1).all(dim=-1)
            if bool(bad.any()):
                at_row = int(bad.nonzero()[0])
                raise InputError(f"the oracle's {name} is not finite at x = {x[at_row].tolist()}.")
        return found

    def _failure(self, x: np.ndarray, error: Exception) -> str:
        """What it raised, and the state it raises it at, found by halving the batch."""
        while len(x) > 1:
            half = x[: len(x) // 2]
            try:
                asked(self._function, half, self._one_by_one)
            except Exception as other:  # whatever a stranger's code may raise
                x, error = half, other
                continue
            x = x[len(x) // 2 :]
        reason = next(iter(str(error).splitlines()), "").rstrip(".") or "no message"
        return f"the oracle raised {type(error).__name__} at x = {x[0].tolist()}: {reason}."

    def _shaped(self, answer: object, x: np.ndarray) -> dict[str, Tensor]:
        """The parts of ``answer`` by name, as float64 tensors; `InputError` where one is missing or misshapen."""
        count, d, m = len(x), self.dim, self.control_dim
        if not isinstance(answer, tuple | list) or len(answer) not in (3, 4):
            raise InputError(
                f"the oracle gave a {type(answer).__name__}, but must give f, a, B (and, if it likes, mu0)."
            )
        parts = dict(zip(NAMES, answer, strict=False))
        forms = {"f": (count,), "a": (count, d), "B": (count, d, m), "mu0": (count,)}
        found = {}
        for name, part in parts.items():
            if name == "a" and part is None:
                part = np.zeros((count, d))
            try:
                array = np.asarray(part)
                array = array.astype(np.float64) if array.dtype.kind in "fiu" else None
            except (TypeError, ValueError):
                array = None
            if array is None:
                raise InputError(f"the oracle's {name} is no array of real numbers at x = {x[0].tolist()}.")
            if name == "B" and m == 1 and array.shape == (count, d):
                array = array[:, :, None]
            if array.shape != forms[name]:
                raise InputError(
                    f"the oracle's {name} has shape {array.shape} for states of shape {x.shape} (x = {x[0].tolist()} the "
                    f"first), but must have {forms[name]}."
                )
            found[name] = torch.from_numpy(np.ascontiguousarray(array))
        return found

    def _understand(self) -> None:
        """Whether it takes batches or single states, and whether its answers depend on the state alone."""
        x = scrambled_sobol(self.dim + 3, self.dim, 0, torch.float64)
        self._one_by_one = self._form(x.numpy())
        found = self._checked(x)
        raw = asked(self._function, x[:1].numpy(), self._one_by_one)
        self._no_drift, self._has_mu0 = raw[1] is None, len(raw) == 4
        if np.asarray(raw[0]).dtype == np.float32:
            self._step = STEPS["float32"]
        again, alone = self._checked(x), self._checked(x[2:3])
        for name, values in found.items():
            size = SAME * (float(values.abs().max().nan_to_num()) + 1e-6) * (1e3 if self._step > 1e-4 else 1.0)
            if float((again[name] - values).abs().max()) > size:
                raise InputError(
                    f"the oracle's {name} differs between two calls at x = {x[0].tolist()}; it must be a function of x."
                )
            if float((alone[name][0] - values[2]).abs().max()) > size:
                raise InputError(
                    f"the oracle's {name} at x = {x[2].tolist()} depends on the other states of the batch."
                )

    def _form(self, x: np.ndarray) -> bool:
        """Whether it takes states one by one: what gives an answer of the right shape at any of the states ``x``."""
        complaints = []
        for one_by_one in (False, True):
            # As many copies of a state as no coordinate has: a batch that cannot be taken for anything else.
            for batch in (x, *(np.repeat(state[None], len(x), axis=0) for state in x)):
                try:
                    self._shaped(asked(self._function, batch, one_by_one), batch)
                    return one_by_one
                except Exception as error:  # whatever a stranger's code may raise
                    complaints.append(error)
        # A function of batches is not to be told that it cannot take single states, nor the other way round.
        raise next((e for e in complaints if isinstance(e, InputError)), None) or InputError(
            self._failure(x, complaints[0])
        ) from None

    def _look_at_the_seam(self) -> None:
        for i in range(min(self.dim, MOST_SEAMS)):
            after = scrambled_sobol(SEAM_PROBES, self.dim, 1 + i, torch.float64)
            before = after.clone()
            after[:, i], before[:, i] = SEAM_STEP, 1.0 - SEAM_STEP
            here, there = self._checked(after), self._checked(before)
            for name in here:
                change = (here[name] - there[name]).reshape(SEAM_PROBES, -1).abs().amax(dim=-1)
                size = max(float(here[name].abs().max()), float(there[name].abs().max()))
                worst = int(change.argmax())
                if float(change[worst]) > SEAM_JUMP * size:
                    raise InputError(
                        f"the oracle's {name} jumps by {float(change[worst]):.3g} where coordinate {i} passes from 1 to 0, "
                        f"at x = {after[worst].tolist()}, but it must have period 1 in each coordinate."
                    )


def asked(function: abc.Callable, x: np.ndarray, one_by_one: bool):
    """``function`` at ``x`` ``(N, d)``, at all of them at once or one by one."""
    if not one_by_one:
        return function(x.copy())
    rows = [function(state.copy()) for state in x]
    if not all(isinstance(row, tuple | list) for row in rows):
        return rows[0]
    return tuple(
        None if any(p is None for p in parts) else np.stack([np.asarray(p) for p in parts])
        for parts in zip(*rows, strict=True)
    )


def resolved(target: str) -> abc.Callable:
    """The function that module:function or FILE.py:function names."""
    source, _, name = target.rpartition(":")
    if not source or not name:
        raise InputError(f"problem.target is {target!r}, but must be module:function or FILE.py:function.")
    try:
        if source.endswith(".py"):
            if not Path(source).is_file():
                raise InputError(f"problem.target names {source}, which does not exist.")
            spec = importlib.util.spec_from_file_location(Path(source).stem, source)
            module = importlib.util.module_from_spec(spec)
            sys.modules.setdefault(Path(source).stem, module)
            spec.loader.exec_module(module)
        else:
            module = importlib.import_module(source)
    except InputError:
        raise
    except Exception as error:  # whatever a stranger's module may raise
        raise InputError(f"problem.target = {target} cannot be imported: {type(error).__name__}: {error}.") from None
    found = getattr(module, name, None)
    if not callable(found):
        known = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise InputError(f"problem.target = {target}: the module has no function {name!r}{nearest(name, known)}.")
    return found


class _Ask(torch.autograd.Function):
    """One part of the oracle's answer: values by calling, derivatives by central differences; stacks flattened."""

    @staticmethod
    def forward(x: Tensor, problem: Callable, name: str) -> Tensor:
        return problem.answers(x.detach().cpu().double().remainder(1.0))[name].to(x)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        x, ctx.problem, ctx.name = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def jvp(ctx, tangent: Tensor, *_) -> Tensor:
        (x,) = ctx.saved_tensors
        return _difference(ctx.problem, ctx.name, x, tangent)

    @staticmethod
    def backward(ctx, outward: Tensor):
        (x,) = ctx.saved_tensors
        if not ctx.problem.differences:
            return torch.zeros_like(x), None, None  # an ascent then follows the networks alone
        basis = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        slopes = [outward * _difference(ctx.problem, ctx.name, x, e.expand_as(x)) for e in basis]
        return torch.stack([s.reshape(len(x), -1).sum(dim=-1) for s in slopes], dim=-1), None, None

    @staticmethod
    def vmap(info, in_dims, x: Tensor, problem: Callable, name: str):
        if in_dims[0] is None:
            return _Ask.apply(x, problem, name), None
        x = x.movedim(in_dims[0], 0)
        return _Ask.apply(x.flatten(0, 1), problem, name).unflatten(0, x.shape[:2]), 0


def _difference(problem: Callable, name: str, x: Tensor, direction: Tensor) -> Tensor:
    step, x64, along = problem._step, x.double(), direction.double()
    ahead, behind = (_Ask.apply(x64 + s * step * along, problem, name) for s in (1.0, -1.0))
    return ((ahead - behind) / (2.0 * step)).to(direction)
