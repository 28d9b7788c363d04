"""A check of arguments that several problems share: lists of numbers."""

from collections.abc import Sequence

from ocp_torch.errors import InputError, require_number, shown


def require_numbers(name: str, value: object, count: int | None = None, above: float | None = None) -> list[float]:
    """``value`` as a list of finite floats, ``count`` of them and each ``above`` a number where given; else `InputError`."""
    if isinstance(value, str) or not isinstance(value, Sequence) or (count is not None and len(value) != count):
        wanted = "a list of" + (f" {count}" if count is not None else "") + " numbers"
        raise InputError(f"{name} is {shown(value)}, but must be {wanted}.")
    return [require_number(f"{name}[{i}]", v, above=above) for i, v in enumerate(value)]
