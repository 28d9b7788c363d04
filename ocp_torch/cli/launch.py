"""The entry of all commands: a command is checked before anything is written, and mistakes are told in one sentence."""

import gc
import logging
import os
import shlex
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from torch.optim import Optimizer

from ocp_torch.cli.assist import assist
from ocp_torch.cli.compose import configuration, parsed, register_resolvers, run_data, with_own_defaults
from ocp_torch.cli.explain import explain, is_choice
from ocp_torch.cli.help import help_text
from ocp_torch.cli.outcome import INTERRUPTED, Record, fail, failures, show, typed
from ocp_torch.cli.single import carry_out, checked, require_places_to_write
from ocp_torch.compute.processes import FirstProcessLeft, LostError, joined
from ocp_torch.errors import InputError, require_flag, require_section, shown
from ocp_torch.files.reading import require_unlinked
from ocp_torch.problems.commands import ForeignProblem
from ocp_torch.training.stopping import Preempted

HELP = ("--help", "-h")
ASKS = ("--info", "-i", "--cfg", "-c", "--hydra-help", "--version", "--shell-completion", "-sc")
# Options of Hydra that take a value.
HYDRAS = ("--info", "--cfg", "--package", "--config-path", "--config-name", "--config-dir", "--experimental-rerun")
SWEEPS = ("-m", "--multirun", "hydra.mode=MULTIRUN")
SHARED = ("train",)  # commands that the processes of torchrun can share
ONE_RUN = (
    "the processes of torchrun share a single run of train; give no sweep and no other options, or leave torchrun out."
)
MOST_TRIED = 8  # jobs of a sweep that are tried for one value
# Optimiser methods that PyTorch's compiler skips: the first optimiser imports the compiler to tell it so, in 1.3 s of CPU.
NOT_COMPILED = ("add_param_group", "state_dict", "load_state_dict", "zero_grad")
# Modules that `pytorch_optimizer` can do without, and whose import takes 0.5 s of CPU.
DISTRIBUTED = ("torch.distributed.tensor", "torch.distributed._tensor")


def launch(entry: Callable, config_name: str, check: Callable[[dict], object], work: Callable[..., object]) -> None:
    """Run the command line: ``work(check(data), folder)``, where ``data`` is the composed configuration ``config_name``.

    ``check`` refuses mistakes, and builds what ``work`` needs, before any folder is made; a single run works on exactly that.
    Sweeps, and options of Hydra, go through the Hydra ``entry``, which calls `job`. A user's mistake ends in one sentence on
    stderr and exit status 2, a signal in 143 or 130, failed jobs of a sweep in their names and status 2. Of several processes
    that torchrun started all but the first `assist`.
    """
    spare_imports()
    register_resolvers()
    logging.setLogRecordFactory(Record)
    logging.raiseExceptions = False  # a full disk is told once, not at every line of a log
    threading.excepthook = unless_told  # nor by the thread that writes for TensorBoard
    # Users' modules are imported from the current folder, as `python -m` would.
    sys.path.insert(0, os.getcwd())
    command = [*typed(sys.argv[0]), *sys.argv[1:]]
    sys.argv[1:] = with_own_defaults(config_name, sys.argv[1:])
    options = [a for a in sys.argv[1:] if a.startswith("-")]
    overrides = [a for a in sys.argv[1:] if not a.startswith("-")]
    try:
        ranks = joined()
    except FirstProcessLeft:  # the first process has left, and tells why
        sys.exit(0)
    except LostError as error:
        fail(str(error))
    if not ranks.first:
        assist(ranks, lambda: checked(overrides, config_name, check), work)
    try:
        require_no_dashes(options)
        if any(option in HELP for option in options):
            show(help_text(config_name, " ".join(typed(sys.argv[0])), overrides))
        elif any(option.split("=")[0] in ASKS for option in options):
            entry()
        elif ranks.size > 1 and (config_name not in SHARED or options or any(a in SWEEPS for a in overrides)):
            raise InputError(ONE_RUN)
        elif any(a in SWEEPS for a in sys.argv[1:]):
            sweep(entry, config_name, overrides, check)
        elif options:
            checked(overrides, config_name, check)
            entry()
        else:
            carry_out(ranks.alike(lambda: checked(overrides, config_name, check)), work)
    except ForeignProblem as error:
        fail(f"{str(error).rstrip('.')}; if it is yours: {shlex.join([*command, *error.arguments])}")
    except InputError as error:
        fail(str(error))
    except Preempted as stop:
        sys.exit(stop.status)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    finally:
        ranks.leave()


def sweep(entry: Callable, config_name: str, overrides: list[str], check: Callable[[dict], object]) -> None:
    """Check a sweep and run its jobs. Raises `InputError` that names the jobs that failed."""
    require_places_to_write(overrides, "hydra.sweep.dir")
    check_sweep(config_name, overrides, check)
    for root in (o.value() for o in parsed(overrides) if o.key_or_group == "hydra.sweep.dir"):
        require_unlinked(Path(str(root)), "*")
    with failures(elsewhere=any("submitit" in o for o in overrides)) as failed:
        entry()
        names = failed()
    if names:
        raise InputError(f"{len(names)} job(s) of the sweep failed: {'; '.join(names)}.")


def check_sweep(config_name: str, overrides: list[str], check: Callable[[dict], object]) -> None:
    """Raise `InputError` where a value of a swept field does not compose, each tried in one job; or where ``check`` refuses
    all tried jobs with a value of one kind (see `representatives`). Other numbers of the same kind are left to the jobs."""
    try:
        jobs = BasicSweeper.split_arguments(parsed(overrides), None)[0]
    except HydraException as error:
        raise InputError(explain(error, config_name)) from None
    is_hydras = lambda override: override.startswith(("hydra.", "hydra/"))
    defaults: dict[tuple, dict] = {}
    for one in dict.fromkeys(o for each in jobs for o in each):
        first = [o for o in next(each for each in jobs if one in each) if not is_hydras(o)]
        chosen = [o for o in first if is_choice(o) or o.lstrip("+").startswith("problem._target_=")]
        if (key := tuple(chosen)) not in defaults:
            defaults[key] = configuration(config_name, chosen, whole=False)[1]
        require_kinds(configuration(config_name, first)[1], defaults[key])
    ours = [[o for o in each if not is_hydras(o)] for each in jobs]
    for one in representatives(parsed(overrides)):
        refusals: list[InputError] = []
        tried = [each for each in ours if one in each][:MOST_TRIED]
        for each in tried:
            try:
                check(run_data(configuration(config_name, each)[1], each))
                break
            except InputError as error:
                refusals.append(error)
        if tried and len(refusals) == len(tried):
            raise refusals[0]
    # Once for all jobs: Hydra's own settings are the same for each.
    configuration(config_name, [o for o in jobs[0] if is_hydras(o)], whole=False)


def representatives(overrides: list[Override]) -> list[str]:
    """One override for each kind of value that is swept over: for each word, and for numbers of each type and sign."""
    found: dict[tuple, str] = {}
    for override in overrides:  # except fields of the problem and `resume`, which are left to the jobs
        name = override.key_or_group
        if not override.is_sweep_override() or name.startswith(("hydra", "problem.", "resume")) or is_choice(name):
            continue
        for one in BasicSweeper.split_arguments([override], None)[0]:
            value: Any = parsed(one)[0].value()
            number = isinstance(value, int | float) and not isinstance(value, bool)
            found.setdefault((name, type(value), value > 0 if number else str(value)), one[0])
    return list(found.values())


def require_kinds(data: Any, default: Any, name: str = "") -> None:
    """Raise `InputError` where a number, a flag or a group of fields in ``default`` is of another kind in ``data``."""
    if isinstance(default, dict):
        for key in default.keys() & require_section(name, data).keys():
            require_kinds(data[key], default[key], f"{name}.{key}".lstrip("."))
    elif isinstance(default, bool):
        require_flag(name, data)
    elif isinstance(default, int | float) and not (isinstance(data, int | float) and not isinstance(data, bool)):
        raise InputError(f"{name} is {shown(data)}, but must be a number.")


def require_no_dashes(options: list[str]) -> None:
    """Raise `InputError` where a field is written as an option."""
    for option in options:
        name = option.split("=")[0]
        if "=" in option and name not in HYDRAS:
            raise InputError(f"{option} is no option; write {option.lstrip('-')}, without the dashes.")


def unless_told(failed: threading.ExceptHookArgs) -> None:
    """Print what ended a thread, unless it is TensorBoard's, which raises it again in whoever writes next."""
    if not type(failed.thread).__module__.startswith("tensorboard."):
        threading.__excepthook__(failed)


def spare_imports() -> None:
    """Make a command start faster: PyTorch's compiler is imported only when something is compiled, and distributed tensors
    are not for the optimisers. In a PyTorch without these hooks nothing changes. Imported objects are frozen, so that garbage
    collection skips them, which took .3 of the 12 s of a circle."""
    for name in NOT_COMPILED:
        method = getattr(getattr(Optimizer, name, None), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dynamo_disable = method  # `torch._disable_dynamo` looks for this before it imports the compiler
    hidden = [name for name in DISTRIBUTED if name not in sys.modules]
    modules: dict[str, Any] = sys.modules
    modules.update(dict.fromkeys(hidden))  # an import of a module that is None here fails
    try:
        import pytorch_optimizer  # noqa: F401
    finally:
        for name in hidden:
            del sys.modules[name]
    gc.freeze()
