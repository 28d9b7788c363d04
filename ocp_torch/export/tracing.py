"""A PyTorch function as a graph of ATen operations, autograd's derivatives included, checked against the function itself."""

from collections.abc import Callable

import torch
from torch import Tensor, fx
from torch._decomp import core_aten_decompositions
from torch.fx.experimental.proxy_tensor import make_fx

from ocp_torch.errors import InputError, first_line

# Largest difference of graph and function at other states, relative to the largest number: both compute in float64.
ROUNDING = 1e-9


def traced(function: Callable[[Tensor], dict[str, Tensor]], examples: Tensor) -> tuple[fx.GraphModule, list[str]]:
    """The graph of ``function`` from states to a result for each name, and the names, in the order of its results.

    It is traced on the first of ``examples`` ``(K, d)`` and compared at all of them. Raises `InputError` for functions that
    use NumPy or branch on numbers: the graph would keep the result at that one state.
    """
    wanted = function(examples)  # before tracing, so that results which a problem caches are not traced
    listed = lambda x: tuple(function(x).values())
    try:
        graph = make_fx(listed, decomposition_table=dict(core_aten_decompositions().items()))(examples[:1])
    except Exception as error:  # a problem's functions may do anything that a tracer does not follow
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
