"""Functions that ONNX runtimes lack in double precision, composed of those that they have."""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

# Entries per unit of the table of the error function: from an entry to `x` Gauss's rule is off by less than 3e-12.
PLACES = 32
# End of the table: the error function is 1 in double precision there.
FAR = 6.0
# Offset of the two points of Gauss's rule from the middle of an interval, as a part of its length.
GAUSS = 0.5 / math.sqrt(3.0)


class Nodes(Protocol):
    """The writer of a graph: ``node`` adds a node, ``number`` and ``table`` a constant; each returns its name."""

    def node(self, kind: str, inputs: list[str], output: str | None = None, **options: object) -> str: ...

    def number(self, value: float) -> str: ...

    def table(self, values: np.ndarray) -> str: ...

    def cast(self, name: str, kind: str) -> str: ...


def erf(graph: Nodes, x: str) -> str:
    """`erf x = erf x_0 + 2 / sqrt(pi) int_{x_0}^x e^{-s^2} ds`, `x_0` the nearest tabulated place."""
    node, number = graph.node, graph.number
    x = node("Min", [node("Max", [x, number(-FAR)]), number(FAR)])
    place = node("Floor", [node("Add", [node("Mul", [x, number(PLACES)]), number(0.5)])])
    start = node("Mul", [place, number(1.0 / PLACES)])
    way = node("Sub", [x, start])
    known_place = node("Where", [node("Equal", [place, place]), place, number(0.0)])  # NaN is no row of the table
    row = graph.cast(node("Add", [known_place, number(PLACES * FAR)]), "INT64")
    known = node("Gather", [graph.table(_table()), row], axis=0)
    heights = []
    for part in (0.5 - GAUSS, 0.5 + GAUSS):
        at = node("Add", [start, node("Mul", [way, number(part)])])
        heights.append(node("Exp", [node("Neg", [node("Mul", [at, at])])]))
    area = node("Mul", [way, node("Add", heights)])
    return node("Add", [known, node("Mul", [area, number(1.0 / math.sqrt(math.pi))])])


def _table() -> np.ndarray:
    reach = round(PLACES * FAR)
    return np.array([math.erf(k / PLACES) for k in range(-reach, reach + 1)])


def cos(graph: Nodes, x: str) -> str:
    """`cos x = 1 - 2 sin^2(x / 2)`: some runtimes have the sine in double precision, but not the cosine."""
    half = graph.node("Sin", [graph.node("Mul", [x, graph.number(0.5)])])
    twice = graph.node("Mul", [graph.node("Mul", [half, half]), graph.number(2.0)])
    return graph.node("Sub", [graph.number(1.0), twice])


def atan(graph: Nodes, x: str) -> str:
    """`atan x`: in single precision first, then a Newton step `y - (tan y - x) cos^2 y`."""
    node = graph.node
    y = _single(graph, "Atan", x)
    sine, cosine = node("Sin", [y]), cos(graph, y)
    off = node("Sub", [sine, node("Mul", [x, cosine])])
    return node("Sub", [y, node("Mul", [off, cosine])])


def asin(graph: Nodes, x: str) -> str:
    """`asin x = 2 atan(x / (1 + sqrt((1 - x) (1 + x))))`, which loses no digits near 1 and -1."""
    node, one = graph.node, graph.number(1.0)
    root = node("Sqrt", [node("Mul", [node("Sub", [one, x]), node("Add", [one, x])])])
    return node("Mul", [graph.number(2.0), atan(graph, node("Div", [x, node("Add", [one, root])]))])


def acos(graph: Nodes, x: str) -> str:
    return graph.node("Sub", [graph.number(0.5 * math.pi), asin(graph, x)])


def tan(graph: Nodes, x: str) -> str:
    return graph.node("Div", [graph.node("Sin", [x]), cos(graph, x)])


def sinh(graph: Nodes, x: str) -> str:
    return _hyperbolic(graph, x, "Sub")


def cosh(graph: Nodes, x: str) -> str:
    return _hyperbolic(graph, x, "Add")


def _hyperbolic(graph: Nodes, x: str, kind: str) -> str:
    up, down = graph.node("Exp", [x]), graph.node("Exp", [graph.node("Neg", [x])])
    return graph.node("Mul", [graph.node(kind, [up, down]), graph.number(0.5)])


def _single(graph: Nodes, kind: str, x: str) -> str:
    return graph.cast(graph.node(kind, [graph.cast(x, "FLOAT")]), "DOUBLE")


COMPOSED: dict[str, Callable[[Nodes, str], str]] = {
    "cos": cos, "erf": erf, "atan": atan, "asin": asin, "acos": acos, "tan": tan, "sinh": sinh, "cosh": cosh,
}  # fmt: skip
