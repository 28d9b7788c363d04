"""Names of problems: in commands that users are told to type, and in files of earlier versions."""

import re
from typing import Any

from ocp_torch import problems
from ocp_torch.errors import InputError

PACKAGE = "ocp_torch.problems"
# Class in an earlier version -> class now.
RENAMED = {"Callable": "Simulator"}
# A word that Hydra reads as it stands, without quotes.
UNQUOTED = re.compile(r"(?!(?:null|true|false|nan|inf)$)[A-Za-z_/][\w./:@-]*", re.IGNORECASE)
# The dotted name of a class, and what stands for one that is not known.
TARGET = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")
UNKNOWN = "my_module.MyProblem"
# Characters of a value that are shown.
LONGEST = 500


class ForeignProblem(InputError):
    """A file belongs to a problem of a user's own, which only the user may name; ``arguments`` are what a command lacks."""

    def __init__(self, sentence: str, arguments: list[str]) -> None:
        super().__init__(sentence)
        self.arguments = arguments


def quoted(value: object) -> str:
    """A value in quotes, so that Hydra reads it back whatever characters it holds."""
    return "'" + str(value).replace("\\", "\\\\").replace("'", "\\'") + "'"


def as_typed(value: object) -> str:
    """A plain value as an override has it after the equals sign, without characters that a terminal should not print."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{as_typed(k)}:{as_typed(v)}" for k, v in value.items()) + "}"
    if isinstance(value, int | float):
        return repr(value)
    text = "".join(c if c.isprintable() else "?" for c in str(value)[:LONGEST])
    return text if UNQUOTED.fullmatch(text) else quoted(text)


def naming(section: dict, mark: str = "+") -> list[str]:
    """The overrides that make the problem of ``section``, the problem part of a run's configuration, again."""
    target = str(section.get("_target_"))
    named = target if TARGET.fullmatch(target) else UNKNOWN
    own = [f"{mark}problem.{name}={as_typed(value)}" for name, value in _arguments(section).items()]
    return [f"{mark}problem._target_={named}", *own]


def made_by(section: dict) -> str:
    """The problem of ``section`` as Python: ``Pendula(coupling=0.2)``."""
    name = str(section.get("_target_")).rpartition(".")[2]
    arguments = ", ".join(f"{k}={v!r}" for k, v in _arguments(section).items())
    return f"{name if name.isidentifier() and name != 'None' else 'MyProblem'}({arguments})"


def _arguments(section: dict) -> dict:
    return {name: value for name, value in section.items() if name != "_target_" and str(name).isidentifier()}


def current_target(target: Any) -> Any:
    """The present name of the class ``target``, from a configuration of any version: classes of the package have had other
    names and modules. Anything else comes back unchanged."""
    package, _, name = str(target).rpartition(".")
    now = RENAMED.get(name, name)
    ours = package == PACKAGE or package.startswith(f"{PACKAGE}.")
    return f"{PACKAGE}.{now}" if ours and now in problems.__all__ else target


def current_section(section: Any) -> Any:
    """``section``, the problem part of a configuration, with its `current_target`; unchanged where it names none."""
    if not isinstance(section, dict) or "_target_" not in section:
        return section
    return {**section, "_target_": current_target(section["_target_"])}


def current_name(name: object, section: object) -> object:
    """The present name of the problem of ``section``, which was saved under ``name``."""
    target = str(section.get("_target_")) if isinstance(section, dict) else ""
    cls = target.rpartition(".")[2]
    renamed = cls in RENAMED and current_target(target) != target
    return RENAMED[cls].lower() if renamed and name == cls.lower() else name
