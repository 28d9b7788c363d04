"""The commands to go on with a run, with its own names filled in."""

import shlex
from pathlib import Path

from ocp_torch.problems import PROBLEMS, Problem
from ocp_torch.problems.commands import as_typed, made_by, naming
from ocp_torch.problems.simulator.simulator import Simulator
from ocp_torch.runs.report.page import code, section


def going_on(folder: Path, problem: Problem, config: dict, certificate: dict) -> str:
    """The section of commands for the run in ``folder``, of ``problem`` and its ``config``, with its ``certificate``."""
    return section(
        "How to go on",
        *(f"<h3>{name}</h3>{code(lines)}" for name, lines in commands(folder, problem, config, certificate)),
    )


def commands(folder: Path, problem: Problem, config: dict, certificate: dict) -> list[tuple[str, str]]:
    """Pairs of a title and the lines of a command."""
    made = config.get("problem") or {}
    ours = type(problem) in PROBLEMS.values()
    # Only the command line may name a user's own problem; a resume knows the arguments of a class, but not of a simulator.
    own = [] if ours else naming(made)
    again = own[:1] if not isinstance(problem, Simulator) else ["problem=callable", *own[1:]]
    run = as_typed(str(folder))
    typed = lambda script, *rest: shlex.join(["python", f"scripts/{script}.py", *rest])
    certified = [typed("evaluate", f"run={run}", "seed=7", *own)]
    if ours and problem.dim <= 2 and certificate["lower"].get("shifted"):
        certified.append(typed("evaluate", f"run={run}", "certificate.rigorous=true", *own))
    more = (f"trainer.steps={2 * certificate['step']}", *(word.lstrip("+") for word in again))
    found = [
        ("Certify again, on other states", "\n".join(certified)),
        ("Train on", typed("train", f"resume={run}", *more)),
        ("Use the controller in Python", _python(folder, problem, made, ours)),
    ]
    if problem.has_simulator:
        environment = f"ocp_torch/{type(problem).__name__ if ours else 'Problem'}-v0"
        found.append(("See it at work", typed("rollout", f"run={run}", f"env={environment}", "video=out.gif", *own)))
        found.append(("Use it without PyTorch", typed("export", f"run={run}", "out=controller.c", *own)))
    found.append(("Look at the curves", shlex.join(["tensorboard", "--logdir", str(folder)])))
    found.append(("Put runs side by side", typed("compare", str(folder.parent), "html=runs.html")))
    return found


def _python(folder: Path, problem: Problem, made: dict, ours: bool) -> str:
    module, _, name = str(made.get("_target_")).rpartition(".")
    lines = ["import torch", "from ocp_torch import load_controller"]
    lines += [] if ours else [f"from {module or 'my_module'} import {name}"]
    given = "" if ours else f", problem={made_by(made)}"
    lines += ["", f"u = load_controller({str(folder / 'controller.safetensors')!r}{given})"]
    lines.append(f"u(torch.rand(5, {problem.dim}))  # states (N, d) on the torus, controls (N, m)")
    if problem.measures is not None:
        units = [
            ", ".join(c.label for c in group) for group in (problem.measures.coordinates, problem.measures.controls)
        ]
        lines.append(f"u.physical(s)  # states s of {units[0]}; controls of {units[1]}")
    return "\n".join(lines)
