"""The first sentence of a report: how far from optimal the controller can be at most, or why that is not known."""

import math

from ocp_torch.certificate.report import WIDE, in_words, taking
from ocp_torch.runs.report.words import NEEDS, number, percent, sentence


def certified(certificate: dict) -> bool:
    """Whether the certificate bounds how far from optimal the controller is, by a gap of at most `WIDE`."""
    found = _at_most(certificate)
    return certificate["contradiction"] is None and found is not None and found[0] <= WIDE


def lead(certificate: dict) -> str:
    """The first sentence of the report on ``certificate``; that of the terminal where it bounds the controller's cost."""
    if certificate["contradiction"] is not None:
        return sentence(str(certificate["contradiction"]))
    said, found = in_words(certificate), _at_most(certificate)
    if found is None:
        nothing = f"nothing is certified of how far from optimal the controller is: {_why(certificate)}"
        return " ".join(map(sentence, [nothing, *said]))
    most, taken = found
    if most > WIDE:
        times = f"{math.ceil(10.0 * (1.0 + most)) / 10.0:,g}"
        return sentence(f"hardly anything is certified: the controller may cost {times} times the optimum ({taken})")
    simulated = _simulated(certificate) is not None
    return sentence(
        said[0] if simulated else f"the controller is at most {percent(most)} worse than the optimum ({taken})"
    )


def _at_most(certificate: dict) -> tuple[float, str] | None:
    """How much more than the optimum the controller costs at most, relative to the optimum, and the assumptions in words: by
    simulation, or without one by the bounds alone."""
    simulated, proved = _simulated(certificate), certificate["gap"]["certified"]
    if simulated is not None:
        return number(simulated), taking(certificate)
    if proved is None:
        return None
    bounds = [certificate[side].get(certificate["gap"][f"{side}_from"]) or {} for side in ("lower", "upper")]
    needs = dict.fromkeys(str(name) for bound in bounds for name in bound.get("rests_on", {}))
    taken = "".join(f", taking that {NEEDS.get(name, name)}" for name in needs).replace("`", "")
    return number(
        proved
    ), f"nothing is simulated, each bound {percent(certificate['confidence'])} sure of the sampling{taken}"


def _simulated(certificate: dict):
    return (certificate.get("suboptimality") or {}).get("at_most")


def _why(certificate: dict) -> str:
    """The reason, in words, why nothing is certified."""
    gap, lower = certificate["gap"], certificate["lower"]
    if not any(lower.values()):
        return "there is no lower bound on the optimum, as without a V; methods dual and pd train one"
    if gap["lower_from"] is None:
        return "no lower bound on the optimum counts"
    if number(lower[gap["lower_from"]]["value"]) <= 0.0:
        return "the lower bound on the optimum is not above 0, so that nothing can be said relative to it"
    if gap["upper_from"] is not None:
        return "its bounds cross, though by less than would refute one of them"
    return "there is no upper bound that counts, and no simulation"
