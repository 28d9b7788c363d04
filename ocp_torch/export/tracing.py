"""A PyTorch function as a graph of ATen operations, derivatives by autograd included, held against the function itself."""

from collections.abc import Callable

import torch
from torch import Tensor, fx
from torch._decomp import core_aten_decompositions
from torch.fx.experimental.proxy_tensor import make_fx

from ocp_torch.errors import InputError, first_line

# How far the graph may be off the function at other states, relative to its largest number: both compute in float64.
ROUNDING = 1e-9


def traced(function: Callable[[Tensor], dict[str, Tensor]], examples: Tensor) -> tuple[fx.GraphModule, list[str]]:
    """The graph of ``function`` from states to a result for each name, and the names, in the order of its results.

    It is traced on the first of ``examples`` ``(K, d)``. Raises `InputError` for what is not of PyTorch's operations alone,
    as NumPy or a branch: a number that went another way would stand in the graph as it was at that one state.
    """
    wanted = function(examples)  # what a problem computes once is no part of it
    listed = lambda x: tuple(function(x).values())
    try:
        graph = make_fx(listed, decomposition_table=dict(core_aten_decompositions().items()))(examples[:1])
    except Exception as error:  # whatever the functions of a problem do that a tracer does not follow
        raise InputError(f"this controller cannot be exported, as it cannot be traced: {first_line(error)}.") from None
    graph.graph.eliminate_dead_code()
    found = zip(*(graph(x) for x in examples.split(1)), strict=True)
    for (name, value), parts in zip(wanted.items(), found, strict=True):
        if not bool((torch.cat(parts) - value).abs().max() <= ROUNDING * value.abs().max().clamp_min(1.0)):
            raise InputError(
                f"this controller cannot be exported: its {name} is not what was traced at other states, as where a function "
                "of the problem goes through NumPy, or branches on numbers."
            )
    return graph, list(wanted)
