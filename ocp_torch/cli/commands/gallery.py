"""Train shipped systems one after the other, and show them on one page."""

import logging
import shlex
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from ocp_torch.cli.asked import data_of, flat, plain
from ocp_torch.cli.command import Command
from ocp_torch.cli.explain import CONFIGS, INSTALLED, choices
from ocp_torch.cli.job import isolated
from ocp_torch.cli.python import train
from ocp_torch.cli.single import require_writable, told
from ocp_torch.errors import InputError, require_choice, require_section, shown
from ocp_torch.problems import Problem
from ocp_torch.problems.commands import as_typed
from ocp_torch.runs.report.gallery import Exhibit, save_gallery, seconds_in
from ocp_torch.runs.run import training_run
from ocp_torch.training.checkpoint import LAST

log = logging.getLogger(__name__)
TRAIN = ["ocp-train"] if INSTALLED else ["python", "scripts/train.py"]
# Fields that the gallery sets itself.
OWN = {"problem", "problem._target_", "resume"}


@dataclass(frozen=True)
class Planned:
    """A system that passed its check: the ``fields`` of its run by dotted names, and the ``problem`` they make."""

    name: str
    fields: dict[str, Any]
    problem: Problem

    @property
    def command(self) -> str:
        """The command that trains this system alone."""
        given = {"problem": self.name, **self.fields}
        return shlex.join([*TRAIN, *(f"{name}={as_typed(plain(name, value))}" for name, value in given.items())])


def planned(data: dict) -> list[Planned]:
    """The systems of the plain configuration ``data``, each built once. Raises `InputError`; writes nothing."""
    known, names, folder = choices("problem"), data["systems"], Path(str(data["folder"]))
    if not isinstance(names, list) or not names or len({*map(str, names)}) < len(names):
        raise InputError(f"systems is {shown(names)}, but must be a list of different names, as in [circle,pendulum].")
    for name in names:
        require_choice("a name in systems", name, known)
    own = require_section("overrides", data["overrides"])
    given = {require_choice("a name in overrides", name, known): fields(f"overrides.{name}", own[name]) for name in own}
    # Those of `gallery.yaml` itself stand there for whoever lists their system.
    usual: Any = OmegaConf.to_container(OmegaConf.load(CONFIGS / "gallery.yaml"), resolve=False)
    for name in given:
        if name not in names and own[name] != usual["overrides"].get(name):
            raise InputError(f"overrides.{name} is set, but {name} is not in systems, {shown(names)}; add it there.")
    common = {name: value for name, value in fields("common", data["common"]).items() if value is not None}
    require_writable(folder, "folder")
    seconds_in(folder)
    return [_built(name, given.get(name, {}) | common, folder) for name in names]


def fields(name: str, section: object) -> dict[str, Any]:
    """The fields that the ``section`` ``name`` of the gallery sets, by dotted names. Raises `InputError`."""
    found = flat(require_section(name, section))
    for field in found.keys() & OWN:
        raise InputError(f"{name}.{field} is set, but the gallery does that itself; leave it out.")
    return found


def _built(name: str, own: dict[str, Any], folder: Path) -> Planned:
    try:
        with isolated(), told():
            settings = own | ({"resume": str(folder / name)} if _begun(folder / name) else {})
            return Planned(name, own, training_run(data_of("train", name, {}, settings)).trainer.problem)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _begun(place: Path) -> bool:
    return (place / "checkpoints" / LAST).exists()


def shown_all(systems: list[Planned], folder: Path) -> None:
    """Train ``systems``, each in a folder of its own in ``folder``, or resume the runs there; `gallery.html` is written
    before the first and after each. Raises `InputError` at the end where some failed."""
    seconds, failed, page = seconds_in(folder), dict[str, str](), folder / "gallery.html"
    log.info("to look at: %s; where this is stopped, folder=%s goes on", page, folder)

    def save() -> None:
        exhibits = [Exhibit(s.name, s.problem, folder / s.name, s.command, failed.get(s.name)) for s in systems]
        save_gallery(exhibits, seconds, page)

    save()
    for k, system in enumerate(systems):
        log.info("\n%s, %d of %d: %s", system.name, k + 1, len(systems), system.command)
        place, started, worked = folder / system.name, time.perf_counter(), True
        where: dict[str, Any] = {"resume": place} if _begun(place) else {"folder": place}
        try:
            worked = bool(train(system.name, settings=system.fields, **where).history.looks)
        except Exception as error:  # whatever failed, go on with the other systems
            log.debug("%s", traceback.format_exc())
            failed[system.name] = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            log.warning("error: %s: %s", system.name, failed[system.name])
        finally:
            if worked:  # a run that was finished before keeps its time
                seconds[system.name] = seconds.get(system.name, 0.0) + time.perf_counter() - started
            save()
    log.info("\nto look at: %s", page)
    if failed:
        raise InputError(f"{len(failed)} of {len(systems)} systems failed: {', '.join(failed)}; {page} says why.")


main = Command("gallery", planned, shown_all)
