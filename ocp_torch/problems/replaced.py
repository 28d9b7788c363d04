"""Functions that a user has put in the place of a base class's: in a class, or on the object itself."""


def replaced(owner: object, name: str, *kinds: type) -> bool:
    """Whether ``owner`` has another function ``name`` than each of the base classes ``kinds`` has."""
    return name in vars(owner) or all(getattr(type(owner), name) is not getattr(kind, name) for kind in kinds)
