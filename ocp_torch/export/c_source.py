"""A `Program` as C99: a header and a source without dependencies or allocation, in double or in float.

Numbers that single precision holds exactly, such as the weights of a network, are stored in it: half of the memory, and the
same function.
"""

import json
import math
import textwrap
from string import Template

import numpy as np

from ocp_torch.export.c_function import Function, number
from ocp_torch.export.program import Program

# Numbers in a line of an array.
NUMBERS = 8
# Characters in a line of a string.
CHARACTERS = 100

HEADER = Template("""\
/* $name: exported by ocp_torch.
 *
 * $about
 * Stack: $space numbers; nothing is allocated. Fastest with gcc -O3 -march=native -ffast-math -fno-finite-math-only.
 * A state that is NaN gives NaN in all results; -ffast-math alone would lose that, and is refused. Compile both files alike:
 *   (no flag)        states and results are doubles
 *   -D${NAME}_FLOAT   they are floats; what is between is computed in double, so that results are off by their rounding alone
 *   -D${NAME}_SINGLE  all is computed in float, for processors without doubles; results are off by some 1e-5 of the most for
 *                    angles within a turn of their centre, and by as much again for each turn beyond */
#ifndef ${NAME}_H
#define ${NAME}_H

#if defined(${NAME}_FLOAT) || defined(${NAME}_SINGLE)
typedef float ${name}_real;
#else
typedef double ${name}_real;
#endif

$declarations

/* Certificate, units and configuration, as JSON. */
extern const char ${name}_metadata[];

#endif
""")
SOURCE = Template("""\
#include "$name.h"

#include <tgmath.h>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "a state that is NaN would give a control like any other: add -fno-finite-math-only after -ffast-math"
#endif

#ifdef ${NAME}_SINGLE
typedef float real;
#else
typedef double real;
#endif
#define R(number) ((real)(number))
#define OUT(number) ((${name}_real)(number))
/* Unlike fmax and fmin, which drop a NaN. */
#define MAX(a, b) ((a) > (b) || (a) != (a) ? (a) : (b))
#define MIN(a, b) ((a) < (b) || (a) != (a) ? (a) : (b))

$constants

$functions
const char ${name}_metadata[] =
$metadata;
""")


def c_source(programs: dict[str, Program], name: str, about: str, metadata: dict) -> tuple[str, str]:
    """Header and source, with a function for each of ``programs``, which writes its outputs. All names in them begin with
    ``name``; ``about`` is a text for readers, ``metadata`` is kept as a string."""
    functions = [Function(program, name, function) for function, program in programs.items()]
    pool: dict[bytes, str] = {}
    bodies = [function.definition(pool) for function in functions]
    text = json.dumps(metadata)
    pieces = (text[k : k + CHARACTERS] for k in range(0, len(text), CHARACTERS))
    parts = dict(
        name=name,
        NAME=name.upper(),
        about="\n * ".join(textwrap.wrap(about.replace("*/", "* /"), 110)),
        space=max(function.space + function.program.dim for function in functions),
        declarations="\n".join(f"{function.signature};" for function in functions),
        constants="\n".join(_array(label, np.frombuffer(numbers)) for numbers, label in pool.items()),
        functions="\n".join(bodies),
        metadata="\n".join(f"    {_quoted(piece)}" for piece in pieces),
    )
    return HEADER.substitute(parts), SOURCE.substitute(parts)


def _array(label: str, numbers: np.ndarray) -> str:
    exact = [_exactly(value) for value in numbers.tolist()]
    lines = (", ".join(exact[k : k + NUMBERS]) for k in range(0, len(exact), NUMBERS))
    with np.errstate(over="ignore"):
        kind = "float" if np.array_equal(numbers.astype(np.float32), numbers, equal_nan=True) else "real"
    return f"static const {kind} {label}[{len(exact)}] = {{\n    " + ",\n    ".join(lines) + "\n};"


def _exactly(value: float) -> str:
    """``value`` as a hexadecimal literal: shorter than all decimals of a number in single precision, and exact."""
    if not math.isfinite(value):
        return number(value)
    digits, exponent = value.hex().split("p")
    return f"{digits.rstrip('0').rstrip('.') if '.' in digits else digits}p{exponent}"


def _quoted(text: str) -> str:
    # The second replacement keeps a compiler from reading trigraphs.
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("?", "\\?") + '"'
