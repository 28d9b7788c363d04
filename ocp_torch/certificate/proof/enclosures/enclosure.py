"""Models of a problem's data over a batch of cells, and who gives them for a class of problems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ocp_torch.certificate.proof.taylor import TaylorModel

DATA = ("state_cost", "drift", "control_matrix", "initial_density")


@dataclass(frozen=True)
class Enclosure:
    """Models over `N` cells; ``a`` is `None` where there is no drift."""

    f: TaylorModel  # (N,)
    a: TaylorModel | None  # (N, d)
    B: TaylorModel  # (N, d, m)
    mu0: TaylorModel  # (N,)


class ByClass:
    """A function of an object and an argument, given by a ``method`` of the object's own class or registered for a class.

    The most derived class that gives it counts. What it gives is about the methods ``about`` of the object, so it is
    not to be believed where a class further down changes one of those.
    """

    def __init__(self, method: str, about: tuple[str, ...]) -> None:
        self.method, self.about = method, about
        self._registered: dict[type, Callable] = {}
        self._always: set[type] = set()

    def register(self, cls: type, always: bool = False) -> Callable[[Callable], Callable]:
        """Decorator: the function gives it for ``cls``; ``always`` where it follows whatever a subclass changes."""

        def keep(function: Callable) -> Callable:
            self._registered[cls] = function
            if always:
                self._always.add(cls)
            return function

        return keep

    def source(self, owner: object) -> tuple[type, Callable] | None:
        """The class that gives it for ``owner``, and how; `None` where no class does."""
        if self.method in vars(owner):
            return type(owner), getattr(owner, self.method)
        for cls in type(owner).__mro__:
            if self.method in vars(cls):
                return cls, getattr(owner, self.method)
            if cls in self._registered:
                return cls, lambda argument, cls=cls: self._registered[cls](owner, argument)
        return None

    def holds_for(self, owner: object) -> bool:
        """Whether it is given, and neither ``owner`` nor a class below the one that gives it changes what it is about."""
        found = self.source(owner)
        if found is None:
            return False
        line = type(owner).__mro__
        below = [vars(owner), *(vars(cls) for cls in line[: line.index(found[0])])]
        return found[0] in self._always or not any(name in names for names in below for name in self.about)

    def __call__(self, owner: object, argument: Any) -> Any:
        found = self.source(owner)
        if found is None:
            raise TypeError(f"{type(owner).__name__} gives no {self.method}.")
        return found[1](argument)


# enclosure(problem, box): an `Enclosure` of the data of ``problem`` over the cells of ``box``, or `None` where it has none.
enclosure = ByClass("enclosure", DATA)
# conjugate_model(cost, p): `R*(p)` ``(N,)`` for a model `p` ``(N, m)``.
conjugate_model = ByClass("conjugate_model", ("conjugate",))
