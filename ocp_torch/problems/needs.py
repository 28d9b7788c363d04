"""The assumptions that a bound rests on, and the basis of each: a bound counts only if none of them is guessed."""

from dataclasses import dataclass

GIVEN = "given"  # the problem declares it or the user sets it
PROVED = "proved"  # by a theorem or interval arithmetic
SEARCHED = "searched"  # the largest value that a search of a known function met
GUESSED = "guessed"  # a multiple of something seen, without a reason that it suffices


@dataclass(frozen=True)
class Need:
    """One assumption of a bound: its ``name``, its ``basis``, the ``condition`` in words, and whether it ``holds``, that is
    whether nothing that was checked refutes it."""

    name: str
    basis: str
    condition: str
    holds: bool = True

    @property
    def counts(self) -> bool:
        return self.holds and self.basis != GUESSED

    @property
    def sentence(self) -> str:
        """The assumption as a clause: the condition, marked where it is given."""
        return f"{self.condition}, as given" if self.basis == GIVEN else self.condition
