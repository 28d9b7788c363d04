"""How problems are named: in what a user is told to type, and by the files of earlier versions."""

import re
from typing import Any

from ocp_torch import problems
from ocp_torch.errors import InputError

PACKAGE = "ocp_torch.problems"
# Class in an earlier version -> class now.
RENAMED = {"Callable": "Simulator"}
# What Hydra takes for a word as it stands.
PLAIN = re.compile(r"(?!(?:null|true|false|nan|inf)$)[A-Za-z_/][\w./:@-]*", re.IGNORECASE)
TARGET = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")
LONGEST = 500
UNKNOWN = "my_module.MyProblem"


class ForeignProblem(InputError):
    """A file is of a problem that only a user can name; ``arguments`` are what a command lacks."""

    def __init__(self, sentence: str, arguments: list[str]) -> None:
        super().__init__(sentence)
        self.arguments = arguments


def quoted(value: object) -> str:
    """A value as Hydra reads it back, whatever signs it holds."""
    return "'" + str(value).replace("\\", "\\\\").replace("'", "\\'") + "'"


def as_typed(value: object) -> str:
    """A plain value as an override has it after the equals sign; what no terminal should be shown is left out."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{as_typed(k)}:{as_typed(v)}" for k, v in value.items()) + "}"
    if isinstance(value, int | float):
        return repr(value)
    text = "".join(c if c.isprintable() else "?" for c in str(value)[:LONGEST])
    return text if PLAIN.fullmatch(text) else quoted(text)


def naming(section: dict, mark: str = "+") -> list[str]:
    """The overrides that make the problem of ``section``, a run's own, again."""
    target = str(section.get("_target_"))
    named = target if TARGET.fullmatch(target) else UNKNOWN
    own = [f"{mark}problem.{name}={as_typed(value)}" for name, value in _arguments(section).items()]
    return [f"{mark}problem._target_={named}", *own]


def made_by(section: dict) -> str:
    """The same as Python: ``Pendula(coupling=0.2)``."""
    name = str(section.get("_target_")).rpartition(".")[2]
    arguments = ", ".join(f"{k}={v!r}" for k, v in _arguments(section).items())
    return f"{name if name.isidentifier() and name != 'None' else 'MyProblem'}({arguments})"


def _arguments(section: dict) -> dict:
    return {name: value for name, value in section.items() if name != "_target_" and str(name).isidentifier()}


def current_target(target: Any) -> Any:
    """The class that ``target``, of a configuration of any version, names now: classes of the package have had other names
    and lain in other modules of it. Anything else comes back as it is."""
    package, _, name = str(target).rpartition(".")
    now = RENAMED.get(name, name)
    ours = package == PACKAGE or package.startswith(f"{PACKAGE}.")
    return f"{PACKAGE}.{now}" if ours and now in problems.__all__ else target


def current_section(section: Any) -> Any:
    """``section``, the problem of a configuration, with its `current_target`; as it is where it names none."""
    if not isinstance(section, dict) or "_target_" not in section:
        return section
    return {**section, "_target_": current_target(section["_target_"])}


def current_name(name: object, section: object) -> object:
    """The name by which the problem of ``section``, saved under ``name``, goes now."""
    target = str(section.get("_target_")) if isinstance(section, dict) else ""
    cls = target.rpartition(".")[2]
    renamed = cls in RENAMED and current_target(target) != target
    return RENAMED[cls].lower() if renamed and name == cls.lower() else name
