"""A trained controller as a function of the state, and as a file."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ocp_torch.control.policies import trained_policies
from ocp_torch.errors import InputError
from ocp_torch.fields import Fields
from ocp_torch.files.storage import save_tensors
from ocp_torch.problems import PROBLEMS, Problem
from ocp_torch.problems.constants import Constants

# Of `controller.safetensors`; raised when an older version could not read what is written.
SCHEMA = 1
# What the file holds of a controller just as it is.
PLAIN = ("model", "occupation", "kind", "certificate", "config")

# What controls are given as: as what the states were.
States = TypeVar("States", Tensor, np.ndarray)


@dataclass
class Controller:
    """`u(x)` with all it came from.

    ``kind`` says which policy `u` is: ``value`` (from `V` alone) or ``density`` (`w / mu`). ``certificate`` is the dict of
    `certificate.json`, ``config`` the resolved configuration of the run, ``model`` the network's configuration.
    """

    problem: Problem
    fields: Fields
    constants: Constants
    occupation: str | None
    kind: str
    model: dict
    certificate: dict
    config: dict

    def __post_init__(self) -> None:
        self._policy = trained_policies(self.occupation, self.problem, self.fields, self.constants)[self.kind]
        self._like = next(self.fields.parameters())

    def __call__(self, x: States) -> States:
        """Controls ``(N, m)`` at states ``(N, d)``: any reals, wrapped to the torus; NumPy in gives NumPy out.

        Raises `InputError` for another shape.
        """
        states = torch.as_tensor(x)
        if states.ndim != 2 or states.shape[1] != self.problem.dim:
            raise InputError(f"x has shape {tuple(states.shape)}, but must have shape (N, {self.problem.dim}).")
        if not states.is_floating_point():
            states = states.double()
        with torch.no_grad():
            # Wrapped before it is rounded, so that states far from the unit cell keep their place in it.
            u = self._policy(states.remainder(1.0).to(self._like))
        return u.cpu().numpy() if isinstance(x, np.ndarray) else u

    def save(self, path: str | Path) -> None:
        """Write `controller.safetensors`: weights, and as JSON everything needed to build the controller again."""
        metadata = {
            "schema": SCHEMA,
            "problem": {"name": problem_name(self.problem), "parameters": plain_parameters(self.problem.parameters)},
            "dtype": str(self._like.dtype).removeprefix("torch."),
            "fields": list(self.fields.networks),
            "bounds": asdict(self.constants),
            **{name: getattr(self, name) for name in PLAIN},
        }
        save_tensors(Path(path), dict(self.fields.state_dict()), metadata)


def problem_name(problem: Problem) -> str:
    """The name of a built-in problem, or the class name of a user's own in lower case (with its module if that is taken)."""
    cls = type(problem)
    own = cls.__name__.lower()
    return next((n for n, c in PROBLEMS.items() if c is cls), own if own not in PROBLEMS else f"{cls.__module__}.{own}")


def plain_parameters(parameters: dict) -> dict:
    """Those of a problem's ``parameters`` that JSON can hold. Others only a user's own problem has, which is handed in on
    loading."""
    listed = {k: list(v) if isinstance(v, tuple) else v for k, v in parameters.items()}
    return {k: v for k, v in listed.items() if isinstance(v, bool | int | float | str | list | type(None))}
