"""Certify any given controller: load it, train a `V` to judge it by, and put both into a certificate."""

import logging
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from ocp_torch.certificate import Certificate, CertificateSettings, Run, certify_policy, in_float64, table
from ocp_torch.certificate.external.black_box import BlackBox, require_limit
from ocp_torch.certificate.external.value import Periodic, require_differentiable
from ocp_torch.certificate.settings import require_possible
from ocp_torch.control.controller import Controller
from ocp_torch.control.described import described, problem_name
from ocp_torch.control.policies import Policy
from ocp_torch.errors import InputError, first_line, require_flag, require_integer
from ocp_torch.fields import Fields, Subsolution
from ocp_torch.fields.fields import VALUE, cost_unit
from ocp_torch.files.storage import write_atomically
from ocp_torch.maths.jets import Field
from ocp_torch.maths.sampling import SAMPLERS, scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import batched
from ocp_torch.objectives import Dual, Phase
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants, resolve_constants
from ocp_torch.problems.problem import shipped
from ocp_torch.runs import canvas, loading
from ocp_torch.runs.build import build_certificate_settings, build_network, build_problem, checked_problem, use_threads
from ocp_torch.runs.figures import interval_figure
from ocp_torch.steppers import advance, short_fit
from ocp_torch.training.batches import Batches
from ocp_torch.training.budgets import fill

log = logging.getLogger(__name__)

# States at which a controller trained under another limit is checked against the problem's.
LIMIT_PROBES = 2**14
# The model of the networks that are trained for a given controller, with its default sizes.
MODEL = {"name": "mlp"}


def certify(
    problem: Problem,
    controller: Callable | Controller,
    value: Field | Controller | None = None,
    settings: CertificateSettings | None = None,
    seed: int = 0,
    train_steps: int | None = None,
) -> Certificate:
    """The certificate of ``controller`` on ``problem``: its cost, and how far from optimal it can be.

    ``controller`` maps states ``(N, d)`` in the unit cell to controls ``(N, m)``: any function of tensors or arrays, or a
    `Controller` of ours. ``value`` is a `V` to judge it by, ``(N, d) -> (N,)`` on the unit cell, continuous there and from 1
    to 0, and differentiable by PyTorch but for kinks (with noise without them), or a `Controller` that holds one; where it is
    `None` one is trained by the dual, for ``train_steps`` (default: by dimension; 0 for none, and then there is no lower
    bound). Raises `InputError` where the problem, the controller or the value fails.
    """
    require_integer("seed", seed, 0)
    if not problem.has_simulator:
        raise InputError(
            "problem is a data set, on which no given controller can be certified: nothing can be simulated."
        )
    defaults = _defaults(checked_problem(problem), {})
    settings = settings or build_certificate_settings(defaults)
    constants = resolve_constants(problem)
    network = build_network(defaults["model"])
    policy = checked_policy(controller, problem)
    steps = defaults["trainer"]["steps"] if train_steps is None else require_integer("train_steps", train_steps, 0)
    steps = 0 if value is not None else steps
    kept = None if value is None else kept_of(value, problem)
    if steps:
        value = in_float64(train_value(problem, constants, network, steps, defaults, seed)).value
    elif value is not None:
        value = value_of(value, problem)
    run = Run(problem_name(problem), "given", seed, steps, steps * defaults["trainer"]["batch"])
    return certify_policy(problem, policy, value, network, constants, settings, run, kept=kept)


def _defaults(problem: Problem, certificate: dict) -> dict:
    """The part of a run's configuration that is needed here, with the defaults of the dimension of ``problem``."""
    return fill({"model": dict(MODEL), "trainer": {}, "optimizer": {}, "certificate": certificate}, problem)


def train_value(
    problem: Problem, constants: Constants, network: Callable[..., nn.Module], steps: int, defaults: dict, seed: int
) -> Fields:
    """A `V` by the dual, with the defaults of a run."""
    fields = Fields.build(problem, (VALUE,), network, derive_seed(seed, Branch.EXTERNAL_VALUE, 0))
    objective = Dual(problem)
    sampler = SAMPLERS[defaults["sampler"]["name"]]
    states = sampler(problem.dim, derive_seed(seed, Branch.EXTERNAL_VALUE, 1), torch.float32)
    batch_seed = derive_seed(seed, Branch.EXTERNAL_VALUE, 2)
    batches = Batches(problem, fields, objective, states, defaults["trainer"]["batch"], batch_seed)
    stepper, average = short_fit(fields, objective, defaults["optimizer"]["lr"], steps, cost_unit(problem))
    try:
        for step in range(steps):
            advance(stepper, average, batches.draw, Phase(constants, step / steps))
    except ArithmeticError as error:
        raise InputError(f"no V can be trained to judge the controller by: {error}.") from None
    return average.module


def checked_policy(controller: Callable | Controller, problem: Problem) -> Policy:
    """The policy of ``controller`` in float64: the networks of a `Controller`, or a `BlackBox` around any function."""
    if not isinstance(controller, Controller):
        return BlackBox(controller, problem)
    if (controller.problem.dim, controller.problem.control_dim) != (problem.dim, problem.control_dim):
        raise InputError(
            f"the controller is for d = {controller.problem.dim} and m = {controller.problem.control_dim}, "
            f"but the problem has d = {problem.dim} and m = {problem.control_dim}."
        )
    policy = controller.policy
    if controller.problem.control_limit != problem.control_limit:  # a controller always obeys its own limit
        x = scrambled_sobol(LIMIT_PROBES, problem.dim, 0, torch.float64)
        with torch.no_grad():
            require_limit(batched(policy, x), x, problem.control_cost)
    return policy


def value_of(value: Field | Controller, problem: Problem) -> Field:
    """`V` in float64: the network of a `Controller`, or any other function on the unit cell, tried at a few states."""
    if isinstance(value, Controller):
        if value.fields.value is None:
            raise InputError("value is a controller without V; give one trained by dual or pd.")
        return in_float64(value.fields).value
    value = in_float64(value) if isinstance(value, nn.Module) else value
    x = torch.full((2, problem.dim), 0.25, dtype=torch.float64)
    try:
        out = value(x)
    except Exception as error:  # whatever a stranger's code may raise
        raise InputError(f"value raised {type(error).__name__}: {first_line(error)}.") from None
    if not isinstance(out, Tensor) or out.shape != (2,) or not bool(torch.isfinite(out).all()):
        shape = tuple(getattr(out, "shape", ()))
        raise InputError(f"value gave {shape} for states (2, {problem.dim}), but must give finite numbers (N,).")
    if shipped(type(value)):
        return value
    value = Periodic(value)
    require_differentiable(value, problem)
    return value


def kept_of(value: Field | Controller, problem: Problem) -> Subsolution | None:
    """The subsolution of the controller ``value``, where it was trained for this very ``problem``; else `None`."""
    if not isinstance(value, Controller) or value.fields.subsolution is None:
        return None
    return in_float64(value.fields.subsolution) if described(value.problem) == described(problem) else None


def arguments(config: dict) -> dict:
    """The arguments of `certify` from the plain ``config`` of the command line, which alone may name code to run."""
    use_threads(1)
    problem = build_problem(config["problem"])
    settings = build_certificate_settings(_defaults(problem, config["certificate"]))
    train = require_flag("train", config["train"])
    if config["steps"] is not None:
        require_integer("steps", config["steps"], 1)
    require_possible(problem, settings, trains_value=False)  # a given controller's bounds are not proved
    controller = loading.load_policy(config["controller"], problem)
    checked_policy(controller, problem)
    return {
        "problem": problem,
        "controller": controller,
        "value": None if config["value"] is None else loading.load_saved(Path(str(config["value"])), problem),
        "settings": settings,
        "seed": require_integer("seed", config["seed"], 0),
        "train_steps": config["steps"] if train else 0,
    }


def certify_in(given: dict, folder: Path) -> Certificate:
    """Certify what `arguments` gave, print the table, and write `certificate.json` and its figure to ``folder``."""
    certificate = certify(**given)
    write_atomically(folder / "certificate.json", certificate.save)
    canvas.save(canvas.drawn({"certificate": interval_figure(certificate.to_dict())}), folder / "figures")
    log.info("\n%s", table(certificate.to_dict(), certificate.searches))
    log.info("in %s", folder)
    return certificate
