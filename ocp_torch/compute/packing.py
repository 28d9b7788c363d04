"""Functions and what they work on, as bytes for another process of the same run."""

import io
import pickle
from typing import Any

import cloudpickle

# The name that stands for the problem, which every process has, and which may hold what cannot be sent.
PROBLEM = "problem"


class Packer(cloudpickle.Pickler):
    """Packs all but ``problem``, of which it leaves the name."""

    def __init__(self, file: io.BytesIO, problem: object) -> None:
        super().__init__(file)
        self.problem = problem

    def persistent_id(self, thing: object) -> str | None:
        return PROBLEM if thing is self.problem and thing is not None else None


class Unpacker(pickle.Unpickler):
    """Puts this process's ``problem`` in the place of the name."""

    def __init__(self, file: io.BytesIO, problem: object) -> None:
        super().__init__(file)
        self.problem = problem

    def persistent_load(self, name: str) -> object:
        return self.problem


def packed(what: object, problem: object) -> bytes:
    """``what``, with lambdas and closures; of ``problem`` the name alone."""
    file = io.BytesIO()
    Packer(file, problem).dump(what)
    return file.getvalue()


def unpacked(these: bytes, problem: object) -> Any:
    """What was `packed` by a process of this run, which is trusted, with this one's ``problem``."""
    return Unpacker(io.BytesIO(these), problem).load()
