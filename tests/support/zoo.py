"""The test problems that all tests share, by readable names; each is built once, when first asked for."""

import copy
import math
from functools import cache, partial

import pytest
import torch

from ocp_torch.fields import PeriodicMLP
from ocp_torch.problems import (
    Acrobot,
    Arm,
    CartPole,
    Circle,
    DoubleIntegrator,
    Dubins,
    InvertedDoublePendulum,
    Kuramoto,
    Manufactured,
    MountainCar,
    Pendubot,
    Pendulum,
    PhaseLockedLoop,
    PhaseNeurons,
    Problem,
    Quadrotor,
    Satellite,
    Torus,
    Unicycle,
)
from ocp_torch.problems.exact.torus import SHEARS

TURN = 2.0 * math.pi


class Swing(Problem):
    """Written by hand, as a user would: drift, a state-dependent column `B(x)`, a density `mu0`, and no exact truth."""

    def __init__(self, discount: float = 2.0) -> None:
        super().__init__(dim=2, control_dim=1, discount=discount, exponent=1.5)

    def state_cost(self, x):
        return 1.0 - 0.5 * (TURN * x).cos().sum(dim=-1)

    def drift(self, x):
        return torch.stack([0.3 * (TURN * x[:, 1]).sin(), 0.2 * (TURN * x.sum(dim=-1)).sin() + 0.1], dim=-1)

    def control_matrix(self, x):
        column = torch.stack([0.2 * (TURN * x[:, 0]).sin(), 1.0 + 0.3 * (TURN * (x[:, 0] - x[:, 1])).cos()], dim=-1)
        return column.unsqueeze(-1)

    def initial_density(self, x):
        return 1.0 + 0.5 * (TURN * (x[:, 0] + 2.0 * x[:, 1])).cos()


class NoisySwing(Swing):
    """With noise of one Brownian motion in two coordinates, that varies and vanishes somewhere; divergences by autograd."""

    def noise(self, x):
        column = torch.stack([0.3 * (TURN * x[:, 1]).sin(), 0.2 + 0.1 * (TURN * x.sum(dim=-1)).cos()], dim=-1)
        return column.unsqueeze(-1)


_KINKED = {
    "circle rho=2": partial(Circle, discount=2.0),
    "circle rho=4": partial(Circle, discount=4.0),
    **{f"torus {d}-d {shear}": partial(Torus, dim=d, shear=shear, seed=1) for d in (1, 2, 3) for shear in SHEARS},
}
_SMOOTH = {
    **{
        f"manufactured {d}-d q={q:g}": partial(Manufactured, dim=d, exponent=q)
        for d in (1, 2, 3)
        for q in (2, 1.5, 1.2)
    },
    "manufactured 3-d m=2": partial(Manufactured, dim=3, control_dim=2),
    "manufactured 2-d B(x)": partial(Manufactured, state_dependent_control=True),
    "manufactured 3-d m=2 B(x) q=1.5": partial(
        Manufactured, dim=3, control_dim=2, exponent=1.5, state_dependent_control=True
    ),
    "manufactured 2-d mu0": partial(Manufactured, initial_contrast=0.7, discount=1.0, seed=3),
    "manufactured 3-d interaction=1": partial(Manufactured, dim=3, interaction=1, initial_contrast=0.4),
    "manufactured 3-d interaction=3": partial(Manufactured, dim=3, interaction=3, drift=1.0),
}
# Exact truth with a control limit that is reached on a part of the torus: u* has kinks there.
_LIMITED = {
    "limited 1-d": partial(Manufactured, dim=1, control_limit=0.6),
    "limited 2-d": partial(Manufactured, control_limit=0.5, seed=2),
    "limited 2-d q=1.5 B(x)": partial(
        Manufactured, exponent=1.5, control_limit=0.4, state_dependent_control=True, initial_contrast=0.5
    ),
    "limited 2-d with noise": partial(Manufactured, control_limit=0.5, noise=[0.0, 0.02]),
    "limited 3-d m=2 q=1.2": partial(Manufactured, dim=3, control_dim=2, exponent=1.2, control_limit=0.5),
    "box-limited 2-d": partial(Manufactured, control_limit=[0.6, 0.3], seed=2),
    "box-limited 3-d m=2 B(x) with noise": partial(
        Manufactured,
        dim=3,
        control_dim=2,
        control_limit=[0.3, 0.5],
        state_dependent_control=True,
        initial_contrast=0.5,
        noise=[0.0, 0.02, 0.01],
    ),
}
# Exact truth with noise: isotropic; full and varying; in one coordinate of two; and beside all else.
_NOISY = {
    "noisy 1-d": partial(Manufactured, dim=1, noise=0.02),
    "noisy 2-d sigma(x)": partial(Manufactured, noise=[0.02, 0.01], state_dependent_noise=True, seed=1),
    "noisy 2-d degenerate": partial(Manufactured, noise=[0.0, 0.05], initial_contrast=0.5),
    "noisy 3-d m=2 sigma(x) B(x) q=1.5": partial(
        Manufactured,
        dim=3,
        control_dim=2,
        exponent=1.5,
        noise=0.02,
        state_dependent_noise=True,
        state_dependent_control=True,
    ),
}
_CASES = {**_KINKED, **_SMOOTH, **_LIMITED, **_NOISY, "swing": Swing, "noisy swing": NoisySwing}

# Names by what is known: V* with kinks and no drift; V* smooth, with drift; both of them; and every problem there is.
KINKED, SMOOTH, EXACT = tuple(_KINKED), tuple(_SMOOTH), (*_KINKED, *_SMOOTH)
EXACT_NOISY, NOISY, LIMITED = tuple(_NOISY), (*_NOISY, "noisy swing"), tuple(_LIMITED)
ALL = (*EXACT, "swing", *NOISY)
# Systems people have, without exact truth.
_NATURAL = {
    "arm n=2": Arm,
    "arm n=3 q=1.5": partial(Arm, dim=3, lengths=[0.5, 0.3, 0.1], target=[-0.3, 0.4], exponent=1.5),
    "arm without obstacles": partial(Arm, dim=4, obstacles=[], control_limit=0.3),
    "unicycle": Unicycle,
    "unicycle in a room": partial(Unicycle, walls=True, failure_cost=20.0),
    "dubins": Dubins,
    "dubins in a room": partial(Dubins, walls=True),
    "pendulum": Pendulum,
    "pendulum of Gymnasium": partial(Pendulum, torque_cost=0.001, control_limit=1.0),
    "kuramoto n=3": Kuramoto,
    "kuramoto n=3 absolute": partial(Kuramoto, relative=False),
    "kuramoto n=6 random": partial(Kuramoto, oscillators=6, graph="random", controlled=[0, 2, 5], seed=3),
    "kuramoto entrain": partial(Kuramoto, goal="entrain", graph="ring"),
    "kuramoto desynchronise": partial(Kuramoto, goal="desynchronise", coupling=2.0),
    "phase neurons n=2": PhaseNeurons,
    "double integrator": DoubleIntegrator,
    "double integrator, limited": partial(DoubleIntegrator, mass=2.0, velocity_weight=0.5, control_limit=0.5),
    "cart-pole": CartPole,
    "cart-pole q=1.5": partial(CartPole, exponent=1.5, control_limit=None, failure_cost=2.0),
    "phase-locked loop": PhaseLockedLoop,
    "acrobot": Acrobot,
    "pendubot": Pendubot,
    "pendubot from hanging": partial(Pendubot, starts="hanging", torque_cost=0.2, control_limit=None),
    "quadrotor": Quadrotor,
    "quadrotor without obstacles": partial(Quadrotor, obstacles=[], control_limit=0.5, thrust_cost=2.0),
    "satellite": Satellite,
    "mountain car": MountainCar,
    "inverted double pendulum": InvertedDoublePendulum,
    "phase neurons n=3 type 1": partial(PhaseNeurons, neurons=3, response="type1"),
}

NATURAL = tuple(_NATURAL)
# A few that together show every feature, for tests that cost more.
FEW_SMOOTH = ("manufactured 1-d q=2", "manufactured 2-d mu0", "manufactured 3-d m=2 B(x) q=1.5", "noisy 2-d sigma(x)")
QUIET = FEW_SMOOTH[:3]  # without noise
FEW = ("circle rho=2", "torus 2-d chain", "torus 3-d random", *FEW_SMOOTH)

# Problems at most on which a quick test is run.
MANY = 7


@cache
def build(name: str) -> Problem:
    return fresh(name)


@cache
def _untouched(name: str) -> Problem:
    return {**_CASES, **_NATURAL}[name]()


def fresh(name: str) -> Problem:
    """A problem no other test has touched: a copy of one that nobody is given, as some take long to make."""
    return copy.deepcopy(_untouched(name))


def spread(names) -> list:
    """Of more than `MANY` names the quick tests take `MANY` at most, evenly spread and the last one among them, and the
    nightly tests the others."""
    every = 1 if len(names) <= MANY else math.ceil(len(names) / (MANY - 1))
    rare = [name for k, name in enumerate(names) if k % every and name != names[-1]]
    return [pytest.param(name, marks=pytest.mark.nightly) if name in rare else name for name in names]


def on(names):
    """Run a test with its argument ``problem`` set to each of the problems ``names``, `spread` over quick and nightly."""
    return pytest.mark.parametrize("problem", spread(names), indirect=True)


def states(problem: Problem, count: int, seed: int = 0, dtype=torch.float64, off_kinks: bool = False) -> torch.Tensor:
    """Uniform states ``(N, d)``; with ``off_kinks`` only those at a distance from the faces where `V*` has kinks."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(count, problem.dim, generator=generator, dtype=torch.float64).to(dtype)
    if off_kinks and isinstance(problem, Torus):
        y = (x @ problem.A.to(x).T).remainder(1.0)
        x = x[((y > 0.01) & (y < 0.99)).all(dim=-1)]
    return x


def rough_network(dim: int, seed: int, outputs: int | None = None, size: float = 1.0) -> torch.nn.Module:
    """A float64 network far from its quiet initialisation: values of order ``size``, slopes several times that."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = PeriodicMLP(dim, outputs, modes=2, width=16, depth=2, scale=size).double()
        torch.nn.init.normal_(network.head.weight, std=0.5)
        torch.nn.init.normal_(network.head.bias, std=0.5)
    return network.requires_grad_(False)
