"""Tell a user's own errors from the package's: an exception from a user's code becomes one sentence with place and state."""

import sys
import sysconfig
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import torch
from torch import Tensor

from ocp_torch.errors import InputError, ProblemError
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import Problem

PACKAGE = Path(__file__).resolve().parent.parent
# Folders of code that is not the user's: this package, its scripts, Python's own library and installed packages.
LIBRARIES = tuple(
    {str(PACKAGE), str(PACKAGE.parent / "scripts"), str(Path(torch.__file__).resolve().parent.parent)}
    | {sysconfig.get_paths()[key] for key in ("stdlib", "platstdlib", "purelib", "platlib")}
)
# Methods of a `System` that take physical states.
PHYSICAL = ("cost", "dynamics", "disturbance", "divergences")
MOST_SHOWN = 8  # coordinates of a state in a sentence
LONGEST = 300  # characters of a message in a sentence
# Other states that are tried, to see whether a function fails everywhere; where a tenth of all states fail, all eight do once
# in 1e8 times.
OTHERS = 8


def blamed(error: BaseException, of: type | None = None) -> ProblemError | None:
    """A `ProblemError` for an ``error`` that a user's code raised, else `None`; the file of the class ``of``, the problem at
    hand, counts as a user's wherever it lies."""
    if isinstance(error, InputError):
        return error if isinstance(error, ProblemError) else None
    frames = _frames(error, of)
    if not frames:
        return None
    outer = frames[0][0]
    owner = outer.f_locals.get("self")
    whose = f" of {named(owner)}" if isinstance(owner, Problem) else ""
    return ProblemError(f"{outer.f_code.co_name}{whose} raised {words(error)}{_at(outer, owner)}{origin(error, of)}.")


def origin(error: BaseException, of: type | None = None) -> str:
    """`` (my_module.py, line 7)``: where in a user's code ``error`` was raised; empty if in none."""
    if isinstance(error, SyntaxError) and error.filename:
        return f" ({_short(error.filename)}, line {error.lineno})"
    frames = _frames(error, of)
    return f" ({_short(frames[-1][0].f_code.co_filename)}, line {frames[-1][1]})" if frames else ""


def _frames(error: BaseException, of: type | None) -> list[tuple[FrameType, int]]:
    return [(f, line) for f, line in traceback.walk_tb(error.__traceback__) if _is_users(f.f_code.co_filename, of)]


def in_their_words(action: Callable[[], object], who: str, of: type | None = None):
    """The result of ``action``, which runs a user's code; whatever it raises becomes a `ProblemError` of one sentence, about
    ``who`` where the place is not known."""
    try:
        return action()
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # whatever a stranger's code may raise
        raise blamed(error, of) or ProblemError(f"{who} raised {words(error)}.") from None


def named(problem: object) -> str:
    """The class of ``problem`` as a command line names it."""
    return f"{type(problem).__module__}.{type(problem).__qualname__}"


def words(error: BaseException) -> str:
    """Kind and message of ``error``, as in the last line of a traceback, without line breaks and control characters."""
    text = " ".join(str(error).split()) if not isinstance(error, SyntaxError) else str(error.msg)
    text = "".join(c if c.isprintable() else "?" for c in text).rstrip(".")
    if "tensor.detach().numpy()" in text:  # PyTorch's advice would lose the derivatives
        text = "NumPy was given a tensor; use the functions of torch, or problem=callable for a simulator in NumPy"
    if len(text) > LONGEST:
        text = f"{text[: LONGEST // 2]} .. {text[-LONGEST // 2 :]}"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def place(x: Tensor) -> str:
    """One state ``(d,)`` for a sentence."""
    shown = ", ".join(f"{c:.9g}" for c in x[:MOST_SHOWN].tolist())
    return f"x = [{shown}{', ..' if len(x) > MOST_SHOWN else ''}]"


def failing_state(function: Callable[[Tensor], object], x: Tensor) -> Tensor | None:
    """A state ``(d,)`` of ``x`` ``(N, d)`` at which ``function`` raises; `None` if it raises at no single state, or at up to
    `OTHERS` other states as well."""

    def raises(rows: Tensor) -> bool:
        try:
            with torch.no_grad():
                function(rows)
        except (Exception, SystemExit):  # whatever a stranger's code may raise
            return True
        return False

    one = x
    while len(one) > 1:
        half, rest = one[: len(one) // 2], one[len(one) // 2 :]
        one = half if raises(half) else rest
    others = x[(x != one).any(dim=1)][:OTHERS].split(1)
    return one[0] if raises(one) and not (others and all(raises(other) for other in others)) else None


def _at(frame: FrameType, owner: object) -> str:
    """`` at x = [..]`` where ``frame`` is a problem's function of a batch of states, and one of them is to blame."""
    code = frame.f_code
    function = getattr(owner, code.co_name, None) if isinstance(owner, Problem) else None
    x = frame.f_locals.get(code.co_varnames[1]) if code.co_argcount == 2 else None
    if not callable(function) or not isinstance(x, Tensor):
        return ""
    try:
        state = failing_state(function, x.detach()) if x.ndim == 2 else None
    except Exception:  # the tensor belonged to a transform of `torch.func` that has ended
        return ""
    if state is None:
        return ""
    if isinstance(owner, System) and code.co_name in PHYSICAL:
        return f" at {owner.chart.place(state)}"
    return f" at {place(state)}"


def _is_users(file: str, of: type | None) -> bool:
    if file.startswith("<frozen"):
        return False
    path = file if file.startswith("<") else str(Path(file).resolve())
    if not path.startswith(LIBRARIES):
        return True
    # Files in which ``of`` and its base classes are written.
    modules = [sys.modules.get(c.__module__) for c in (of.__mro__ if of is not None else ())]
    own = {str(Path(f).resolve()) for f in (getattr(m, "__file__", None) for m in modules) if f}
    return path in own and not path.startswith(str(PACKAGE))


def _short(file: str) -> str:
    path = Path(file)
    if file.startswith("<") or not path.is_absolute():
        return file
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else file
