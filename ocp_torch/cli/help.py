"""The text of `--help`: purpose and examples of a command, and every field with its value and meaning."""

import inspect
import json
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from ocp_torch.cli.compose import configuration
from ocp_torch.cli.explain import CONFIGS, choices
from ocp_torch.cli.terms import TERMS
from ocp_torch.errors import InputError
from ocp_torch.problems import Problem
from ocp_torch.problems.problem import shipped
from ocp_torch.runs.build import problem_class

NARROWEST = 60  # characters of a line, on a narrow terminal
WIDEST = 120  # characters of a line, on a wide terminal
BESIDE = 40  # column of the comments; a longer field has its comment below
LAST_WORDS = """\
  -m seed=0,1,2 runs several, one after the other; -m hydra/launcher=joblib side by side
  --help terms explains the words; --cfg job prints the configuration as YAML; --hydra-help is about Hydra itself"""


def help_text(command: str, typed: str, overrides: list[str]) -> str:
    """The help of ``command``, which was ``typed`` with these ``overrides``: groups chosen there show their own fields.

    Raises `InputError` where the overrides cannot be composed.
    """
    if overrides == ["terms"]:
        return "\n\n".join(_filled(f"{term}: {meaning}", "", "    ") for term, meaning in TERMS.items())
    if stray := [o for o in overrides if "=" not in o and not o.startswith("~")]:
        raise InputError(f"--help takes terms, or choices as in --help problem=pendulum, not {stray[0]!r}.")
    config, data = configuration(command, overrides, whole=False)
    file = CONFIGS / f"{command}.yaml"
    taken = config.hydra.runtime.choices
    chosen = {group: taken[group] for group in reversed(list(taken)) if not group.startswith("hydra")}
    known = comments(file)
    for group, choice in chosen.items():
        folder, _, package = group.partition("@")
        if choice not in (None, "null") and folder != "experiment":
            known |= {f"{package or folder}.{k}": c for k, c in comments(CONFIGS / folder / f"{choice}.yaml").items()}
    parts = [header(file).replace(f"python scripts/{command}.py", typed)]
    listed = [(group, choices(group.partition("@")[0]), choice) for group, choice in chosen.items()]
    if listed := [(group, known_ones, choice) for group, known_ones, choice in listed if len(known_ones) > 1]:
        parts.append("Choices (group=choice), and the one taken here:")
        parts.append("\n".join(_filled(f"  {g}={c or 'null'}: {', '.join(of)}", "", "      ") for g, of, c in listed))
    own = data.get("problem") or {}
    if own.get("_target_") and not shipped(cls := problem_class(own["_target_"])):
        data["problem"] = {"_target_": "", **arguments(cls)} | own
        known |= {"problem": line} if (line := first_line(cls)) else {}
    parts.append("Fields (field=value), with their values here:")
    parts.extend(sections(data, known))
    return "\n\n".join([*parts, LAST_WORDS])


def arguments(cls: type[Problem]) -> dict[str, Any]:
    """The arguments of a user's own class ``cls``, with their defaults."""
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    taken = [p for p in inspect.signature(cls).parameters.values() if p.kind in kinds]
    return {p.name: "???" if p.default is p.empty else p.default for p in taken}


def first_line(cls: type) -> str:
    """The first line of the docstring of ``cls``; empty without one."""
    return (cls.__doc__ or "").strip().partition("\n")[0]


def header(file: Path) -> str:
    """The comment at the top of a configuration file: the purpose of the command, then examples."""
    lines = file.read_text(encoding="utf-8").splitlines()
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    return "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines[:first])


def comments(file: Path) -> dict[str, str]:
    """The comments of a YAML file on its fields, by their dotted names: on the field's line, or on a line before it."""
    text = file.read_text(encoding="utf-8")
    lines, found = text.splitlines(), {}
    top = len(header(file).splitlines()) if text.startswith("#") else 0

    def walk(mapping: yaml.MappingNode, prefix: str) -> None:
        for key, value in mapping.value:
            end = (key if isinstance(value, yaml.MappingNode) and not value.flow_style else value).end_mark
            told = lines[end.line][end.column :].partition("#")[2] if end.line < len(lines) else ""
            before = lines[key.start_mark.line - 1].strip() if key.start_mark.line > top else ""
            if told or before.startswith("#"):
                found[f"{prefix}{key.value}"] = (told or before.removeprefix("#")).strip()
            if isinstance(value, yaml.MappingNode):
                walk(value, f"{prefix}{key.value}.")

    tree = yaml.compose(text)
    if isinstance(tree, yaml.MappingNode):
        walk(tree, "")
    return found


def sections(data: dict, known: dict[str, str]) -> Iterator[str]:
    """The fields of each section, with their ``known`` comments; fields of no section come last."""
    alone = {key: value for key, value in data.items() if not isinstance(value, dict) or not value}
    for name, section in ((key, value) for key, value in data.items() if key not in alone):
        told = f"  {known[name]}" if name in known else ""
        own = comments(default) if (default := CONFIGS / name / "default.yaml").is_file() else {}
        yield "\n".join(
            [f"{name}{told}", *rows(section, f"{name}.", {f"{name}.{k}": c for k, c in own.items()} | known)]
        )
    yield "\n".join(rows(alone, "", known))


def rows(section: dict, prefix: str, known: dict[str, str]) -> Iterator[str]:
    for key, value in section.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value:
            if name in known:
                yield _filled(known[name], f"  {name}: ".ljust(BESIDE), " " * BESIDE)
            yield from rows(value, f"{name}.", known)
            continue
        field = f"  {name}={_written(value)}"
        told = known.get(name, "")
        if len(field) < BESIDE:
            yield _filled(told, field.ljust(BESIDE), " " * BESIDE)
        else:
            yield field + (f"\n{_filled(told, ' ' * BESIDE, ' ' * BESIDE)}" if told else "")


def _written(value: Any) -> str:
    """``value`` as it is written on the command line."""
    if isinstance(value, str):
        return "..." if value == "???" else value
    return json.dumps(value, separators=(",", ":"), default=str).replace('"', "")


def _filled(words: str, first: str, rest: str) -> str:
    width = min(WIDEST, max(NARROWEST, shutil.get_terminal_size().columns))
    return (
        textwrap.fill(
            words, width, initial_indent=first, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
        )
        or first.rstrip()
    )
