"""From a resolved configuration to contenders, and all of them run one after the other."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm import tqdm

from ocp_torch.certificate import CertificateSettings
from ocp_torch.certificate.settings import require_possible
from ocp_torch.errors import InputError, call, require_choice, require_integer, require_number, require_section
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants, resolve_constants
from ocp_torch.runs.build import build_certificate_settings, build_problem, build_trainer
from ocp_torch.studies.benchmark.curve import Curve
from ocp_torch.studies.benchmark.kernels import KernelContender
from ocp_torch.studies.benchmark.measure import Judge
from ocp_torch.studies.benchmark.networks import NetworkContender
from ocp_torch.studies.benchmark.report import plot, save
from ocp_torch.studies.benchmark.require import require_rl
from ocp_torch.studies.benchmark.rl import RLContender
from ocp_torch.training.budgets import fill

log = logging.getLogger(__name__)

METHODS = ("dual", "primal", "pd")
# The groups of a training configuration, beside its problem and its method.
TRAINING = ("model", "optimizer", "schedule", "stepper", "averaging", "sampler", "trainer", "certificate")
EVERYONE = tuple(f"{kind}_{m}" for kind in ("kernel", "network") for m in METHODS) + ("sac", "ppo")
# CPU seconds of a kernel method where no time is given, and nobody ran before it.
UNHURRIED = 30.0


def contender(name: str, config: dict, problem: Problem, constants: Constants):
    """The contender ``name``, one of `EVERYONE`. Raises `InputError` for a wrong field or what the problem cannot have."""
    kind, _, method = require_choice("contenders", name, EVERYONE).partition("_")
    if kind == "kernel":
        options = require_section("kernel", config["kernel"])
        steps = require_section("kernel.step", options.pop("step", None))
        given = dict(method=method, problem=problem, constants=constants, step=steps.get(method))
        return call(KernelContender, "kernel", options, **given)
    if kind == "network":
        methods = require_section("methods", config["methods"])
        training = {group: config[group] for group in TRAINING}
        made = NetworkContender({"problem": config["problem"], "method": methods[method], **training})
        build_trainer({**made.config, "seed": 0})  # a wrong field is refused now, not after an hour
        return made
    require_rl()
    options = require_section("rl", config["rl"])
    steps = require_section("rl.steps", options.pop("steps", None))
    bound = problem.control_bound if problem.control_bound is not None else constants.C_u
    reach = min(1.2 * bound, problem.control_limit or math.inf)
    given = dict(
        algorithm=name,
        problem=problem,
        control_bound=reach,
        steps=steps.get(name),
    )
    return call(RLContender, "rl", options, **given)


@dataclass(frozen=True)
class Contest:
    """Who runs on what, and how the end of each is certified."""

    problem: Problem
    constants: Constants
    contenders: list
    seeds: list[int]
    certificate: CertificateSettings


def build(config: dict) -> Contest:
    """Everything a contest needs; kernel methods and judge use the bounds a run with null bounds would."""
    problem = build_problem(config["problem"])
    torch.set_num_threads(1)
    constants = resolve_constants(problem)
    names, seeds = config["contenders"], config["seeds"]
    if not isinstance(names, list) or not names:
        raise InputError(f"contenders is {names!r}, but must be a list of {', '.join(EVERYONE)}.")
    if not isinstance(seeds, list) or not seeds:
        raise InputError(f"seeds is {seeds!r}, but must be a list of whole numbers, as in [0,1,2].")
    seeds = [require_integer("seeds", seed, 0) for seed in seeds]
    if not problem.driftless and "kernel_primal" in names:
        log.info("kernel_primal is left out: Lemma 2 needs a problem without drift.")
        names = [name for name in names if name != "kernel_primal"]
    _require_numbers(config)
    made = [contender(name, config, problem, constants) for name in names]
    training = {group: config[group] for group in TRAINING}
    certificate = build_certificate_settings(fill(training, problem))
    require_possible(problem, certificate)
    return Contest(problem, constants, made, seeds, certificate)


def _require_numbers(config: dict) -> None:
    """Fields of contenders that may not be among those named: a wrong one is refused all the same."""
    kernel, rl = (require_section(name, config[name]) for name in ("kernel", "rl"))
    for method, step in require_section("kernel.step", kernel.get("step")).items():
        require_number(f"kernel.step.{require_choice('kernel.step', method, METHODS)}", step, above=0.0)
    for name in ("time_step", "horizon"):
        require_number(f"rl.{name}", rl.get(name), above=0.0)
    for algorithm, steps in require_section("rl.steps", rl.get("steps")).items():
        require_integer(f"rl.steps.{algorithm}", steps, 1)


def contest(made: Contest, folder: Path, say: Callable[[str], None] = log.info) -> list[Curve]:
    """Run everyone with every seed; what is there so far is saved after each run.

    A kernel method without a time of its own gets that of the longest run before it: they are compared at equal time.
    """
    contenders, seeds, exact = made.contenders, made.seeds, made.problem.exact_optimum
    judge = Judge(made.problem, made.constants)
    curves: list[Curve] = []
    with tqdm(total=len(contenders) * len(seeds), unit="run", disable=None) as bar:
        for one in contenders:
            if isinstance(one, KernelContender):
                one = one.in_time(max((c.points[-1].seconds for c in curves), default=UNHURRIED))
            for seed in seeds:
                bar.set_postfix_str(f"{one.name}, seed {seed}")
                curves.append(one.run(seed, judge, made.certificate))
                text = save(curves, exact, folder)
                bar.update()
    plot(curves, exact).savefig(folder / "benchmark.png", dpi=130)
    say(f"\n{text}\n\nwritten to {folder}")
    return curves
