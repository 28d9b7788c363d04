"""Controllers as they were exported: what they must give, and what the compiled source does."""

from __future__ import annotations

import ctypes
import json
import subprocess

import numpy as np
import torch

from ocp_torch.control.exported import TORUS, exported_function

STATES = 200


def truth(controller, coordinates):
    return exported_function(
        controller.problem, controller.fields, controller.kind, controller.occupation, controller.constants, coordinates
    )


def states_of(controller, coordinates):
    """Whole turns around the cell on the torus; in units also beyond the box."""
    x = (
        4.0
        * torch.rand(STATES, controller.problem.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
        - 2.0
    )
    if coordinates == TORUS:
        return x
    chart = controller.problem.chart
    return chart.centre + 0.4 * x * chart.length


def through_c(folder, name, wanted, states, precision=None, speed="-O1"):
    """What the compiled source gives at ``states``; ``precision`` is null, `FLOAT` or `SINGLE`."""
    library = folder / f"{name}{precision}{speed[:3]}.so"
    flags = [] if precision is None else [f"-D{name.upper()}_{precision}"]
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", *speed.split(), "-shared", "-fPIC"]
    subprocess.run(["gcc", *strict, *flags, "-o", str(library), str(folder / f"{name}.c"), "-lm"], check=True)
    compiled, dtype = ctypes.CDLL(str(library)), np.float64 if precision is None else np.float32
    x = np.ascontiguousarray(states.numpy().astype(dtype))
    got = {key: np.full((len(x), int(np.prod(value.shape[1:]))), np.nan, dtype) for key, value in wanted.items()}
    at = lambda array, i: ctypes.c_void_p(array[i].ctypes.data)
    for i in range(len(x)):
        getattr(compiled, f"{name}_control")(at(x, i), at(got["control"], i))
        if "value" in got:
            getattr(compiled, f"{name}_value")(at(x, i), at(got["value"], i), at(got["gradient"], i))
    metadata = ctypes.string_at(ctypes.addressof((ctypes.c_char * 1).in_dll(compiled, f"{name}_metadata")))
    return got, json.loads(metadata)
