"""The glossary of `--help terms`: the words of tables, reports and fields, for readers who do not know the paper."""

TERMS = {
    "control-affine": (
        "dx = (a(x) + B(x) u) dt + sigma(x) dW: the control u enters linearly, by the matrix B; a is the "
        "drift, what the system does by itself."
    ),
    "torus": (
        "the states x in [0, 1)^d, with both ends of each coordinate joined. Angles live there by nature; "
        "velocities and positions are put on a part of it, their box."
    ),
    "rho, the discount": (
        "costs after t units of time count e^{-rho t}; the objective is multiplied by rho, so that it is an "
        "average of the running cost f + |u|^q / q. 1 / rho is how far ahead the controller looks."
    ),
    "mu0": "the density of the states at which the system starts.",
    "OPT": (
        "the least cost that any controller can have, averaged over mu0. No program knows it, but for "
        "problems made for tests."
    ),
    "V, the value function": (
        "the least cost from each state on, and here a network near it. The controller follows from its gradient."
    ),
    "mu, the occupation density": (
        "where a controlled system spends its discounted time; w = mu u is the control density."
    ),
    "F_M, a lower bound": (
        "OPT is at least this. It needs a V, but no controller, and a number M that no optimal mu exceeds."
    ),
    "shifted, a lower bound": "the same without M: V is lowered until it violates nothing.",
    "J and Lagrangian, upper bounds": (
        "the controller costs at most this; integrals over states, no trajectory is simulated."
    ),
    "Perf": "the cost of the controller by simulation: mean, standard error and bias of the time steps.",
    "gap, certified": (
        "best upper bound against best lower one, relative to the lower, between the far ends of their "
        "intervals. Nothing is simulated."
    ),
    "gap, simulated": "Perf in place of the upper bound: narrower, and as good as the simulation.",
    "gap, conditional": "the gap if a guess of M is right. It counts for nothing unless you know that it is.",
    "share": "the part of what control can gain over doing nothing that is certainly had.",
    "slack": "by how much V violates its inequality, the Hamilton-Jacobi-Bellman equation, at a state.",
    "given, proved, searched, guessed": (
        "how well something that a bound needs is known: declared by the problem or you; by a theorem; the "
        "largest value that was found; a multiple of something seen."
    ),
    "time outside the box": (
        "the part of the discounted time in which a velocity or position is where the model is no longer yours."
    ),
}
