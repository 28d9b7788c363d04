"""Units as labels: products and quotients of symbols everybody knows. Nothing is converted."""

import re

from ocp_torch.errors import InputError, shown

# Units of mechanics, electricity and heat that may have a prefix: those of SI and a few more.
SI = "m g t s A K mol rad Hz N Pa J W C V F Ohm S Wb T H L bar eV".split()
PREFIXES = ("", *"n u m c d k M G".split())
# Other units in common use, without prefixes.
OTHERS = "deg turn rev rpm min h d day wk yr kg degC % ppm dB EUR USD 1".split()
SYMBOLS = {prefix + unit for prefix in PREFIXES for unit in SI} | set(OTHERS)
# Full turns, by the unit of an angle.
TURN = 6.283185307179586
TURNS = {"rad": TURN, "deg": 360.0, "turn": 1.0, "rev": 1.0}
WRITTEN = str.maketrans({"²": "2", "³": "3", "·": " ", "*": " ", "Ω": "Ohm", "µ": "u", "μ": "u", "°": "deg"})


def require_unit(name: str, unit: object) -> str:
    """``unit`` if it reads as one, as in rad/s, m/s^2, N m or 1; raises `InputError`, naming the field ``name``, if not."""
    if not isinstance(unit, str) or len(unit) > 40 or not unit.isprintable():
        raise InputError(f"{name} is {shown(unit)}, but must be a unit such as rad/s, m/s^2, N m, or '' for none.")
    for term in re.split(r"[ /]+", unit.translate(WRITTEN).strip(" ()")):
        symbol = re.fullmatch(r"\(?([A-Za-z%]+|1)\^?\(?(-?\d)?(\.5)?\)*", term)
        if term and not (symbol and symbol[1] in SYMBOLS):
            raise InputError(
                f"{name} is {shown(unit)}, of which {shown(term)} is no unit known here; write it with symbols such as m, s, "
                "kg, N, V, A, Hz, rad and deg, as in rad/s, m/s^2 or N m, or '' for none; another may "
                "stand in the name, as in 'queue (cars)'."
            )
    return unit


def labelled(name: str, unit: str) -> str:
    """``pole [rad]``, or the bare name where there is no unit."""
    return f"{name} [{unit}]" if unit else name
