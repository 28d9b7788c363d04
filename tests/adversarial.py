"""Problems made to fool a certificate, each with a truth to hold it against: narrow starts, jumps, spikes, needles."""

import math

import torch

from ocp_torch.problems import Problem

TURN = 2.0 * math.pi


def short_way(x, centre):
    """From ``centre`` to ``x`` on the torus."""
    away = x - torch.as_tensor(centre, dtype=x.dtype)
    return away - away.round()


def gaussian(x, centre, sigma):
    """The density of a normal law far narrower than the torus; ``sigma`` a number or one per coordinate."""
    z = short_way(x, centre) / torch.as_tensor(sigma, dtype=x.dtype)
    size = torch.as_tensor(sigma, dtype=x.dtype).expand(x.shape[1]).prod()
    return (-0.5 * z.square().sum(dim=-1)).exp() / ((2.0 * math.pi) ** (x.shape[1] / 2) * size)


class NarrowStart(Problem):
    """Starts within ``sigma`` of ``centre``, drifts at constant speeds, and pays a wave along each coordinate.

    Doing nothing costs `idle`, a closed form: `rho int e^{-rho t} cos(2 pi (y + c t)) dt` is the real part of
    `e^{2 pi i y} rho / (rho - 2 pi i c)`, and a normal law damps each wave by `exp(-2 pi^2 sigma^2)`.
    """

    def __init__(self, centre, sigma, discount: float = 2.0) -> None:
        super().__init__(dim=len(centre), discount=discount)
        self.centre, self.sigma = list(centre), sigma
        self.speeds = [0.3 + 0.1 * k for k in range(self.dim)]
        self.state_cost_bound = 2.0

    def state_cost(self, x):
        return 1.0 + (TURN * x).cos().mean(dim=-1)

    def drift(self, x):
        return x.new_tensor(self.speeds).expand_as(x)

    def initial_density(self, x):
        return gaussian(x, self.centre, self.sigma)

    def mean_wave(self, factor=lambda c: 1.0) -> float:
        """`E mu0` of the mean over coordinates of `Re factor(c) e^{2 pi i x}`."""
        sigma = [self.sigma] * self.dim if isinstance(self.sigma, float) else self.sigma
        each = [
            math.exp(-2.0 * (math.pi * s) ** 2) * complex(math.cos(TURN * y), math.sin(TURN * y)) * factor(c)
            for y, s, c in zip(self.centre, sigma, self.speeds, strict=True)
        ]
        return sum(e.real for e in each) / self.dim

    @property
    def idle(self) -> float:
        return 1.0 + self.mean_wave(lambda c: self.discount / (self.discount - TURN * 1j * c))


class JumpSink(Problem):
    """`dx = u` carried by a drift into the plane `x_1 = at`, at which it jumps from `speed` to `-speed`, or changes within
    ``width``; in more dimensions only where `|x_2 - 1/2| < patch`, if a patch is given, with smooth edges."""

    def __init__(
        self, dim: int = 1, width: float = 0.0, at: float = 0.3, speed: float = 0.4, patch: float | None = None
    ):
        super().__init__(dim=dim)
        self.width, self.at, self.speed, self.patch = width, at, speed, patch
        self.state_cost_bound = self.value_bound = 1.0

    def state_cost(self, x):
        """1 but for a smooth dip to 0 beside the sink."""
        return 1.0 - (-0.5 * (short_way(x[:, 0], self.at + 0.2) / 0.05).square()).exp()

    def drift(self, x):
        r = short_way(x[:, 0], self.at)
        turn = (r / self.width).tanh() if self.width else torch.where(r > 0.0, 1.0, -1.0).to(x)
        first = -self.speed * turn * (math.pi * r).cos().square()
        if self.patch is not None:
            first = first * (-((short_way(x[:, 1], 0.5) / self.patch) ** 4)).exp()
        return torch.cat([first.unsqueeze(-1), torch.zeros_like(x[:, 1:])], dim=-1)


class JumpingMatrix(Problem):
    """`dx = B(x) u` in which each column of `B` is halved where its coordinate is between 0.2 and 0.6."""

    def state_cost(self, x):
        return 1.0 - 0.5 * (TURN * x).cos().mean(dim=-1)

    def control_matrix(self, x):
        y = x.remainder(1.0)
        return torch.diag_embed(torch.where((y > 0.2) & (y < 0.6), 0.5, 1.0).to(x))


class Spike(Problem):
    """A state cost of mean `1 + mass` whose spike of width ``sigma`` holds ``mass``; carried at a constant velocity, every
    state is visited alike: from a uniform start doing nothing costs that mean, whatever the velocity."""

    def __init__(self, centre, sigma: float = 0.0025, mass: float = 0.2, wavy: float = 0.0, speed: float = 0.0) -> None:
        super().__init__(dim=len(centre))
        self.centre, self.sigma, self.mass, self.wavy, self.speed = list(centre), sigma, mass, wavy, speed

    def state_cost(self, x):
        waves = self.wavy * (TURN * (x - 0.1)).cos().mean(dim=-1)
        return 1.0 + waves + self.mass * gaussian(x, self.centre, self.sigma)

    def drift(self, x):
        return torch.full_like(x, self.speed)

    @property
    def idle(self) -> float:
        return 1.0 + self.mass
