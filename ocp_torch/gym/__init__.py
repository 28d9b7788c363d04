"""Our problems as Gymnasium environments: `import ocp_torch.gym`, then `gymnasium.make("ocp_torch/Circle-v0")`.

Arguments of the problem and of `ControlEnvironment` are given to `gymnasium.make`; a problem of your own is
`gymnasium.make("ocp_torch/Problem-v0", problem=MyProblem())`. Needs the optional extra `gym`: without it nothing is
registered, and `register` says how to get it.
"""

import os
from importlib.util import find_spec

from ocp_torch.errors import InputError, call, require_choice
from ocp_torch.gym.environment import ControlEnvironment, require_gymnasium
from ocp_torch.problems import PROBLEMS, Problem

# Arguments of the environment; every other one is the problem's.
ENVIRONMENT = ("control_bound", "time_step", "horizon", "render_mode")

__all__ = ["make", "register"]


def make(problem: str | Problem | None = None, **options):
    """The environment of ``problem``, a name in `PROBLEMS` or an instance; ``options`` are arguments of both of them.

    Starts are random until ``reset(seed=...)``.
    """
    if problem is None:
        raise InputError("problem is missing; give one of your own, as in problem=MyProblem().")
    own = {k: options.pop(k) for k in ENVIRONMENT if k in options}
    own["seed"] = int.from_bytes(os.urandom(4), "little")
    if not isinstance(problem, Problem):
        made = call(PROBLEMS[require_choice("problem", problem, PROBLEMS)], "problem", options)
        return ControlEnvironment(made, **own)
    if options:
        raise InputError(f"{next(iter(options))} is no argument of an environment; the problem is made already.")
    return ControlEnvironment(problem, **own)


def register() -> None:
    """Register the environments of all problems with Gymnasium. Raises `InputError` where it is not installed."""
    gymnasium = require_gymnasium()
    given = {f"ocp_torch/{c.__name__}-v0": {"problem": name} for name, c in PROBLEMS.items() if c.has_simulator}
    for environment, arguments in (given | {"ocp_torch/Problem-v0": {}}).items():
        if environment not in gymnasium.registry:
            gymnasium.register(environment, entry_point="ocp_torch.gym:make", kwargs=arguments)


if find_spec("gymnasium") is not None:
    register()
