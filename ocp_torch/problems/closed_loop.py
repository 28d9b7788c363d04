"""A problem whose controller is fixed: an uncontrolled system, so that policy evaluation needs no code of its own."""

from collections.abc import Callable

from torch import Tensor

from ocp_torch.maths import jets
from ocp_torch.problems.problem import Problem, VectorFields
from ocp_torch.problems.samples import Samples, driven


class ClosedLoop(Problem):
    r"""`dx/dt = g_u(x) = a + B u(x)` with running cost `f + R(u)` and no control left (`B = 0`, `m = 1`).

    Its value function is `V^u`, its occupation density `mu^u`, its optimum `Perf(u)`; the HJB slack of any `V` on it is
    the Bellman slack `Q_u`, its Liouville residual that of `u` (problems P(u) and D(u), section 5.4 of the paper).
    """

    def __init__(self, problem: Problem, policy: Callable[[Tensor], Tensor]) -> None:
        super().__init__(dim=problem.dim, control_dim=1, discount=problem.discount, exponent=problem.exponent)
        self.problem, self.policy = problem, policy

    @property
    def driftless(self) -> bool:
        return False

    def samples_of(self, sets: list[Samples]) -> list[Samples]:
        """The closed loop's data at the states of ``sets``, with their weights."""
        pieces = lambda s: [Samples.of(self, part.x, weight=part.weight) for part in s.split(jets.CHUNK)]
        return [Samples.concatenate(pieces(samples)) for samples in sets]

    def state_cost(self, x: Tensor) -> Tensor:
        return self.problem.state_cost(x) + self.problem.control_cost.cost(self.policy(x))

    def drift(self, x: Tensor) -> Tensor:
        return self.problem.velocity(x, self.policy(x))

    def drift_divergence(self, x: Tensor) -> Tensor | None:
        """`div g_u = div a + (div B) . u + sum_k (d u_k along column k of B)`, ``(N,)``: a reverse pass for each control."""
        return self.vector_fields(x)[2]

    def vector_fields(self, x: Tensor, divergences: bool = True) -> VectorFields:
        return self._controlled(x, self.problem.vector_fields(x, divergences))[1]

    def cost_and_fields(self, x: Tensor, divergences: bool = True) -> tuple[Tensor, VectorFields]:
        f, fields = self.problem.cost_and_fields(x, divergences)
        u, own = self._controlled(x, fields)
        return f + self.problem.control_cost.cost(u), own

    def _controlled(self, x: Tensor, fields: VectorFields) -> tuple[Tensor, VectorFields]:
        """The control ``(N, m)`` and the closed loop's `vector_fields`, from the problem's ``fields`` and one call of the
        policy."""
        a, B, div_a, div_B = fields
        if div_a is None or div_B is None:
            u, divergence = self.policy(x), None
        else:
            own = getattr(self.policy, "flux_divergence", None) if jets.is_data(x) else None
            u, flux = jets.control_flux_divergence(self.policy, x, B, div_B) if own is None else own(x, B, div_B)
            divergence = div_a + flux
        return u, (driven(a, B, u), self.control_matrix(x), divergence, self.control_divergence(x))

    def control_matrix(self, x: Tensor) -> Tensor:
        return x.new_zeros(len(x), self.dim, 1)

    def control_divergence(self, x: Tensor) -> Tensor:
        return x.new_zeros(len(x), 1)

    def noise(self, x: Tensor) -> Tensor | None:
        return self.problem.noise(x)

    def noise_divergences(self, x: Tensor) -> tuple[Tensor, Tensor] | None:
        return self.problem.noise_divergences(x)

    def initial_density(self, x: Tensor) -> Tensor:
        return self.problem.initial_density(x)
