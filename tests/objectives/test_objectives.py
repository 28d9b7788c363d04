"""What the losses of all methods share: units do not matter, a weight is a number of states, and a penalty is not a mean."""

import math
from dataclasses import replace

import pytest
import torch

from ocp_torch.fields import Fields
from ocp_torch.objectives import METHODS, Phase
from ocp_torch.objectives.policy_evaluation import PolicyEvaluation
from ocp_torch.problems import Problem, Torus
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import Constants, resolve_constants
from ocp_torch.problems.samples import Samples
from support import zoo
from support.formulas import Field, random_fields

COST, TIME = 7.0, 0.3


class OtherUnits(Problem):
    """``problem`` with costs `COST` times and times `1 / TIME` times as large a number; controls are scaled so that `R(u)`
    is a cost."""

    def __init__(self, problem: Problem) -> None:
        self.inner, self.control = problem, COST ** (1.0 / problem.exponent)
        limit = problem.control_limit
        limit = None if limit is None else (self.control * torch.tensor(limit, dtype=torch.float64)).tolist()
        super().__init__(problem.dim, problem.control_dim, problem.discount * TIME, problem.exponent, limit)

    @property
    def driftless(self):
        return self.inner.driftless

    def state_cost(self, x):
        return COST * self.inner.state_cost(x)

    def drift(self, x):
        return TIME * self.inner.drift(x)

    def control_matrix(self, x):
        return TIME / self.control * self.inner.control_matrix(x)

    def drift_divergence(self, x):
        return TIME * self.inner.drift_divergence(x)

    def control_divergence(self, x):
        return TIME / self.control * self.inner.control_divergence(x)

    def noise(self, x):
        sigma = self.inner.noise(x)
        return None if sigma is None else TIME**0.5 * sigma

    def initial_density(self, x):
        return self.inner.initial_density(x)


class Times(torch.nn.Module):
    """A network in another unit."""

    def __init__(self, network: torch.nn.Module, unit: float) -> None:
        super().__init__()
        self.network, self.unit, self.scale = network, unit, unit * getattr(network, "scale", 1.0)

    def forward(self, x):
        return self.unit * self.network(x)


def losses(objective, fields: Fields, samples: Samples, constants: Constants) -> dict[str, float]:
    found = objective.losses(fields, samples, Phase(constants))
    return {player: loss.item() for player, loss in found.items()}


def made(kind: str, problem: Problem, **options):
    """The objective, and the problem whose samples it reads."""
    if kind != "policy evaluation":
        return METHODS[kind](problem, **options), problem
    loop = ClosedLoop(problem, lambda x: getattr(problem, "control", 1.0) * 0.2 * (6.2831853 * x).sin()[:, :1])
    return PolicyEvaluation(loop, True, 3.0), loop


KINDS = {
    "dual": ("dual", {}),
    "primal, closed": ("primal", {}),
    "primal, network": ("primal", {"occupation": "network"}),
    "pd": ("pd", {"warm_start": 0.0}),
    "pd, coupled": ("pd", {"coupling": 1.0}),
    "pd, plain": ("pd", {"augmentation": 0.0}),
    "policy evaluation": ("policy evaluation", {}),
}
CASES = [
    (kind, name)
    for name in (
        "circle rho=2",
        "manufactured 2-d mu0",
        "manufactured 3-d m=2 B(x) q=1.5",
        "swing",
        "limited 2-d q=1.5 B(x)",
        "box-limited 2-d",
        "noisy 2-d sigma(x)",
    )
    for kind in KINDS
    if kind != "primal, closed" or name == "circle rho=2"
]


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_units_of_cost_and_of_time_do_not_matter(kind, name):
    """Every loss is a cost, except for those of least squares, which are numbers."""
    (method, options), problem = KINDS[kind], zoo.build(name)
    fields, constants = random_fields(problem, 5, 0.3), resolve_constants(problem)
    other = OtherUnits(problem)
    units = {"value": COST, "control_density": other.control, "log_occupation": 1.0}
    there = Fields({n: Times(network, units[n]) for n, network in fields.networks.items()})
    measured = Constants(constants.M, COST * constants.C_V, other.control * constants.C_u, constants.sources)
    x = zoo.states(problem, 500)
    objective, data = made(method, problem, **options)
    found = losses(objective, fields, Samples.of(data, x), constants)
    objective, data = made(method, other, **options)
    again = losses(objective, there, Samples.of(data, x), measured)
    unit = 1.0 if method == "policy evaluation" else COST
    assert again == pytest.approx({player: unit * loss for player, loss in found.items()}, rel=1e-9)


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_a_weight_is_a_number_of_states(kind, name):
    """A state of weight `k` is `k` states, one of weight 0 none."""
    (method, options), problem = KINDS[kind], zoo.build(name)
    fields, constants = random_fields(problem, 5, 0.3), resolve_constants(problem)
    objective, data = made(method, problem, **options)
    x = zoo.states(problem, 300)
    counts = torch.arange(len(x)) % 4
    weight = counts * len(x) / counts.sum().double()
    once = losses(objective, fields, Samples.of(data, x, weight=weight), constants)
    often = losses(objective, fields, Samples.of(data, x.repeat_interleave(counts, dim=0)), constants)
    assert once == pytest.approx(often, rel=1e-9)


def test_a_penalty_weight_is_a_multiple_of_the_multiplier():
    """What is gained, `E[V mu0]`, keeps the weights of the integrals."""
    problem = zoo.build("swing")
    fields, constants = random_fields(problem, 5, 0.3), resolve_constants(problem)
    samples, dual = Samples.of(problem, zoo.states(problem, 300)), METHODS["dual"](problem)
    loss = lambda weight: losses(dual, fields, replace(samples, penalty_weight=weight), constants)["value"]
    none, one, two = (loss(level * samples.weight) for level in (0.0, 1.0, 2.0))
    assert none == pytest.approx(-float((fields.value(samples.x) * samples.mu0).mean()), rel=1e-12)
    assert one == pytest.approx(loss(None), rel=1e-12)
    assert two - one == pytest.approx(one - none, rel=1e-9)
    assert one > none


@pytest.mark.parametrize(("log_mu", "weighs"), [(-3.0, 5.0), (1.0, 1.0)])
def test_policy_evaluation_weighs_missing_mass(log_mu, weighs):
    """Standing still everywhere at `mu = e^{log_mu}`, mass is missing everywhere where that is below 1, and nowhere above."""
    problem = zoo.build("torus 2-d chain")
    loop, constants = ClosedLoop(problem, lambda x: 0.0 * x), resolve_constants(problem)
    fields = Fields({"log_occupation": Field(lambda x: 0.0 * x[:, 0] + log_mu)})
    samples = Samples.of(loop, zoo.states(problem, 50))
    even, priced = (
        losses(PolicyEvaluation(loop, False, price), fields, samples, constants)["occupation"] for price in (1.0, 5.0)
    )
    mu = math.exp(log_mu)
    assert even == pytest.approx((1.0 - mu) ** 2 / (1.0 + mu), rel=1e-6)
    assert priced == pytest.approx(weighs * even, rel=1e-9)


@pytest.mark.parametrize(("log_mu", "noise"), [(-2.0, 0.0), (1.5, 0.02)])
def test_policy_evaluation_divides_squares_by_a_density_that_is_data(log_mu, noise):
    """Standing still at `mu = e^l`: `(1 - mu)^2 / (1 + mu)`, whose derivative by `l` is that of the square alone."""
    problem = Torus(2, noise=noise)
    loop, constants = ClosedLoop(problem, lambda x: 0.0 * x), resolve_constants(problem)
    field = Field(lambda x: 0.0 * x[:, 0] + log_mu).double()
    samples = Samples.of(loop, zoo.states(problem, 50))
    loss = PolicyEvaluation(loop, False).losses(Fields({"log_occupation": field}), samples, Phase(constants))[
        "occupation"
    ]
    loss.backward()
    mu = math.exp(log_mu)
    assert loss.item() == pytest.approx((1.0 - mu) ** 2 / (1.0 + mu), rel=1e-9)
    assert field.weight.grad.item() == pytest.approx(-2.0 * (1.0 - mu) * mu / (1.0 + mu), rel=1e-9)
