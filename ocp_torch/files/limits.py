"""What a file may ask of the machine by itself. More than this only the user may: on the command line, or in Python."""

from __future__ import annotations

from collections.abc import Collection

from ocp_torch.errors import InputError

# Whole numbers and lengths of lists among a problem's arguments; `seed` is but a name.
MOST_OF_A_PROBLEM, LONGEST_LIST = 128, 256
# Dotted field of a run -> its largest value: some sixteen times a default.
MOST = {
    "trainer.steps": 2**24,
    "trainer.batch": 2**16,
    "trainer.threads": 64,
    "trainer.keep": 100,
    "certificate.points": 2**18,
    "certificate.replicates": 64,
    "certificate.trajectories": 2**13,
    "certificate.ascents": 2**10,
    "certificate.occupation_states": 2**12,
    "certificate.stage.steps": 2**14,
    "certificate.stage.rounds": 4,
    "certificate.stage.batch": 2**13,
}
LEAST = {"certificate.tolerance": 1e-9}


def require_modest_problem(source: object, parameters: dict, remedy: str) -> None:
    """Raise `InputError` where ``parameters``, as the file ``source`` has them, make too large a problem."""
    for name, value in parameters.items():
        _require_modest(source, name, value, remedy)


def _require_modest(source: object, name: str, value: object, remedy: str) -> None:
    if isinstance(value, list | tuple):
        if len(value) > LONGEST_LIST:
            raise InputError(f"{source} asks for problem.{name} of {len(value):,} entries; {remedy}.")
        for one in value:
            if isinstance(one, list | tuple):
                _require_modest(source, name, one, remedy)
    elif isinstance(value, int) and value > MOST_OF_A_PROBLEM and name != "seed":
        raise InputError(
            f"{source} asks for problem.{name} = {value:,}, and up to {MOST_OF_A_PROBLEM} is believed of a file; {remedy}."
        )


def require_modest_run(source: object, config: dict, named: Collection[str] = frozenset()) -> None:
    """Raise `InputError` where the plain ``config`` that the file ``source`` holds asks for too much of anything but what
    the command line ``named``."""
    for field, limit in {**MOST, **LEAST}.items():
        value: object = config
        for key in field.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if not isinstance(value, int | float) or field in named:
            continue
        if not (value >= limit if field in LEAST else value <= limit):
            bound = "at least" if field in LEAST else "up to"
            raise InputError(
                f"{source} asks for {field} = {value}, and {bound} {limit:,} is believed of a file; give {field}={value} "
                "yourself if you want that."
            )


def require_held(source: object, model: object, numbers: int) -> None:
    """Raise `InputError` where networks as ``model`` describes have more weights than the ``numbers`` the file holds."""
    if not isinstance(model, dict):
        return
    sizes = {name: model.get(name) for name in ("width", "depth", "modes", "waves")}
    width, depth, modes, waves = (v if isinstance(v, int) and v > 0 else 1 for v in sizes.values())
    if max(width**2 * (depth - 1), 2 * (modes + waves - 1) * width) > numbers:
        raise InputError(f"{source} describes larger networks ({sizes}) than it holds the weights of.")
