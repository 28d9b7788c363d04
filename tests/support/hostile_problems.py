"""Problems as users write them: with every slip the check must name, and rough but legal ones it must let through."""

import math
import sys

import numpy as np
import torch

from ocp_torch import Problem
from ocp_torch.problems import Lipschitz

TURN = 2.0 * math.pi


class Good(Problem):
    """Legal in every respect, with a `B` and a drift of its own."""

    def __init__(self, dim: int = 2, control_dim: int | None = None) -> None:
        super().__init__(dim=dim, control_dim=control_dim)

    def state_cost(self, x):
        return 1.0 + torch.cos(TURN * x[:, 0])

    def drift(self, x):
        return 0.3 * torch.sin(TURN * x)

    def control_matrix(self, x):
        size = 1.0 + 0.2 * torch.cos(TURN * x[:, 0])
        return size[:, None, None] * super().control_matrix(x)


def with_(dim: int = 2, **functions) -> Problem:
    """`Good` in ``dim`` dimensions with ``functions`` of (self, x) in place of its own."""
    return type("Mine", (Good,), functions)(dim)


class FarApart(Problem):
    """Two actuators as fast at their limits, of which one is small and moves much."""

    def __init__(self) -> None:
        super().__init__(2, control_limit=[1.0, 1e-4])

    def state_cost(self, x):
        return 2.0 + torch.cos(TURN * x).sum(dim=-1)

    def control_matrix(self, x):
        return torch.diag(x.new_tensor([1.0, 1e4])).expand(len(x), 2, 2)


class NoSuper(Problem):
    def __init__(self) -> None:
        self.weight = 1.0

    def state_cost(self, x):
        return torch.ones_like(x[:, 0])


class TooLate(Good):
    def __init__(self) -> None:
        super().__init__()
        self.exponent = 1.5


class Bounded(Good):
    def __init__(self) -> None:
        super().__init__()
        self.state_cost_bound = 1.5


class BrokenInit(Good):
    def __init__(self) -> None:
        super().__init__()
        self.table = {}["missing"]


class Moody(Good):
    calls = 0

    def state_cost(self, x):
        self.calls += 1
        return super().state_cost(x) + 0.1 * self.calls


class Remembers(Good):
    """The drift looks at what the state cost was asked last."""

    def state_cost(self, x):
        self.last = torch.cos(TURN * x[:, 0])
        return 1.0 + self.last

    def drift(self, x):
        return self.last[:, None] * torch.sin(TURN * x)


class OneBuffer(Good):
    def state_cost(self, x):
        kept = self.__dict__.setdefault("buffers", {})
        buffer = kept.setdefault((len(x), x.dtype), torch.empty(len(x), dtype=x.dtype))
        return buffer.copy_(1.0 + torch.cos(TURN * x[:, 0]))


def inplace(self, x):
    x.mul_(TURN)
    return 1.0 + x[:, 0].cos()


def raises(self, x):
    if (x[:, 0] > 0.97).any():
        raise KeyError("no table")
    return 1.0 + torch.cos(TURN * x[:, 0])


def near(x, centre=0.3):
    """Displacement from ``centre`` on the torus."""
    return (x - centre + 0.5).remainder(1.0) - 0.5


def bump(width, centre=0.3):
    return lambda self, x: torch.exp(-near(x, centre).square().sum(-1) / (2.0 * width**2))


def gaussian(width, dim, centre=0.3):
    return lambda self, x: bump(width, centre)(self, x) / (math.sqrt(TURN) * width) ** dim


def correlated(self, x):
    A = 0.01 * torch.tensor([[1.0, 0.0], [0.95, 0.3]], dtype=x.dtype)
    z = torch.linalg.solve(A, near(x).T).T
    return torch.exp(-0.5 * z.square().sum(-1)) / (TURN * float(torch.det(A).abs()))


def box(side, dim):
    return lambda self, x: (near(x, 0.412).abs() < 0.5 * side).all(-1).to(x) / side**dim


def ring(self, x):
    r = near(x, 0.5).norm(dim=-1)
    return torch.exp(-0.5 * ((r - 0.3) / 0.005).square()) / (math.sqrt(TURN) * 0.005) / (TURN * 0.3)


def wobbly(self, x):
    return 4.0 + sum(0.7**k * torch.cos(TURN * 3**k * x[:, 0]) for k in range(12))


def steps_of(self, x):
    return torch.where(x[:, :1].remainder(1.0) < 0.3, 0.5, 1.0).to(x)


def step_of(x):
    """A step that autograd has no derivative of."""
    return torch.heaviside(torch.sin(TURN * x), torch.full_like(x, 0.5))


def column(size=0.1):
    """`sigma` of one Brownian motion that varies with the state."""
    return lambda self, x: (size * torch.stack([torch.sin(TURN * x[:, 1]), 2.0 + torch.cos(TURN * x[:, 0])], -1))[
        ..., None
    ]


def sigma(change):
    """`column` with its answer ``change``d."""
    return lambda self, x: change(column()(self, x), x)


class NoiseNumber(Good):
    def __init__(self) -> None:
        super().__init__()
        self.noise = 0.1


class NoiseBeside(Good):
    """Of a number and of a method together, and arguments that are called as the method is."""

    def __init__(self, noise=0.01) -> None:
        Problem.__init__(self, dim=2, noise=noise)

    def noise(self, x):
        return torch.cat([super().noise(x), column()(self, x)], dim=-1)


class NoiseInstead(NoiseBeside):
    """Of a method alone, which forgets the number."""

    def noise(self, x):
        return column()(self, x)


class NoNoiseInstead(NoiseBeside):
    def noise(self, x):
        return None


class NoiseScaled(NoiseBeside):
    """More of the same: nothing of the number is lost."""

    def noise(self, x):
        return super().noise(x) * (1.5 + 0.5 * torch.sin(TURN * x[:, :1, None]))


class NoiseColumnsForgotten(Good):
    def __init__(self) -> None:
        super().__init__()
        self.add_noise(torch.tensor([[0.1], [0.2]]))

    def noise(self, x):
        return 0.5 * super().noise(x)


class MoodyNoise(Good):
    calls = 0

    def noise(self, x):
        self.calls += 1
        return 0.1 * self.calls * column()(self, x)


def noise_raises(self, x):
    if (x[:, 0] > 0.97).any():
        raise KeyError("no table")
    return column()(self, x)


def noisy(divergences):
    return with_(noise=column(), noise_divergences=divergences)


autograd = Problem.noise_divergences
plain_cost = Good.state_cost
# Name -> the problem (made when called) and what the sentence must hold.
REFUSED = {
    "B for one control": (lambda: with_(control_matrix=lambda self, x: x.new_ones(len(x), 2, 1)),
                          r"control_matrix of .*Mine gave shape \(7, 2, 1\) .* \(N, d, m\) = \(7, 2, 2\)"),
    "f a column": (lambda: with_(state_cost=lambda self, x: torch.cos(TURN * x[:, :1]) + 1.0),
                   r"state_cost .* gave shape \(7, 1\) .* \(N,\) = \(7,\)"),
    "a a column": (lambda: with_(drift=lambda self, x: 0.1 * torch.sin(TURN * x[:, :1])),
                   r"drift .* gave shape \(7, 1\) .* \(N, d\) = \(7, 2\)"),
    "f a number": (lambda: with_(state_cost=lambda self, x: torch.cos(TURN * x).square().sum()), r"gave shape \(\)"),
    "squeezed": (lambda: with_(1, state_cost=lambda self, x: (1.0 + torch.cos(TURN * x)).squeeze()),
                 r"gave shape \(\) for states of shape \(1, 1\)"),
    "div B a column": (lambda: with_(control_divergence=lambda self, x: x.new_zeros(len(x), 1)),
                       r"control_divergence .* \(N, m\) = \(7, 2\)"),
    "V* a column": (lambda: with_(exact_value=lambda self, x: x[:, :1]), r"exact_value .* \(N,\)"),
    "arrays": (lambda: with_(state_cost=lambda self, x: np.ones(len(x))), "gave a numpy.ndarray .* torch tensor"),
    "arrays inside": (lambda: with_(state_cost=lambda self, x: torch.from_numpy(1.0 + np.cos(TURN * x.numpy()[:, 0]))),
                      "state_cost .* raised RuntimeError: NumPy was given a tensor; use the functions of torch"),
    "a float": (lambda: with_(state_cost=lambda self, x: 1.0), "gave a float"),
    "nothing": (lambda: with_(drift=lambda self, x: None), "drift .* gave a NoneType"),
    "always double": (lambda: with_(state_cost=lambda self, x: 1.0 + torch.cos(TURN * x[:, 0].double())),
                      "gave torch.float64 on cpu for states in torch.float32"),
    "always single": (lambda: with_(control_matrix=lambda self, x: torch.eye(2).expand(len(x), 2, 2)),
                      "gave torch.float32 on cpu for states in torch.float64"),
    "whole numbers": (lambda: with_(initial_density=lambda self, x: torch.ones(len(x), dtype=torch.int64)), "torch.int64"),
    "elsewhere": (lambda: with_(state_cost=lambda self, x: torch.ones(len(x), dtype=x.dtype, device="meta")), "on meta"),
    "in place": (lambda: with_(state_cost=inplace), "state_cost .* changes its argument x in place"),
    "no super": (NoSuper, r"NoSuper has no dim: its __init__ must call super\(\).__init__"),
    "too late": (TooLate, "TooLate changes exponent or control_limit after super"),
    "NaN": (lambda: with_(drift=lambda self, x: torch.where(x.remainder(1.0) > 0.9, math.nan, x * 0.0)),
            r"drift .* gives \[.*nan.*\] at x = \[.*0\.9"),
    "infinite at 0": (lambda: with_(state_cost=lambda self, x: 1.0 / (1.0 - torch.cos(TURN * x[:, 0]))),
                      r"gives inf at x = \[0, 0\]"),
    "too large for float32": (lambda: with_(state_cost=lambda self, x: (1e30 * torch.cos(TURN * x[:, 0])).square() / 1e60),
                              "gives nan in single precision"),
    "no period": (lambda: with_(state_cost=lambda self, x: x[:, 0].square()), "state_cost .* is not periodic: at x ="),
    "no period of B": (lambda: with_(control_matrix=lambda self, x: (1.0 + x[:, :, None]) * torch.eye(2, dtype=x.dtype)),
                       "control_matrix .* is not periodic"),
    "negative": (lambda: with_(state_cost=lambda self, x: 0.9 + torch.cos(TURN * x[:, 0])), "state_cost .* at least 0"),
    "negative in a dip": (lambda: with_(state_cost=lambda self, x: 1.0 - 1.5 * bump(0.03)(self, x)), "is -0.49"),
    "above its bound": (Bounded, "above its state_cost_bound = 1.5"),
    "Lipschitz constants in a dict": (lambda: with_(lipschitz={"state_cost": 7.0}),
                                      r"lipschitz of .*Mine is .*, but must be Lipschitz\(state_cost=.., drift=.., ..\)"),
    "a Lipschitz constant in words": (lambda: with_(lipschitz=Lipschitz(drift="2")),
                                      "drift in lipschitz of .*Mine is '2', but must be"),
    "a Lipschitz constant below 0": (lambda: with_(lipschitz=Lipschitz(state_cost=-1.0)),
                                     "state_cost in lipschitz of .*Mine is -1, but must be at least 0"),
    "mu0 negative": (lambda: with_(initial_density=lambda self, x: 1.0 + 1.5 * torch.cos(TURN * x[:, 0])),
                     "initial_density .* at least 0"),
    "mass 1.5": (lambda: with_(initial_density=lambda self, x: 1.5 * torch.ones_like(x[:, 0])), "integrates to 1.5"),
    "mass 1/2": (
        lambda: with_(initial_density=lambda self, x: 0.5 + 0.5 * torch.cos(TURN * x[:, 0])),
        "integrates to 0.(49|5)",
    ),
    "mass 0": (lambda: with_(initial_density=lambda self, x: 0.0 * x[:, 0]), "is 0 at all of"),
    "mass of a bump": (lambda: with_(initial_density=bump(0.1)), "integrates to 0.06"),
    "mass of a needle": (lambda: with_(initial_density=bump(0.004)), "integrates to 0.0001|integrates to 9.*e-05"),
    "mass 1.005": (lambda: with_(initial_density=lambda self, x: 1.005 * gaussian(0.1, 2)(self, x)), "integrates to 1.00"),
    "mass 1.005 of a quarter": (lambda: with_(initial_density=lambda self, x: 4.02 * (x.remainder(1.0) < 0.5).all(-1).to(x)),
                                "integrates to 1.005"),
    "mass 2.5": (lambda: with_(initial_density=lambda self, x: 2.5 * gaussian(0.004, 2)(self, x)), "integrates to 2"),
    "counts calls": (Moody, "state_cost .* is no function of the state alone"),
    "random": (lambda: with_(state_cost=lambda self, x: 1.0 + 0.1 * torch.rand(len(x), dtype=x.dtype)), "no function of"),
    "the batch": (lambda: with_(drift=lambda self, x: torch.sin(TURN * (x - x.mean(0)))), "drift .* no function of"),
    "the largest of a batch": (lambda: with_(state_cost=lambda self, x: plain_cost(self, x) / plain_cost(self, x).max()),
                               "no function of the state alone"),
    "remembers": (Remembers, "drift .* no function of the state alone"),
    "one buffer": (OneBuffer, "state_cost .* overwrites an answer"),
    "raises": (lambda: with_(state_cost=raises), r"state_cost .* KeyError: .no table. at x = \[0\.9.*s.py, line"),
    "raises always": (lambda: with_(drift=lambda self, x: math.sqrt(-1.0)), r"raised ValueError: .*problems.py, line"),
    "exits": (lambda: with_(drift=lambda self, x: sys.exit(3)), "drift .* raised SystemExit: 3"),
    "misspelt": (lambda: with_(initial_densty=plain_cost), "defines initial_densty, .* did you mean initial_density"),
    "div a": (lambda: with_(drift_divergence=lambda self, x: 0.0 * x[:, 0]), "drift_divergence .* by differences of drift"),
    "detached": (lambda: with_(control_matrix=lambda self, x: Good.control_matrix(self, x.detach())),
                 "control_divergence .* by differences of control_matrix"),
    "f detached": (lambda: with_(state_cost=lambda self, x: plain_cost(self, x.detach())),
                   "state_cost of .*Mine loses its derivative by the state: at .* and by 0 as autograd says"),
    "f of NumPy": (lambda: with_(state_cost=lambda self, x: torch.from_numpy(1.0 + np.cos(TURN * x.detach().numpy()[:, 0]))),
                   "state_cost .* loses its derivative .* problem=callable takes a simulator in NumPy"),
    "a term of f detached": (lambda: with_(state_cost=lambda self, x: plain_cost(self, x) + plain_cost(self, x.detach())),
                             "state_cost .* loses its derivative"),
    "a detached beside its divergence": (
        lambda: with_(drift=lambda self, x: Good.drift(self, x.detach()),
                      drift_divergence=lambda self, x: 0.3 * TURN * torch.cos(TURN * x).sum(dim=-1)),
        "drift .* loses its derivative"),
    "noise detached beside no divergences": (
        lambda: with_(noise=lambda self, x: column()(self, x.detach()), noise_divergences=lambda self, x: None),
        "noise .* loses its derivative"),
    **{f"{name} without a derivative": (lambda name=name, step=step: with_(**{name: step}),
                                        f"{name} of .*Mine cannot be differentiated .*aten::heaviside is not implemented.*:"
                                        " use functions that have a derivative")
       for name, step in {"state_cost": lambda self, x: step_of(x[:, 0]), "drift": lambda self, x: step_of(x),
                          "control_matrix": lambda self, x: step_of(x)[:, :, None] * torch.eye(2, dtype=x.dtype),
                          "noise": lambda self, x: 0.1 * step_of(x)[..., None]}.items()},
    "noise without columns": (lambda: with_(noise=sigma(lambda s, x: s[..., 0])),
                              r"noise of .*Mine gave shape \(7, 2\) .* \(N, d, k\) = \(7, 2, 1\) with d = 2, k = 1"),
    "noise of too few rows": (lambda: with_(noise=sigma(lambda s, x: s[:, :1])), r"noise .* gave shape \(7, 1, 1\)"),
    "noise of no column": (lambda: with_(noise=sigma(lambda s, x: s[..., :0])), r"noise .* gave shape \(7, 2, 0\)"),
    "noise of N columns": (lambda: with_(noise=sigma(lambda s, x: s.expand(-1, -1, len(x)))),
                           r"noise .* gave shape \(7, 2, 7\) .* as many at all states"),
    "noise a number": (lambda: with_(noise=lambda self, x: 0.1), "noise of .* gave a float"),
    "noise an attribute": (NoiseNumber, r"NoiseNumber sets noise to 0.1, but .* super\(\).__init__\(noise=..\)"),
    "noise instead of the number": (NoiseInstead, r"noise\(x\) of .*NoiseInstead leaves out .* super\(\).noise\(x\)"),
    "no noise instead of the number": (NoNoiseInstead, r"noise\(x\) of .* leaves out the noise"),
    "less than the columns": (NoiseColumnsForgotten, r"noise\(x\) of .* leaves out .* add_noise"),
    "noise in few batches": (lambda: with_(noise=lambda self, x: None if len(x) < 9 else column()(self, x)),
                             "noise .* gave a NoneType"),
    "noise in many batches": (lambda: with_(noise=lambda self, x: None if len(x) < 30 else column()(self, x)),
                              "noise .* gives None for some states"),
    "noise always double": (lambda: with_(noise=sigma(lambda s, x: s.double())), "noise .* gave torch.float64"),
    "noise of NaN": (lambda: with_(noise=sigma(lambda s, x: torch.where(x[:, :1, None].remainder(1.0) > 0.9, math.nan, s))),
                     r"noise .* gives \[.*nan.*\] at x = \[0\.9"),
    "noise without period": (lambda: with_(noise=sigma(lambda s, x: s * x[:, :1, None])), "noise .* is not periodic"),
    "noise that counts": (MoodyNoise, "noise .* is no function of the state alone"),
    "noise of the batch": (lambda: with_(noise=sigma(lambda s, x: s - s.mean(0))), "noise .* no function of the state"),
    "noise in place": (lambda: with_(noise=lambda self, x: column()(self, x.mul_(2.0))), "noise .* changes its argument"),
    "noise raises": (lambda: with_(noise=noise_raises), r"noise .* KeyError: .no table. at x = \[0\.9.*s.py, line"),
    "noise detached": (lambda: with_(noise=lambda self, x: column()(self, x.detach())),
                       r"noise_divergences\[0\] .* by differences of D = noise noise\^T / 2"),
    "noise beyond all units": (lambda: with_(noise=sigma(lambda s, x: 1e4 * s)), "the noise of .* is too large"),
    "div D alone": (lambda: noisy(lambda self, x: x), "noise_divergences .* gave a Tensor, but must give two tensors"),
    "div D a number": (lambda: noisy(lambda self, x: (x[:, 0], x[:, 0])), r"noise_divergences\[0\] .* gave shape \(7,\)"),
    "div div D a column": (lambda: noisy(lambda self, x: (x, x)), r"noise_divergences\[1\] .* \(N,\) = \(7,\)"),
    "div D of 0": (lambda: noisy(lambda self, x: (0.0 * x, autograd(self, x)[1])),
                   r"noise_divergences\[0\] .* by differences of D"),
    "div div D of 0": (lambda: noisy(lambda self, x: (autograd(self, x)[0], 0.0 * x[:, 0])),
                       r"noise_divergences\[1\] .* by differences of noise_divergences\[0\]"),
    "wide units": (lambda: with_(state_cost=lambda self, x: 1e12 * plain_cost(self, x)), "units of .* are too far apart"),
}  # fmt: skip
LEGAL = {
    "plain": lambda: with_(),
    "one control": lambda: Good(3, 1),
    "forty coordinates": lambda: Good(40),
    "f jumps": lambda: with_(state_cost=lambda self, x: (8.0 * x.remainder(1.0)).floor().sum(-1)),
    "f jumps at 0 and 1/2": lambda: with_(state_cost=lambda self, x: 1.0 + torch.sign(torch.sin(TURN * x[:, 0]))),
    "f jumps at the seam": lambda: with_(state_cost=lambda self, x: x[:, 0].remainder(1.0)),
    "a jumps": lambda: with_(drift=lambda self, x: steps_of(self, x).expand_as(x)),
    "B jumps": lambda: with_(control_matrix=lambda self, x: steps_of(self, x)[:, :, None] * torch.eye(2, dtype=x.dtype)),
    "rough": lambda: with_(state_cost=wobbly),
    "rough below the steps of differences": lambda: with_(state_cost=lambda self, x: 4.0 + sum(
        0.5**k * torch.cos(TURN * 7**k * x[:, 0]) for k in range(8))),
    "a hash": lambda: with_(state_cost=lambda self, x: (4e4 * torch.sin(TURN * (20.0 * x[:, 0] + x[:, 1]))).remainder(1.0)),
    "kinks": lambda: with_(drift=lambda self, x: torch.sin(TURN * x).abs().sqrt()),
    "a step of a detached state": lambda: with_(state_cost=lambda self, x: step_of(x[:, 0].detach())),
    "f in steps of .001": lambda: with_(state_cost=lambda self, x: (1e3 * plain_cost(self, x)).round() / 1e3),
    "mu0 without a derivative": lambda: with_(initial_density=lambda self, x: 2.0 * step_of(x[:, 0])),
    "Lipschitz constants": lambda: with_(lipschitz=Lipschitz(state_cost=7, drift=torch.tensor(2.0))),
    "limits and gains far apart": FarApart,
    "flat": lambda: with_(state_cost=lambda self, x: torch.zeros_like(x[:, 0])),
    "a hole": lambda: with_(state_cost=lambda self, x: 1.0 - bump(0.0025, 0.5)(self, x)),
    "a spike": lambda: with_(state_cost=lambda self, x: 5000.0 * bump(0.0025, 0.5)(self, x)),
    "single inside": lambda: with_(state_cost=lambda self, x: 1.0 + torch.cos(TURN * x[:, 0].float()).to(x)),
    "no divergences": lambda: with_(drift_divergence=lambda self, x: None, control_divergence=lambda self, x: None),
    "noise": lambda: with_(noise=column()),
    "noise beside a number": NoiseBeside,
    "more noise than the number": NoiseScaled,
    "noise of 0": lambda: with_(noise=column(0.0)),
    "noise of five motions": lambda: with_(noise=sigma(lambda s, x: s * torch.linspace(0.1, 1.0, 5, dtype=x.dtype))),
    "noise that jumps": lambda: with_(noise=sigma(lambda s, x: s * steps_of(None, x)[:, :, None])),
    "noise without divergences": lambda: noisy(lambda self, x: None),
    "noise with divergences": lambda: noisy(lambda self, x: autograd(self, x)),
    "small units": lambda: with_(state_cost=lambda self, x: 1e-12 * plain_cost(self, x)),
    **{f"mu0 of width {s} in {d}-d": lambda s=s, d=d: with_(d, initial_density=gaussian(s, d))
       for s in (0.1, 0.004) for d in (1, 2, 3, 5)},
    "mu0 across the seam": lambda: with_(initial_density=gaussian(0.004, 2, 0.0)),
    "mu0 correlated": lambda: with_(initial_density=correlated),
    "mu0 in one coordinate": lambda: with_(initial_density=lambda self, x: gaussian(0.003, 1)(self, x[:, :1])),
    "mu0 half a needle": lambda: with_(initial_density=lambda self, x: 0.5 + 0.5 * gaussian(0.004, 2)(self, x)),
    "mu0 two needles": lambda: with_(
        initial_density=lambda self, x: 0.5 * gaussian(0.004, 2)(self, x) + 0.5 * gaussian(0.01, 2, 0.8)(self, x)),
    "mu0 a quarter": lambda: with_(initial_density=lambda self, x: 4.0 * (x.remainder(1.0) < 0.5).all(-1).to(x)),
    "mu0 a box": lambda: with_(initial_density=box(0.01, 2)),
    "mu0 a box in 4-d": lambda: with_(4, initial_density=box(0.2, 4)),
    "mu0 a ring": lambda: with_(initial_density=ring),
}  # fmt: skip
