"""Contests: contenders from a resolved configuration, run one after the other."""

import logging
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from ocp_torch.certificate.settings import require_possible
from ocp_torch.control.described import problem_name
from ocp_torch.errors import InputError, call, require_choice, require_integer, require_number, require_section
from ocp_torch.files.storage import write_atomically
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants, resolve_constants
from ocp_torch.runs.build import build_certificate_settings, build_problem, build_trainer
from ocp_torch.runs.canvas import drawn, save
from ocp_torch.studies.benchmark.contenders import KernelContender, NetworkContender, RLContender, require_rl
from ocp_torch.studies.benchmark.families import Family, joined, pictures, read_beside, tables, versions
from ocp_torch.studies.benchmark.measure import Curve, Judge
from ocp_torch.training.budgets import fill

log = logging.getLogger(__name__)

METHODS = ("dual", "primal", "pd")
# Groups of a training configuration, except for its problem and its method.
TRAINING = ("model", "optimizer", "schedule", "stepper", "averaging", "sampler", "trainer", "certificate")
EVERYONE = tuple(f"{kind}_{m}" for kind in ("kernel", "network") for m in METHODS) + ("sac", "ppo")
# CPU seconds of a kernel method where no time is given, and no contender ran before it.
UNHURRIED = 30.0


def contender(name: str, config: dict, problem: Problem, constants: Constants):
    """The contender ``name``, one of `EVERYONE`. Raises `InputError` for a wrong field or what the problem cannot have."""
    kind, _, method = require_choice("contenders", name, EVERYONE).partition("_")
    if kind == "network":
        methods = require_section("methods", config["methods"])
        groups = {"problem": config["problem"], "method": methods[method], **{g: config[g] for g in TRAINING}}
        made = NetworkContender(groups)
        build_trainer({**made.config, "seed": 0})  # a wrong field is refused now, not after an hour
        return made
    if kind == "kernel":
        options = dict(config["kernel"])
        step = options.pop("step").get(method)
        return call(KernelContender, "kernel", options, method=method, problem=problem, constants=constants, step=step)
    require_rl()
    options = dict(config["rl"])
    steps = options.pop("steps").get(name)
    bound = problem.control_bound if problem.control_bound is not None else constants.C_u
    return call(RLContender, "rl", options, name=name, problem=problem, control_bound=1.2 * bound, steps=steps)


class Contest:
    """A contest: its contenders, their problem, and the settings of the final certificates. Kernel methods and judge use the
    constants of a run whose bounds are null. Raises `InputError` for a wrong field."""

    def __init__(self, config: dict) -> None:
        self.problem = build_problem(config["problem"])
        self.fields = {name: value for name, value in config["problem"].items() if name != "_target_"}
        torch.set_num_threads(1)
        self.constants = resolve_constants(self.problem)
        names, seeds = config["contenders"], config["seeds"]
        self.beside = read_beside(config["beside"])
        self.gap = require_number("equal_gap", config["equal_gap"], above=0.0)
        if not isinstance(names, list) or not (names or self.beside):
            raise InputError(f"contenders is {names!r}, but must be a list of {', '.join(EVERYONE)}.")
        if not isinstance(seeds, list) or not seeds:
            raise InputError(f"seeds is {seeds!r}, but must be a list of whole numbers, as in [0,1,2].")
        self.seeds = [require_integer("seeds", seed, 0) for seed in seeds]
        if not self.problem.driftless and "kernel_primal" in names:
            log.info("kernel_primal is left out: Lemma 2 needs a problem without drift.")
            names = [name for name in names if name != "kernel_primal"]
        _require_numbers(config)
        self.contenders = [contender(name, config, self.problem, self.constants) for name in names]
        training = fill({group: config[group] for group in TRAINING}, self.problem)
        self.certificate = build_certificate_settings(training)
        require_possible(self.problem, self.certificate)

    def run(self, folder: Path) -> list[Curve]:
        """Run every contender with every seed, and save the results so far after each run. The pictures also show the
        families of `beside`, alone if there is no contender.

        A kernel method without a time of its own gets that of the longest run before it, for a comparison at equal time.
        """
        folder.mkdir(parents=True, exist_ok=True)
        judge = Judge(self.problem, self.constants)
        curves: list[Curve] = []
        with tqdm(total=len(self.contenders) * len(self.seeds), unit="run", disable=None) as bar:
            for one in self.contenders:
                if isinstance(one, KernelContender) and one.seconds is None:
                    one = replace(one, seconds=max((c.points[-1].seconds for c in curves), default=UNHURRIED))
                for seed in self.seeds:
                    bar.set_postfix_str(f"{one.name}, seed {seed}")
                    curves.append(one.run(seed, judge, self.certificate))
                    self._family(curves).write(folder)
                    bar.update()
        families = joined([*([self._family(curves)] if curves else []), *self.beside])
        text = tables(families, self.gap)
        write_atomically(folder / "benchmark.md", lambda path: path.write_text(text + "\n"))
        save(drawn(pictures(families, self.gap)), folder)
        log.info("\n%s\n\nwritten to %s", text, folder)
        return curves

    def _family(self, curves: list[Curve]) -> Family:
        problem = self.problem
        return Family(problem_name(problem), problem.dim, self.fields, problem.exact_optimum, curves, versions())


def _require_numbers(config: dict) -> None:
    """Check the fields of all contenders, also of those that do not run."""
    kernel, rl = (require_section(name, config[name]) for name in ("kernel", "rl"))
    for method, step in require_section("kernel.step", kernel.get("step")).items():
        require_number(f"kernel.step.{require_choice('kernel.step', method, METHODS)}", step, above=0.0)
    for name in ("time_step", "horizon"):
        require_number(f"rl.{name}", rl.get(name), above=0.0)
    for algorithm, steps in require_section("rl.steps", rl.get("steps")).items():
        require_integer(f"rl.steps.{algorithm}", steps, 1)
