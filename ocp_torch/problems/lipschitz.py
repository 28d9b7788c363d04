"""Lipschitz constants of a problem's data, from which a lower bound can be proved."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Lipschitz:
    """`|g(x) - g(y)| <= L |x - y|`, Euclidean in torus units, for each entry `g` of the data; `None` where `L` is unknown.

    A method that is not overridden needs no constant. Of a `System` all are, and constants are those of its data on the
    torus, with their margins: 0 where something is the same everywhere.
    """

    state_cost: float | None = None
    drift: float | None = None
    control_matrix: float | None = None
    initial_density: float | None = None
    noise: float | None = None
