"""A certificate, as `certificate.json` holds it, as a table for the terminal and in words."""

import math
from collections.abc import Sequence

from ocp_torch.certificate import bounds
from ocp_torch.certificate.bounds.bound import LOWER, PERFORMANCE, UPPER
from ocp_torch.certificate.settings import LONGEST_NAME
from ocp_torch.errors import visible

WIDE = 1.0  # gaps above this are written as a multiple, not in per cent
# Where the largest number is outside this range eight decimals would show too few or too many digits.
DECIMALS = (1e-3, 1e4)
# What the controllers of a run are called in sentences.
CONTROLLERS = {
    "value": "controller from V",
    "density": "controller w / mu",
    "minimised": "controller w / mu, mu of Lemma 2",
    "trajectories": "controller from V of trajectories",
    "subsolution": "controller from V trained on for its bound",
    "given": "this controller",
}
# What the table calls the trained ones, in the order of its rows.
ROWS = {
    "value": "controller from V",
    "density": "controller w/mu",
    "minimised": "w/mu, mu of Lemma 2",
    "trajectories": "from trajectories",
    "subsolution": "from V trained on",
}


def the_controller(name: str) -> str:
    """What sentences call the controller ``name``."""
    return CONTROLLERS[name] if name == "given" else f"the {CONTROLLERS.get(name, name)}"


def _form(numbers: Sequence[float]) -> str:
    """How the table writes its ``numbers``: with eight decimals, or with eight digits where the largest is small or long."""
    largest = max((abs(number) for number in numbers if math.isfinite(number)), default=1.0)
    return "14.8f" if DECIMALS[0] <= largest < DECIMALS[1] else "14.7e"


def table(certificate: dict, searches: Sequence[str] = ()) -> str:
    """The certificate (as a dict of its schema) for the terminal: what it comes to, the numbers as a table, and how its
    suprema were found."""
    name = lambda key: visible(certificate[key], LONGEST_NAME)
    title = f"{name('problem')} / {name('method')}, seed {certificate['seed']}"
    covered = f"± {100.0 * certificate['confidence']:.6g} %" if "confidence" in certificate else "± se"
    header = f"{'':26}{'value':>14}{covered:>11}{'of it bias':>11}" + (
        f"{'vs OPT':>12}" if certificate["exact"] else ""
    )
    rule = "-" * len(header)
    warnings = [f"warning: {warning}" for warning in dict.fromkeys(map(visible, certificate["warnings"]))]
    numbers = [header, rule, *_rows(certificate), rule]
    return "\n".join([title, *in_words(certificate), "", *numbers, *_gaps(certificate), *searches, *warnings])


def _rows(certificate: dict) -> list[str]:
    """The numbers of ``certificate``, from below to above, a line each."""
    exact, perf = certificate["exact"], certificate["perf"]
    form = _form([e["value"] for side in (LOWER, "perf", UPPER) for e in certificate[side].values() if e])

    def row(label: str, estimate: dict | None) -> list[str]:
        if estimate is None:
            return []
        bias = f"{estimate['bias']:11.1e}" if "bias" in estimate else " " * 11
        against = _against(estimate["value"] / exact) if exact else ""
        half = estimate["interval"][1] - estimate["value"] if "interval" in estimate else estimate["se"]
        return [f"{label:26}{estimate['value']:{form}}{half:11.1e}{bias}{against}"]

    def of_side(side: str) -> list[list[str]]:
        found = [(listed.label, certificate[side].get(kind)) for kind, listed in bounds.on(side).items()]
        return [row(f"{side}: {label}{_standing(estimate)}", estimate) for label, estimate in found]

    least = [
        row(f"Perf, at least: {visible(kind, LONGEST_NAME)}", e) for kind, e in certificate.get(PERFORMANCE, {}).items()
    ]
    trained = [row(f"Perf: {label}", perf.get(kind)) for kind, label in ROWS.items()]
    parts = [
        *of_side(LOWER),
        [] if exact is None else [f"{'OPT (exact)':26}{exact:{form}}"],
        *trained,
        *least,
        row("Perf: this controller", perf.get("given")),
        *reversed(of_side(UPPER)),  # the sharper ones stand late in the list
        row("Perf: doing nothing", certificate["baseline"]["zero"]),
    ]
    return [line for part in parts for line in part]


def _standing(estimate: dict | None) -> str:
    """What a row says behind a bound that does not count."""
    if estimate is None or estimate.get("counts", True):
        return ""
    return ", if" if "if" in estimate else ", not used"


def _gaps(certificate: dict) -> list[str]:
    """The gaps between the numbers of ``certificate`` in sentences, and the part of time outside the box."""
    gap, share, lines = certificate["gap"], certificate["share"], []
    for kind in ("certified", "simulated"):
        if gap[kind] is not None:
            had = share[kind] is not None and share[kind] > 0.0
            part = f", {100 * share[kind]:.2f}% of the gain over doing nothing" if had else ""
            lines.append(f"gap, {kind}: {gap_in_words(gap[kind])}{part}")
    for other, found in gap.get("certified_of", {}).items():
        if found is not None and other != certificate["controller"]:
            lines.append(f"gap, certified, of {the_controller(other)}: {gap_in_words(found)}")
    if gap.get("conditional") is not None:
        guesses = dict.fromkeys(visible(b["if"]) for b in certificate["lower"].values() if b and "if" in b)
        lines.append(f"gap, if {' and '.join(guesses)}: {gap_in_words(gap['conditional'])}, which rests on a guess")
    if (outside := certificate.get("outside_box")) is not None:
        half = min(outside["interval"][1] - outside["value"], 1.0)
        time = f"{100.0 * outside['value']:.3g} % of the discounted time (+- {100.0 * half:.3g})"
        lines.append(f"outside the box: {time}")
    return lines


def gap_in_words(gap: float) -> str:
    """A relative gap in per cent, or, where that would mean nothing, how many times the lower bound the upper one is."""
    return f"{100.0 * gap:.4f}%" if gap <= WIDE else f"the upper side is {1.0 + gap:.3g} times the lower one"


def _against(ratio: float) -> str:
    """How far a number is from `OPT`, by their ``ratio``, in the width of its column."""
    return f"{100.0 * (ratio - 1.0):+11.4f}%" if abs(ratio - 1.0) <= WIDE else f"{f'{ratio:.3g} times':>12}"


def in_words(certificate: dict) -> list[str]:
    """The sub-optimality of the controller as a sentence, if there is anything to say."""
    found = certificate.get("suboptimality") or {}
    percent = lambda x: f"{100.0 * x:.3g} %"
    least, most = found.get("at_least"), found.get("at_most")
    parts = [f"at most {percent(most)}"] if most is not None else []
    if least:
        parts.append(f"at least {percent(least)}")
    if parts:
        parts = [f"the controller is {' and '.join(parts)} worse than the optimum ({taking(certificate)})"]
    return parts + holding(certificate)


def holding(certificate: dict) -> list[str]:
    """How long the controller holds each control, and which numbers are not of it: a sentence, or none."""
    held = certificate.get("held_for")
    if held is None:
        return []
    how = (
        "J, the Lagrangian bound and the density that M is held against are of another one, which acts at every instant"
    )
    return [f"the controller holds each control for {held:.3g} units of time, and is simulated so; {how}"]


def taking(certificate: dict) -> str:
    """How sure the sentence on sub-optimality is, and what else it takes."""
    found = certificate.get("suboptimality") or {}
    taken = "".join(f", taking {sentence}" for sentence in map(visible, found.get("takes", ())))
    return f"{100.0 * certificate['confidence']:.3g} % sure of the sampling{taken}"
