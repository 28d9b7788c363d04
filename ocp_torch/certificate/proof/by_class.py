"""Functions of an object that its class gives, or that somebody else gives for its class."""

from collections.abc import Callable
from functools import partial
from typing import Any


class ByClass:
    """A function of an object and an argument, given by a ``method`` of the object's own class or registered for a class.

    The most derived class that gives it counts. What it gives is about the methods ``about`` of the object, so it is
    not to be believed where a class further down changes one of those.
    """

    def __init__(self, method: str, about: tuple[str, ...]) -> None:
        self.method, self.about = method, about
        self._registered: dict[type, tuple[Callable, bool]] = {}

    def register(self, cls: type, always: bool = False) -> Callable[[Callable], Callable]:
        """Decorator: the function gives it for ``cls``; ``always`` where it follows whatever a subclass changes."""

        def keep(function: Callable) -> Callable:
            self._registered[cls] = function, always
            return function

        return keep

    def _source(self, owner: object) -> tuple[Callable, bool] | None:
        """How it is given for ``owner``, and whether that is to be believed; `None` where no class gives it."""
        unchanged = not any(name in vars(owner) for name in self.about)
        if self.method in vars(owner):
            return getattr(owner, self.method), unchanged
        for cls in type(owner).__mro__:
            if self.method in vars(cls):
                return getattr(owner, self.method), unchanged
            if cls in self._registered:
                function, always = self._registered[cls]
                return partial(function, owner), always or unchanged
            unchanged = unchanged and not any(name in vars(cls) for name in self.about)
        return None

    def holds_for(self, owner: object) -> bool:
        """Whether it is given, and neither ``owner`` nor a class below the one that gives it changes what it is about."""
        found = self._source(owner)
        return found is not None and found[1]

    def __call__(self, owner: object, argument: Any) -> Any:
        found = self._source(owner)
        if found is None:
            raise TypeError(f"{type(owner).__name__} gives no {self.method}.")
        return found[0](argument)
