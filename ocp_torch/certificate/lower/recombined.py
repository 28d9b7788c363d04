r"""The shifted bound of `V` with its last layer chosen anew, for that bound alone.

For `W = V + sum_k c_k h_k`, with `h_k` the features that the last layer of the network combines, the slack `Q_W` is convex in
`c` at every state (the conjugate `R*` is convex), so that `E[W mu0] - sup Q_W` is concave in `c`: a convex program with one
variable a feature. Training fits the slack on average; here the largest of it counts, at sampled states and at those where
ascents end. The maximum is smoothed (`tau log E exp(Q / tau)`), ever less, and each round adds the states that the last
one's ascents found. What the bound is in the end is measured on other states, as for any `W`.
"""

import math

import torch
from torch import Tensor

from ocp_torch.certificate.lower.shifted import SlackParts, slack_function
from ocp_torch.fields.mlp import PeriodicMLP
from ocp_torch.maths.jets import CHUNK, Field
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import climb
from ocp_torch.problems.generator import Generator, hjb_slack
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# States at most, and numbers kept for them at most (128 MiB of float64).
STATES, NUMBERS = 8192, 2**24
# Rounds, L-BFGS iterations in each, ascents between them, and how much less the maximum is smoothed each time: in two
# dimensions the bound was 2.4 times closer to OPT after four rounds, and 2.8 times after six.
ROUNDS, ITERATIONS, ASCENTS, SHARPER = 5, 60, 128, 0.4
# Directions in which the slack hardly moves, relative to the one in which it moves most, are left alone.
NEGLIGIBLE = 1e-6


class Program:
    """`c -> Q_W` at a growing set of states, in an orthonormal basis of the directions in which it moves."""

    def __init__(self, problem: Problem, value: PeriodicMLP, x: Tensor) -> None:
        self.problem, self.value = problem, value
        self.parts, moved, pushed, gain = self._evaluated(x)
        rows = torch.cat([moved - moved.mean(dim=0), *pushed.unbind(dim=1)]) / math.sqrt(len(x))
        _, sizes, directions = torch.linalg.svd(rows, full_matrices=False)
        kept = sizes > NEGLIGIBLE * sizes[0]
        self.basis = directions[kept].T / sizes[kept]  # (n, k)
        self.moved, self.pushed = moved @ self.basis, pushed @ self.basis
        self.gain = gain @ self.basis  # E[h mu0], per direction

    def _evaluated(self, x: Tensor) -> tuple[SlackParts, Tensor, Tensor, Tensor]:
        """The parts of `Q_V` at ``x``, what each feature adds to their ``value`` and ``push``, and `E[h mu0]` ``(n,)``."""
        problem, rho = self.problem, self.problem.discount
        samples = Samples.of(problem, x, divergences=False)
        generator = Generator.of(problem, samples)
        parts = SlackParts.of(generator, generator.chunked_jet(self.value))
        axes = torch.eye(problem.dim, dtype=x.dtype)
        moved, pushed, features = [], [], []
        for part in samples.split(CHUNK):
            slope = lambda e, at=part.x: torch.func.jvp(self.value.features, (at,), (e.expand_as(at),))[1]
            gradients = torch.stack([slope(e) for e in axes], dim=1)  # (N, d, n)
            features.append(self.value.features(part.x))
            carried = torch.einsum("nd,ndk->nk", part.a, gradients)
            if part.noise is not None:
                carried = carried + self.value.feature_curvature(part.x, part.noise)
            moved.append(features[-1] - carried / rho)
            pushed.append(-torch.einsum("ndm,ndk->nmk", part.B, gradients) / rho)
        gain = (torch.cat(features) * samples.mu0.unsqueeze(-1)).mean(dim=0)
        return parts, torch.cat(moved), torch.cat(pushed), gain

    def slack(self, c: Tensor) -> Tensor:
        """`Q_W`, ``(N,)``, for ``c`` ``(k,)``."""
        p = self.parts
        return hjb_slack(p.value + self.moved @ c, p.f, None, p.cost.conjugate(p.push + self.pushed @ c))

    def add(self, x: Tensor) -> None:
        """More states."""
        parts, moved, pushed, _ = self._evaluated(x)
        self.parts = SlackParts.join([self.parts, parts])
        self.moved = torch.cat([self.moved, moved @ self.basis])
        self.pushed = torch.cat([self.pushed, pushed @ self.basis])

    def field(self, c: Tensor) -> Field:
        """`W`."""
        return self.value.shifted_by(self.basis @ c)


@torch.no_grad()
def recombined(problem: Problem, value: Field, seed: int) -> Field | None:
    """`W` for ``value`` `V` in float64; `None` where it is no `PeriodicMLP`, or no weights were found."""
    if not isinstance(value, PeriodicMLP):
        return None
    width = value.features(torch.zeros(1, problem.dim, dtype=torch.float64)).shape[1]
    count = min(STATES, NUMBERS // (width * (problem.control_dim + 2)))
    x = scrambled_sobol(count, problem.dim, derive_seed(seed, Branch.RECOMBINATION), torch.float64)
    program = Program(problem, value, x)
    c = torch.zeros(program.basis.shape[1], dtype=torch.float64)
    slack = program.slack(c)
    tau = float(torch.quantile(slack, 0.99) - slack.median())
    if not (math.isfinite(tau) and tau > 0.0):
        return None
    for _ in range(ROUNDS):
        start = slack.topk(min(ASCENTS, len(slack))).indices
        climbed, reached = climb(slack_function(problem, program.field(c)), program.parts.x[start], slack[start])
        if not bool(torch.isfinite(reached).all()):
            return None
        program.add(climbed.remainder(1.0))
        tau *= SHARPER
        c = minimised(program, c, tau)
        slack = program.slack(c)
    return program.field(c) if bool(torch.isfinite(slack).all()) else None


def minimised(program: Program, c: Tensor, tau: float) -> Tensor:
    """The minimiser of `tau log E exp(Q_W / tau) - E[W mu0]`, sought from ``c``."""
    c = c.clone().requires_grad_(True)
    optimizer = torch.optim.LBFGS(
        [c],
        max_iter=ITERATIONS,
        history_size=30,
        tolerance_grad=1e-12,
        tolerance_change=1e-14,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        with torch.enable_grad():
            loss = torch.logsumexp(program.slack(c) / tau, dim=0) - program.gain @ c / tau
            loss.backward()
        return loss

    optimizer.step(closure)
    return c.detach()
