"""A controller as an agent in a Gymnasium environment, ours or anybody's."""

from __future__ import annotations

import numpy as np

from ocp_torch.control.controller import Controller
from ocp_torch.errors import InputError


class Agent:
    """``controller`` in the environment ``env`` (its id is ``name``): observations to states, controls to actions.

    An environment of ours says how itself; for any other the controller's problem does, by `Problem.from_observation` and
    `Problem.to_action`. Raises `InputError` where neither does, or what they give does not fit.
    """

    def __init__(self, controller: Controller, env, name: str) -> None:
        self.controller, self.name, self.space = controller, name, env.action_space
        own = env.unwrapped
        if hasattr(own, "from_observation"):
            if own.problem.dim != controller.problem.dim or own.problem.control_dim != controller.problem.control_dim:
                raise InputError(
                    f"{name} has d = {own.problem.dim}, m = {own.problem.control_dim}, but the controller is for "
                    f"d = {controller.problem.dim}, m = {controller.problem.control_dim}."
                )
            self._state, self._action = own.from_observation, own.to_action
        else:
            problem = controller.problem
            self._state = lambda observation: problem.from_observation(name, observation)
            self._action = lambda control: problem.to_action(name, control)

    def act(self, observation) -> np.ndarray:
        """The action for ``observation``."""
        d = self.controller.problem.dim
        state = np.asarray(self._state(observation), dtype=np.float64)
        if state.shape != (d,) or not np.isfinite(state).all():
            raise InputError(f"from_observation gave {state} for {self.name}, but must give {d} finite coordinates.")
        control = self.controller(state[None])[0]
        action = np.asarray(self._action(control), dtype=self.space.dtype)
        if action.shape != self.space.shape:
            raise InputError(
                f"to_action gave shape {action.shape} for {self.name}, whose actions have shape {self.space.shape}."
            )
        return np.clip(action, self.space.low, self.space.high) if hasattr(self.space, "low") else action
