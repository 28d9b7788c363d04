"""What to do about each warning that a run may leave."""

FRESH = "It cannot change at a resume: start a new run with it."
WITHOUT_M = "Nothing, where the bound `shifted` is there and narrow: it needs no `M`."
# Words of a warning, as in the code that warns -> what to do about it. The first entry that fits is used.
ADVICE = {
    "nothing is certified:": "Look at what the problem declares of itself, then at its functions: one of them is not so.",
    "bounds contradicted each other": "Nothing, unless it is said of the end too: it was so at that step.",
    "a guess to train with": f"{WITHOUT_M} Else give `method.occupation_bound` if you know one. {FRESH}",
    "C_V is not known": f"Nothing, unless you need `J`: then set `method.value_bound`; `sup f` will do. {FRESH}",
    "C_u is not known": "Nothing: no bound rests on it. `problem.control_limit` makes it known where there is a limit.",
    "is not known": f"Set the field that it names, if you know a value. {FRESH}",
    "is below this problem's sup mu*": f"Set a larger `method.occupation_bound`, or leave it out. {FRESH}",
    "F_M is a bound only if": f"{WITHOUT_M} Else give an `M` that you know as `method.occupation_bound`. {FRESH}",
    "so no M": f"{WITHOUT_M} A larger `M` does not help: noise in every direction would bound the density. Recorded samples "
    "have no `shifted`, but a model that is fitted to them has: see the guide.",
    "F_M is not used": f"{WITHOUT_M} Else set a larger `method.occupation_bound`, if there is one. {FRESH}",
    "G bounds OPT, but not": "Nothing: another bound speaks of the controller.",
    "and G are not used: the controller's value": f"Nothing, where there is a Lagrangian bound. Else set "
    f"`method.value_bound` above the value it names. {FRESH}",
    "J and G are not used: the state cost falls to": "Add a constant to the state cost, so that it is at least 0: all "
    "values grow by as much.",
    "beyond C_u": f"Set `problem.control_limit` if the control must not, else `method.control_bound`. {FRESH}",
    "J and the Lagrangian bound are not used": "Smooth what jumps over a short distance.",
    "where a coordinate passes from 1 to 0": "Make the function it names periodic, or smooth it over a short distance.",
    "no bound is used": "Correct the function it names; until then no number means anything.",
    "outside the box of": "Widen the interval of the coordinate it names, or make leaving it dearer by `failure_cost`.",
    "a few sampled states carry": "Evaluate again with more states (`certificate.points`).",
    "that of the best constant V": "Train longer (`trainer.steps`): nothing was learned that counts.",
    "worse than doing nothing": "Do not use this controller. Train longer, or begin with `warm_start.mode=on`.",
    "this run diverges": "Start again with a smaller `optimizer.lr`, or set `stepper.clip`.",
    "handed out are the averaged fields": "Change what the sentence names and resume, or start again.",
    "the numbers are those of the quick evaluation": "Correct what failed in the problem, then evaluate again.",
    "it is not so that": "Nothing: the guess is dropped, and the rest stands.",
    "mu is 0 at sampled states": "Trust the controller from `V`, or the Lagrangian bound.",
    "is not finite; it is left out": "Nothing, where another controller is there; else train with a smaller `optimizer.lr`.",
    "held-out samples, taken for": "Nothing, if samples were drawn like that; else record the density that they have.",
    "is not the divergence of its": "Put the columns in one order and unit; smooth what jumps over a short distance.",
    "has nothing to do with x": "Put the rows of all columns in one order; record more where it varies fast.",
    "as x has few digits": "Record states with more digits.",
    "no independent draws": "Record states that are drawn independently of each other, each of them once.",
    "at the state of another, and are left out": "Nothing: the others are used.",
    "by the samples met, bounds its value": "Nothing, if the recording covers the states that matter; else record more.",
    "B varies over the samples, so": "Train with `method=pd`: its controller is `w / mu`.",
    "no upper bound: the recording holds no": "Record the columns that it names.",
    "no rigorous lower bound": "Nothing: the sampled bounds stand.",
    "the J shown is that of the closed loop": "Nothing.",
}
OTHERWISE = "Nothing, where the gap is good enough; else see the README on what the numbers assume."


def advice(warning: str) -> str:
    """What to do about ``warning``."""
    return next((what for words, what in ADVICE.items() if words in warning), OTHERWISE)
