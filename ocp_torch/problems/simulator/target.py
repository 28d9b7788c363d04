"""A user's function: found by its name, and called for a whole batch of states, or one by one."""

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ocp_torch.errors import InputError, nearest
from ocp_torch.files.reading import kind, require_file


def resolved(target: str, field: str = "problem.target") -> Callable:
    """The function that module:function or FILE.py:function names; ``field`` names the setting in the `InputError`."""
    source, _, name = target.rpartition(":")
    if not source or not name:
        raise InputError(f"{field} is {target!r}, but must be module:function or FILE.py:function.")
    try:
        if source.endswith(".py"):
            if kind(source) is None:
                raise InputError(f"{field} names {source}, which does not exist.")
            require_file(source)
            spec = importlib.util.spec_from_file_location(Path(source).stem, source)
            assert spec is not None  # as for every .py file
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules.setdefault(Path(source).stem, module)
            spec.loader.exec_module(module)
        else:
            module = importlib.import_module(source)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # whatever a stranger's module may raise
        raise InputError(f"{field} = {target} cannot be imported: {type(error).__name__}: {error}.") from None
    if not callable(found := getattr(module, name, None)):
        known = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise InputError(f"{field} = {target}: the module has no function {name!r}{nearest(name, known)}.")
    return found


def asked(function: Callable, x: np.ndarray, one_by_one: bool):
    """``function`` at the states ``x`` ``(N, d)``, all at once or one by one."""
    try:
        if not one_by_one:
            return function(x.copy())
        return joined([function(state.copy()) for state in x], np.stack)
    except SystemExit as end:  # it would end the run without a word
        raise RuntimeError(f"it asks Python to exit (status {end.code})") from None


def joined(answers: list, join: Callable):
    """The ``answers`` at parts of the states as one answer: each column put together by ``join``, `None` where one is."""
    if not all(isinstance(answer, tuple | list) for answer in answers):
        return answers[0]
    columns = zip(*answers, strict=True)
    return tuple(None if any(p is None for p in parts) else join([np.asarray(p) for p in parts]) for parts in columns)
