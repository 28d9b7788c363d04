"""What a bound rests on, and where each of those things comes from: only what is not guessed makes a bound count."""

from dataclasses import dataclass

# The problem declares it or the user sets it; a theorem or interval arithmetic shows it; the largest value that a search of
# a known function met; a multiple of something seen, which nothing ties to what it stands for.
GIVEN, PROVED, SEARCHED, GUESSED = "given", "proved", "searched", "guessed"


@dataclass(frozen=True)
class Need:
    """One thing a bound rests on: its ``name``, where it comes from (``basis``), what it says (``condition``), and whether
    it ``holds``, that is whether it was held against what could refute it, and stands."""

    name: str
    basis: str
    condition: str
    holds: bool = True

    @property
    def counts(self) -> bool:
        return self.holds and self.basis != GUESSED

    @property
    def sentence(self) -> str:
        """As one takes it who believes the bound."""
        return f"{self.condition}, as given" if self.basis == GIVEN else self.condition
