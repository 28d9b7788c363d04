"""A trained controller as a function of the state, with all that it came from, and how it is written."""

import copy
from dataclasses import asdict, dataclass
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ocp_torch.control.described import described, problem_name
from ocp_torch.control.exported import about, coordinates_of, example_states, exported_function
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.pace import Pace
from ocp_torch.control.policies import BOUNDING, TRAJECTORIES, Policy, trained_policies
from ocp_torch.errors import InputError, require_number, shown
from ocp_torch.export import export
from ocp_torch.fields import Fields
from ocp_torch.files.storage import save_tensors
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.physical.system import System

SCHEMA = 3  # of a controller's file, raised when an older version could not read what is written
# Attributes of a controller that the file holds as they are.
SAVED = ("model", "occupation", "kind", "certificate", "config")
# Controls are returned in the type of the states.
States = TypeVar("States", Tensor, np.ndarray)


@dataclass(repr=False)
class Controller:
    """A controller `u(x)`, with all that it came from.

    ``kind`` says which policy `u` is: ``value`` (from `V` alone), ``density`` (`w / mu`), ``minimised`` (`w / mu` with the
    `mu` of Lemma 2 in place of the trained one), ``trajectories`` (best for a whole step, from the `V` of the warm start) or
    ``subsolution`` (from `V` trained on for the lower bound).
    ``certificate`` is the dict of `certificate.json`, ``config`` the resolved configuration of the run, ``model`` the
    network's configuration. Controls are computed in double precision, whatever the networks were trained in: in single
    precision those of a pendulum were off by up to 1e-5 of the largest.
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
        self._exact = copy.deepcopy(self.fields).double()
        how = self.occupation, self.problem, self._exact, self.constants
        self._policy = trained_policies(*how, every=True)[self.kind]

    def __reduce__(self) -> tuple:
        """Copies and pickles are made anew of the fields: policies are functions, which cannot be pickled."""
        return Controller, tuple(getattr(self, f.name) for f in dataclass_fields(self))

    def __repr__(self) -> str:
        said = self.certificate.get("gap")  # as the file has it, which may be anything
        gap = said.get("simulated") if isinstance(said, dict) else None
        sizes = f"d = {self.problem.dim}, m = {self.problem.control_dim}"
        known = f", gap {gap:.2%}" if isinstance(gap, float) else ""
        return f"Controller({problem_name(self.problem)}, {self.kind}, {sizes}{known})"

    def __call__(self, x: States) -> States:
        """Controls ``(N, m)`` at states ``(N, d)``: any reals, wrapped to the torus; NumPy in gives NumPy out, and floats of
        a precision give floats of it.

        Raises `InputError` for another shape."""
        return self._controls(self._policy, x)

    def _controls(self, policy: Policy, x: States) -> States:
        states = self._states("x", x)
        with torch.no_grad():
            u = policy(states.to(next(self._exact.parameters())).remainder(1.0)).to(states.dtype)
        return u.cpu().numpy() if isinstance(x, np.ndarray) else u

    @property
    def policy(self) -> Policy:
        """`u` at states of the unit cell, in float64 on the CPU, where certificates and metrics are computed."""
        fields = copy.deepcopy(self._exact).to("cpu")
        return trained_policies(self.occupation, self.problem, fields, self.constants, every=True)[self.kind]

    @property
    def held_for(self) -> float | None:
        """For how many units of time each control is meant to be held, and was in the simulations of the certificate; `None`
        for a controller that acts at every instant."""
        return self._policy.pace.step if isinstance(self._policy, HeldPolicy) else None

    def held(self, x: States, step: float) -> States:
        """Controls ``(N, m)`` at states ``(N, d)`` that are best, by `V`, where each is held for ``step`` units of time.

        Raises `InputError` as a call does, for a ``step`` that is no time, and where the controller holds no `V`."""
        others = {TRAJECTORIES: self._exact.trajectory_value, BOUNDING: self._exact.subsolution}
        field = others.get(self.kind, self._exact.value)
        if field is None:
            raise InputError("this controller holds no V, from which controls for a whole step follow.")
        pace = Pace.of(self.problem).with_step(require_number("step", step, above=0.0))
        return self._controls(HeldPolicy(self.problem, field, pace), x)

    def physical(self, s: States) -> States:
        """Controls ``(N, m)`` at states ``(N, d)``, both in the units of a `System`; beyond its box what they are at the
        nearest state of it. Raises `InputError` for another shape, and for a problem without physical units."""
        if not isinstance(self.problem, System):
            raise InputError(
                f"the problem {problem_name(self.problem)} has no physical units; give states of the torus to controller(x)."
            )
        states = self._states("s", s)
        exact = states.to(next(self._exact.parameters()))
        u = self.problem.from_controls(self(self.problem.to_torus(self.problem.chart.nearest(exact)))).to(states.dtype)
        return u.cpu().numpy() if isinstance(s, np.ndarray) else u

    def _states(self, name: str, given: States) -> Tensor:
        """``given`` as floats, if it is of shape ``(N, d)``."""
        # PyTorch takes no arrays that run backwards or have another byte order, and warns of those that are read-only.
        own = np.array(given, dtype=given.dtype.newbyteorder("=")) if isinstance(given, np.ndarray) else given
        try:
            states = torch.as_tensor(own)
        except (TypeError, ValueError, RuntimeError):  # a dict of observations, rows of unlike lengths
            raise InputError(
                f"{name} is {shown(given)}, but must be numbers of shape (N, {self.problem.dim})."
            ) from None
        if states.ndim != 2 or states.shape[1] != self.problem.dim:
            raise InputError(f"{name} has shape {tuple(states.shape)}, but must have shape (N, {self.problem.dim}).")
        return states if states.is_floating_point() else states.double()

    def save(self, path: str | Path) -> None:
        """Write `controller.safetensors`: weights, and as JSON everything needed to build the controller again."""
        metadata = {
            "schema": SCHEMA,
            "problem": described(self.problem),
            "dtype": str(next(self.fields.parameters()).dtype).removeprefix("torch."),
            "fields": list(self.fields.networks),
            "bounds": asdict(self.constants),
            **{name: getattr(self, name) for name in SAVED},
        }
        save_tensors(Path(path), dict(self.fields.state_dict()), metadata)

    def export(self, out: str | Path, format: str | None = None, coordinates: str | None = None) -> list[Path]:
        """Write functions that need no PyTorch to ``out``, and return the files: the control ``(m,)``, the value `V` and
        its gradient ``(d,)`` at a state ``(d,)``, with certificate, units and configuration inside, as JSON.

        ``format`` is `onnx` (a model of a batch of states, float32), `c` (a header and a C99 source, float or double) or
        `casadi` (a function of one state, float64); by default what the ending of ``out`` says. ``coordinates`` are `torus`
        or `physical`, by default physical where the problem is a `System`; beyond its box functions are what they are at the
        nearest state of it. Raises `InputError` for a wrong choice, a library that is missing, and a problem whose functions
        cannot be traced.
        """
        problem, place = self.problem, coordinates_of(self.problem, coordinates)
        function = exported_function(problem, self.fields, self.kind, self.occupation, self.constants, place)
        inside = {"coordinates": place, "problem": described(problem), "policy": self.kind, "held_for": self.held_for}
        inside |= {"certificate": self.certificate, "config": self.config}
        return export(function, example_states(problem, place), Path(out), format, about(problem, place), inside)
