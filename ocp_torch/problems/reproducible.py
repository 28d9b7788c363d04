"""Objects that can be made again from their arguments, which checkpoints and saved controllers keep of a problem."""

import inspect


class Reproducible:
    """Remembers its arguments, so that ``type(x)(**x.parameters)`` makes an object ``x`` again."""

    # Arguments whose attributes of the same name hold something else.
    not_arguments: tuple[str, ...] = ()
    _given: tuple[tuple, dict]  # what `__init__` was called with

    def __init_subclass__(cls, **options) -> None:
        """Give the class the signature of its `__init__`, own or inherited: Python 3.10 would show that of `__new__`."""
        super().__init_subclass__(**options)
        first, *rest = inspect.signature(cls.__init__).parameters.values()
        cls.__signature__ = inspect.Signature(rest)  # type: ignore[attr-defined]

    def __new__(cls, *args, **kwargs) -> "Reproducible":
        made = super().__new__(cls)
        made._given = args, kwargs
        return made

    @property
    def parameters(self) -> dict:
        """The arguments that make this object again: each `__init__` argument is read from the object's own attribute of its
        name, or, where there is none (a method or a property may have that name), is what was given."""
        signature, (args, kwargs) = inspect.signature(type(self).__init__), self._given
        bound = signature.bind(self, *args, **kwargs)
        bound.apply_defaults()
        found = dict(list(bound.arguments.items())[1:])
        for name in (n for n, p in signature.parameters.items() if p.kind is p.VAR_KEYWORD):
            found |= found.pop(name)
        kept = {name: value for name, value in vars(self).items() if name not in self.not_arguments}
        return {name: kept.get(name, value) for name, value in found.items()}
