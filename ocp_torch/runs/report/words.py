"""Sentences of a report on a certificate: which number to trust, what each bound is, and what it rests on."""

from ocp_torch.certificate import bounds
from ocp_torch.certificate.bounds.bound import LOWER, UPPER
from ocp_torch.certificate.report import CONTROLLERS, WIDE, holding
from ocp_torch.problems.needs import GIVEN, GUESSED, PROVED, SEARCHED
from ocp_torch.runs.compare import number

# A certified gap up to this, or up to so many times the simulated one, is narrow enough to judge the controller by.
NARROW = 0.01
NARROW_TIMES = 2.0
# Names of bounds, of their assumptions and of the basis of these -> their meaning.
BOUNDS = {
    "F_M": "the dual value of `V`, each violation of its inequality charged `M` times; needs no controller",
    "shifted": "`E[V mu0]` less the largest violation of the inequality of `V`; needs neither a controller nor an `M`",
    "rigorous": "the shifted bound with its supremum proved by interval arithmetic",
    "J": "the cost of `(w, mu)`, each violation of the equation of `mu` charged `C_V` times",
    "G": "`J` with the best `mu` for each `w`, in closed form",
    "lagrangian": "the controller's own Bellman equation, weighed by its occupation density; nothing is simulated",
    "evaluation": "`E[V mu0]` and the largest violation of the controller's own Bellman equation",
}
NEEDS = {
    "M": "`M` is at least `sup mu*`, the largest density of where an optimal controller spends its discounted time",
    "C_V": "`C_V` is at least the largest cost from any state on",
    "f": "the state cost `f` is nowhere negative",
    "regular": "neither `a`, `B` nor the controller jumps",
    "sup Q": "no state violates the inequality of `V` by more than the worst that was found",
    "sup |Q_u|": "no state violates the controller's Bellman equation by more than the worst that was found",
}
BASES = {
    GIVEN: "the problem declares it, or the user did; nothing that was observed speaks against it",
    PROVED: "by a theorem or interval arithmetic",
    SEARCHED: "the largest value that samples and local ascents met: an estimate from below, which more effort may raise",
    GUESSED: "a multiple of something seen; what rests on it enters no gap that counts",
}


def percent(part) -> str:
    return f"{100.0 * number(part):.3g} %"


def label(side: str, name: str) -> str:
    """The label of the entry ``name`` on a ``side`` of a certificate."""
    if side == "perf":
        return f"Perf: {CONTROLLERS.get(name, name)}"
    listed = bounds.on(side).get(name)
    named = listed.label if listed else name
    return {LOWER: f"{named} ≤ OPT", UPPER: f"Perf ≤ {named}"}.get(side, named)


def sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:].rstrip('.')}."


def trust(certificate: dict) -> list[str]:
    """Sentences on which number to trust, and why."""
    gap, found = certificate["gap"], list[str]()
    sides = {side: label(side, str(gap[f"{side}_from"])) for side in (LOWER, UPPER) if gap[f"{side}_from"]}
    proved, seen = gap["certified"], gap["simulated"]
    if certificate["contradiction"] is not None:
        return ["Trust none of the numbers below until the contradiction is resolved: one of them is wrong."]
    if proved is not None and number(proved) > WIDE:
        found.append(
            f"The bounds without simulation are far apart: `{sides[UPPER]}` is {1.0 + proved:.2g} times `{sides[LOWER]}`."
        )
    elif proved is not None:
        found.append(
            f"The certified gap, {percent(proved)}, lies between `{sides[LOWER]}` and `{sides[UPPER]}`. Both are averages "
            "over sampled states: no trajectory is simulated."
        )
    if seen is not None:
        found.append(
            f"The simulated gap, {percent(seen)}, lies between `{sides[LOWER]}` and the cost of simulated trajectories: as "
            "good as the simulation, whose time steps were halved until they no longer mattered."
        )
    if proved is not None and seen is not None:
        wide = number(proved) > max(NARROW, NARROW_TIMES * number(seen))
        found.append(
            "Trust the simulated one: the certified one is true, but says little of this controller."
            if wide
            else "Trust the certified one: it takes less on trust, and is narrow."
        )
    if not found:
        found.append("There is no gap: each number of the table stands for itself alone.")
    if gap.get("conditional") is not None:
        guesses = [str(b["if"]) for b in certificate["lower"].values() if b and "if" in b]
        told = " and ".join(dict.fromkeys(guesses)) or "a guess is right"
        found.append(
            f"If {told}, the gap is {percent(gap['conditional'])}: a guess, so rely on it only if you know that."
        )
    if (exact := certificate["exact"]) is not None and number(exact) > 0.0:
        found.append(
            f"The optimum of this problem is known, {exact:.8g}: the table says how far each number is from it."
        )
    shares = [number(s) for s in certificate["share"].values() if s is not None]
    if shares:
        had = f"{100.0 * max(shares):.4g} % of what control can gain over doing nothing is certainly had."
        found.append(
            had if max(shares) > 0.0 else "It is not certain that the controller gains anything over doing nothing."
        )
    found += map(sentence, holding(certificate))
    if (outside := certificate.get("outside_box")) is not None:
        found.append(
            f"{percent(outside['value'])} of the discounted time is spent outside the box, where the model ends."
        )
    return found
