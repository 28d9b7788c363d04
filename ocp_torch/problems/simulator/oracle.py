"""A user's NumPy function as an oracle: its answers are checked, and failures are reported with the state."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, ProblemError, first_line, require_integer
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.problems.simulator.target import asked, resolved
from ocp_torch.problems.simulator.workers import Workers

# Two answers at a state may differ by this, relative to the size of the answer: rounding.
SAME = 1e-6
SAME_IN_FLOAT32 = 1e-3
# Where a coordinate passes from 1 to 0, states this far on both sides are compared.
SEAM_STEP = 1e-7
SEAM_PROBES = 4  # pairs of states for each coordinate
MOST_SEAMS = 32  # coordinates that are looked at, at most
# An answer jumps at the seam if it changes by more than this part of its size.
SEAM_JUMP = 1e-3
# The size is the largest answer at so many states of the whole torus too: at the seam itself an odd function is nearly 0.
SIZE_STATES = 32


class Oracle:
    """The ``target`` of a `Simulator`, by name or the function itself, asked with ``workers`` processes.

    `__init__` raises `InputError` unless its answers at a few states and across the seam have the form that `Simulator`
    describes; every later answer is checked too. ``driftless``: the target gives `None` for `a`; ``gives_mu0``: it gives a
    `mu0`; ``motions``: columns of `sigma`, 0 for no noise; ``in_float32``: `f` is in single precision.
    """

    def __init__(self, target: str | Callable, dim: int, control_dim: int, workers: int = 1) -> None:
        workers = require_integer("problem.workers", workers, 1, maximum=1024)
        if workers > 1 and not isinstance(target, str):
            raise InputError("problem.workers needs a target by name, module:function, which each process can import.")
        self._function = resolved(target) if isinstance(target, str) else target
        if not callable(self._function):
            raise InputError(f"problem.target is {target!r}, but must be module:function or a function.")
        self._dim, self._control_dim = dim, control_dim
        self._pool: Workers | None = None
        self._kept: tuple[Tensor, dict] | None = None
        self.one_by_one = self.driftless = self.gives_mu0 = self.in_float32 = False
        self.motions, self._understood = 0, False
        self._understand()
        self._check_the_seam()
        if isinstance(target, str) and workers > 1:
            self._pool = Workers(target, workers)

    def answers(self, at: Tensor) -> dict:
        """All parts at float64 states ``(N, dim)`` of the unit cell, by name. The last batch's dict is kept, as its parts are
        asked for in turn; callers may add to it what they derive."""
        if self._kept is None or self._kept[0].shape != at.shape or not torch.equal(self._kept[0], at):
            self._kept = at, self.checked(at)
        return self._kept[1]

    def checked(self, at: Tensor) -> dict[str, Tensor]:
        """The parts of `answers`, by a new call and not kept; `ProblemError` for failures and values that are not finite."""
        x = at.numpy()
        try:
            answer = self._pool.map(x, self.one_by_one) if self._pool else asked(self._function, x, self.one_by_one)
        except InputError:
            raise
        except Exception as error:  # whatever a stranger's code may raise
            raise ProblemError(self._failure(x, error)) from None
        found = self._shaped(answer, x)
        for name, values in found.items():
            bad = ~torch.isfinite(values).reshape(len(x), -1).all(dim=-1)
            if bool(bad.any()):
                raise ProblemError(f"the oracle's {name} is not finite at x = {x[int(bad.nonzero()[0])].tolist()}.")
        return found

    def _failure(self, x: np.ndarray, error: Exception) -> str:
        """A sentence with what the target raised and a state at which it does, found by halving the batch."""
        while len(x) > 1:
            half, x = x[: len(x) // 2], x[len(x) // 2 :]
            try:
                asked(self._function, half, self.one_by_one)
            except Exception as other:  # whatever a stranger's code may raise
                x, error = half, other
        return f"the oracle raised {type(error).__name__} at x = {x[0].tolist()}: {first_line(error)}."

    def _shaped(self, answer: object, x: np.ndarray) -> dict[str, Tensor]:
        """The parts of ``answer`` by name, as float64 tensors; `InputError` where one is missing or misshapen."""
        count, d, m = len(x), self._dim, self._control_dim
        if not isinstance(answer, tuple | list) or len(answer) not in (3, 4, 5):
            raise InputError(
                f"the oracle gave a {type(answer).__name__}, but must give f, a, B (and, if it likes, mu0, sigma or both)."
            )
        forms: dict[str, tuple] = {"f": (count,), "a": (count, d), "B": (count, d, m)}
        more = [part for part in answer[3:] if part is not None]
        columns = _columns(more[-1]) if more else 0
        if len(more) == 2 or (more and not columns):
            forms["mu0"] = (count,)
        if len(more) == 2 or columns:
            forms["sigma"] = (count, d, self.motions or max(columns, 1))
        if self._understood and ("mu0" in forms, "sigma" in forms) != (self.gives_mu0, self.motions > 0):
            raise InputError(f"the oracle gave {', '.join(forms)} at x = {x[0].tolist()}, but other parts before.")
        found = {}
        for (name, form), part in zip(forms.items(), (*answer[:3], *more), strict=True):
            try:
                given = np.zeros(form) if name == "a" and part is None else np.asarray(part)
            except (TypeError, ValueError):
                given = np.asarray(None)
            if given.dtype.kind not in "fiu":
                raise InputError(f"the oracle's {name} is no array of real numbers at x = {x[0].tolist()}.")
            if name == "B" and m == 1 and given.shape == (count, d):
                given = given[:, :, None]
            if given.shape != form:
                of, first = ("a state", 1) if self.one_by_one else ("states", 0)
                raise InputError(
                    f"the oracle's {name} has shape {given.shape[first:]} for {of} of shape {x.shape[first:]} (x = "
                    f"{x[0].tolist()}{'' if first else ' the first'}), but must have {form[first:]}."
                )
            found[name] = torch.from_numpy(given.astype(np.float64, order="C"))
        return found

    def _understand(self) -> None:
        """Find out whether the target takes batches or single states, and which parts it gives. Raises `InputError` where its
        answers do not depend on the state alone."""
        x = scrambled_sobol(self._dim + 3, self._dim, 0, torch.float64)
        self.one_by_one = self._form(x.numpy())
        found = self.checked(x)
        raw = asked(self._function, x[:1].numpy(), self.one_by_one)
        self.driftless, self.gives_mu0 = raw[1] is None, "mu0" in found
        self.motions, self._understood = found["sigma"].shape[2] if "sigma" in found else 0, True
        self.in_float32 = np.asarray(raw[0]).dtype == np.float32
        again, alone = self.checked(x), self.checked(x[2:3])
        for name, values in found.items():
            size = (SAME_IN_FLOAT32 if self.in_float32 else SAME) * (float(values.abs().max()) + 1e-6)
            if float((again[name] - values).abs().max()) > size:
                raise InputError(
                    f"the oracle's {name} differs between two calls at x = {x[0].tolist()}; it must be a function of x."
                )
            if float((alone[name][0] - values[2]).abs().max()) > size:
                raise InputError(
                    f"the oracle's {name} at x = {x[2].tolist()} depends on the other states of the batch."
                )

    def _form(self, x: np.ndarray) -> bool:
        """Whether the target takes states one by one: the way that gives an answer of the right shape at any of ``x``."""
        complaints = []
        for one_by_one in (False, True):
            # d + 3 rows, which cannot be taken for a single state: the given states, then copies of each of them.
            for batch in (x, *(np.repeat(state[None], len(x), axis=0) for state in x)):
                self.one_by_one, answer = one_by_one, None
                try:
                    answer = asked(self._function, batch, one_by_one)
                    self._shaped(answer, batch)
                    return one_by_one
                except Exception as error:  # whatever a stranger's code may raise
                    fitting = _fitting(answer, len(batch), self._dim, self._control_dim)
                    complaints.append((isinstance(error, InputError), fitting, error, one_by_one))
        # The complaint reported is that of the way, batches or single states, in which more of the answer is right.
        told, _, complaint, self.one_by_one = max(complaints, key=lambda c: c[:2])
        raise (complaint if told else InputError(self._failure(x, complaint))) from None

    def _check_the_seam(self) -> None:
        everywhere = self.checked(scrambled_sobol(SIZE_STATES, self._dim, 0, torch.float64))
        for i in range(min(self._dim, MOST_SEAMS)):
            after = scrambled_sobol(SEAM_PROBES, self._dim, 1 + i, torch.float64)
            before = after.clone()
            after[:, i], before[:, i] = SEAM_STEP, 1.0 - SEAM_STEP
            here, there = self.checked(after), self.checked(before)
            for name in here:
                change = (here[name] - there[name]).reshape(SEAM_PROBES, -1).abs().amax(dim=-1)
                worst = int(change.argmax())
                if float(change[worst]) > SEAM_JUMP * max(
                    float(v[name].abs().max()) for v in (here, there, everywhere)
                ):
                    raise InputError(
                        f"the oracle's {name} jumps by {float(change[worst]):.3g} where coordinate {i} passes from 1 to 0, "
                        f"at x = {after[worst].tolist()}, but it must have period 1 in each coordinate."
                    )


def _fitting(answer: object, count: int, d: int, m: int) -> int:
    """How many of `f`, `a` and `B` in the ``answer`` at ``count`` states have the shape they must have."""
    if not isinstance(answer, tuple | list):
        return 0
    try:
        return sum(
            np.shape(part) == form for part, form in zip(answer, ((count,), (count, d), (count, d, m)), strict=False)
        )
    except ValueError:  # rows of unlike lengths
        return 0


def _columns(part: object) -> int:
    """How many columns ``part`` has if it is a matrix for each state, as no density is; else 0."""
    try:
        shape = np.asarray(part).shape
    except ValueError:  # rows of unlike lengths
        return 0
    return shape[2] if len(shape) == 3 else 0
