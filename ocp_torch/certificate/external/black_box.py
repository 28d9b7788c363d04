"""A given controller as a policy: checked, wrapped to the torus, with derivatives by differences."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, first_line
from ocp_torch.maths.differences import STEPS, Differenced
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.problem import Problem

PROBES = 7  # states on which a controller is tried before anything is computed with it
BATCHES = (16, 64, 1024)  # sizes of batches that begin with these states, whose answers must be the same
SAME = 1e-4  # difference of two answers, relative to the control, that rounding explains
# Relative excess of a control over its limit that clipping in single precision explains: such a control is cut back.
BEYOND = 1e-5
TORCHSCRIPT = "TorchScript interpreter"  # in the first line of its errors, whose last line alone says what was wrong


class BlackBox:
    """``function`` of states ``(N, d)`` to controls ``(N, m)``, a tensor or an array, as a policy in float64.

    The function is called on `[0, 1)^d` only. Central differences stand in for its derivatives, so that it may be NumPy, a
    runtime's session or anything else; ``precision`` is the one it computes in. Raises `InputError` where it fails, gives
    another shape or a number that is not finite, breaks the limit on the control, or depends on more than the state.
    """

    def __init__(self, function: Callable, problem: Problem) -> None:
        if not callable(function):
            raise InputError(f"controller is {function!r}, but must be a function of states (N, {problem.dim}).")
        self.function, self.control_dim = function, problem.control_dim
        self.cost = problem.control_cost
        self._mixed = False  # whether it takes tensors and answers with arrays
        self._states = scrambled_sobol(max(BATCHES), problem.dim, 0, torch.float64)
        self._convert, self.precision, self._first = self._understood(self._states[:PROBES])
        self.require_still()
        self.step = STEPS[self.precision]

    def __call__(self, x: Tensor) -> Tensor:
        return Differenced.apply(x, self.evaluate, self.step, True)

    def evaluate(self, x: Tensor) -> Tensor:
        """The controls at ``x`` in the precision of ``x``; raises `InputError` as above."""
        wrapped = x.detach().double().remainder(1.0)
        out = self._answered(wrapped)
        bad = ~torch.isfinite(out).all(dim=-1)
        if bool(bad.any()):
            raise InputError(f"the controller is not finite at x = {wrapped[bad][0].tolist()}.")
        out = out.to(x)
        require_limit(out, wrapped, self.cost)
        return self.cost.within(out, torch.ones_like(out[:, 0]))

    def _answered(self, x: Tensor) -> Tensor:
        """The answer at states ``x`` ``(N, d)`` of the unit cell, ``(N, m)``; whatever goes wrong is an `InputError`."""
        try:
            return self._ask(self._convert, x)
        except Exception as error:  # whatever the user's code may raise
            raise _refusal(error) from None

    def _ask(self, convert: Callable[[Tensor], object], x: Tensor) -> Tensor:
        with torch.no_grad():
            out = self.function(convert(x.clone()))  # it may write into its argument
        if isinstance(out, np.ndarray) and isinstance(convert(x[:1]), Tensor) and not self._mixed:
            raise _WantsArrays
        out = torch.as_tensor(out if isinstance(out, Tensor) else np.asarray(out)).detach().cpu().to_dense()
        if out.shape == (len(x),) and self.control_dim == 1:
            out = out.unsqueeze(-1)
        wanted = (len(x), self.control_dim)
        if out.shape != wanted:
            given = f"shape {tuple(out.shape)} for states {tuple(x.shape)}"
            raise InputError(f"the controller gave {given}, but must give {wanted}.")
        if out.is_complex():
            raise InputError("the controller gave complex numbers, but a control is real.")
        return out if out.is_floating_point() else out.double()

    def require_still(self) -> None:
        """Raise `InputError` where the answers differ from those at first, or with the size of the batch."""
        for size in BATCHES:
            out = self._answered(self._states[:size])[:PROBES]
            if float((out - self._first).abs().max()) > _rounding(self._first):
                raise InputError(
                    "the controller's answer for a state changes with what it was asked before, or with the other states of "
                    f"the batch (of {size} here); it must be a function of x."
                )

    def _understood(self, x: Tensor) -> tuple[Callable[[Tensor], object], torch.dtype, Tensor]:
        """The form of states the controller takes, tensors or arrays, the precision it answers in, and its answers."""
        forms = (lambda x: x, lambda x: x.float(), lambda x: x.numpy())
        complaints = []
        # What answers tensors with arrays is first asked with arrays, as NumPy's functions should be.
        for convert, self._mixed in [*((form, False) for form in forms), *((form, True) for form in forms[:2])]:
            try:
                out, again, alone = (self._ask(convert, states) for states in (x, x, x[2:3]))
            except Exception as error:  # whatever the user's code may raise
                complaints.append(error)
                continue
            size = _rounding(out)
            if float((again - out).abs().max()) > size:
                raise InputError(
                    "the controller gave different controls for the same states; it must be a function of x."
                )
            if float((alone[0] - out[2]).abs().max()) > size:
                raise InputError("the controller's answer for a state depends on the other states of the batch.")
            coarse = out.dtype in (torch.float32, torch.float16, torch.bfloat16) or convert is forms[1]
            return convert, torch.float32 if coarse else torch.float64, out
        own = [e for e in complaints if not isinstance(e, _WantsArrays)]
        refusal = _refusal(next((e for e in own if isinstance(e, InputError)), own[0]))
        if own[:2] == complaints[:2] and not any(isinstance(e, InputError) for e in own):
            double, single = map(_raised, own[:2])  # a network in float32 says of float64 only that it is not float32
            if single != double:
                refusal = InputError(f"the controller raised {double}; and for states in float32 {single}.")
        raise refusal from None


class _WantsArrays(Exception):
    """Tensors went in and an array came out."""


def _rounding(out: Tensor) -> float:
    """The difference between two answers ``(N, m)`` that rounding explains."""
    return SAME * float(out.abs().max().nan_to_num(nan=1.0)) + 1e-12


def _refusal(error: Exception) -> InputError:
    """The `InputError` for an ``error`` that the controller raised."""
    if isinstance(error, InputError):
        return error
    return InputError(f"the controller raised {_raised(error)}.")


def _raised(error: Exception) -> str:
    """The type of ``error`` and what it says, without a full stop."""
    lines = str(error).rstrip().splitlines()
    if len(lines) > 1 and TORCHSCRIPT in lines[0]:
        return lines[-1].rstrip(".")
    return f"{type(error).__name__}: {first_line(error)}"


def require_limit(u: Tensor, x: Tensor, cost: PowerCost) -> None:
    """Raise `InputError` where a control ``u`` ``(N, m)`` at one of the states ``x`` exceeds the limit of ``cost`` by more
    than rounding."""
    gauge = cost.gauge(u)
    worst = int(gauge.argmax())
    if float(gauge[worst]) > 1.0 + BEYOND:
        given = ", ".join(f"{c:.6g}" for c in u[worst].tolist())
        raise InputError(
            f"the controller gives u = [{given}] of size {float(u[worst].norm()):.6g} at x = {x[worst].tolist()}, "
            f"but problem.control_limit is {cost.limit}; clip it."
        )
