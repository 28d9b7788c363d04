"""What a user is told to type: values as Hydra reads them back, and the arguments that name a problem again."""

from __future__ import annotations

import re

from ocp_torch.errors import InputError

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
    text = str(value).replace("\\", "\\\\").replace("'", "\\'")
    return f"'{text}'"


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
    own = {name: value for name, value in section.items() if name != "_target_" and str(name).isidentifier()}
    named = target if TARGET.fullmatch(target) else UNKNOWN
    return [f"{mark}problem._target_={named}", *(f"{mark}problem.{k}={as_typed(v)}" for k, v in own.items())]


def made_by(section: dict) -> str:
    """The same as Python: ``Pendula(coupling=0.2)``."""
    name = str(section.get("_target_")).rpartition(".")[2]
    own = {k: v for k, v in section.items() if k != "_target_" and str(k).isidentifier()}
    arguments = ", ".join(f"{k}={v!r}" for k, v in own.items())
    return f"{name if name.isidentifier() and name != 'None' else 'MyProblem'}({arguments})"
