"""Problems made to fool a certificate, each with a truth to hold it against: narrow starts, jumps, spikes, needles."""

import math
from functools import cached_property

import torch

from ocp_torch.problems import Problem
from support.line_oracle import Line

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


class Hole(Problem):
    """`dx = u` at cost 1, but for a smooth dip to 0 within ``radius`` of ``centre``; from everywhere.

    With the dip a point, `V = 1 - max(0, 1 - c r)^q` at a distance `r` on the torus, `c = rho (q')^{1/q'} / q`: it solves
    `V - 1 + R*(V' / rho) = 0`, `V(0) = 0`. A dip to 0 all over the ball only makes `r` smaller by the radius.
    """

    def __init__(self, dim: int, radius: float, q: float = 2.0, discount: float = 4.0, **declared) -> None:
        super().__init__(dim=dim, discount=discount, exponent=q)
        self.radius, self.centre = radius, [0.31 + 0.46 * k / max(1, dim - 1) for k in range(dim)]
        conjugate = q / (q - 1.0)
        self.slope = discount * conjugate ** (1.0 / conjugate) / q
        for name, value in declared.items():
            setattr(self, name, value)

    def distance(self, x):
        return (short_way(x, self.centre).square().sum(dim=-1) + 1e-18).sqrt()

    def state_cost(self, x):
        dip = (1.0 - (self.distance(x) / self.radius).square()).clamp_min(0.0)
        return 1.0 - dip.square()

    def formula(self, x):
        """`V` of a dip that is a point."""
        return 1.0 - (1.0 - self.slope * self.distance(x)).clamp_min(0.0) ** self.exponent

    @property
    def truth(self) -> tuple[float, float]:
        return 1.0 - self._gain(self.radius), 1.0 - self._gain(0.0)

    def _gain(self, radius: float) -> float:
        """`E[1 - V]`: a sum over shells of the torus, of which the volume within a distance is known by a grid."""
        d, q, c = self.dim, self.exponent, self.slope
        reach = radius + 1.0 / c
        if d == 1 or reach <= 0.5:
            r = torch.linspace(0.0, min(reach, 0.5), 200_001, dtype=torch.float64)
            shell = 2.0 * math.pi ** (d / 2) / math.gamma(d / 2) * r ** (d - 1)
            gain = (1.0 - c * (r - radius).clamp_min(0.0)).clamp_min(0.0) ** q
            return float(torch.trapezoid(shell * gain, r))
        assert d == 2
        side = (torch.arange(2000, dtype=torch.float64) + 0.5) / 4000
        r = (side.square().unsqueeze(0) + side.square().unsqueeze(1)).sqrt()
        return float(((1.0 - c * (r - radius).clamp_min(0.0)).clamp_min(0.0) ** q).mean())

    @property
    def idle_between(self) -> tuple[float, float]:
        ball = math.pi ** (self.dim / 2) / math.gamma(self.dim / 2 + 1) * self.radius**self.dim
        return 1.0 - ball, 1.0


class Lines(Problem):
    """A sum of one-dimensional problems (`line_oracle.Line`), each in its own coordinate: with `R` a sum of squares, or one
    coordinate that can be moved, OPT is the sum of theirs. Coordinates that nothing moves have no control."""

    def __init__(self, *lines, discount: float = 2.0, q: float = 2.0, **declared) -> None:
        self.lines, self.moved = lines, [k for k, line in enumerate(lines) if line.moves]
        super().__init__(dim=len(lines), control_dim=max(1, len(self.moved)), discount=discount, exponent=q)
        assert q == 2.0 or len(self.moved) <= 1
        for name, value in declared.items():
            setattr(self, name, value)

    def state_cost(self, x):
        return sum(line.f(x[:, k].remainder(1.0)) for k, line in enumerate(self.lines)).to(x)

    @property
    def driftless(self):
        return all(line.a is None for line in self.lines)

    def drift(self, x):
        y = x.remainder(1.0)
        zero = torch.zeros_like(x[:, 0])
        return torch.stack([zero if v.a is None else v.a(y[:, k]).to(x) for k, v in enumerate(self.lines)], dim=-1)

    def control_matrix(self, x):
        y = x.remainder(1.0)
        B = []
        for j in range(self.control_dim):
            one = lambda k, line, j=j: self.moved[j : j + 1] == [k]
            column = [
                (line.b(y[:, k]).to(x) if line.b is not None else torch.ones_like(y[:, k]))
                if one(k, line)
                else torch.zeros_like(y[:, k])
                for k, line in enumerate(self.lines)
            ]
            B.append(torch.stack(column, dim=-1))
        return torch.stack(B, dim=-1)

    def initial_density(self, x):
        density = torch.ones_like(x[:, 0])
        for k, line in enumerate(self.lines):
            if line.start is not None:
                density = density * gaussian(x[:, k : k + 1], [line.start[0]], line.start[1])
        return density

    @cached_property
    def truth(self) -> tuple[float, float]:
        return tuple(map(sum, zip(*(v.optimum(self.discount, self.exponent) for v in self.lines), strict=True)))

    @cached_property
    def idle_between(self) -> tuple[float, float]:
        return tuple(map(sum, zip(*(v.idle(self.discount) for v in self.lines), strict=True)))

    @cached_property
    def tables(self) -> list[torch.Tensor]:
        return [torch.as_tensor(line.value(self.discount, self.exponent)) for line in self.lines]

    def formula(self, x):
        """`V*` interpolated between the nodes of the grids."""
        total = 0.0
        for k, table in enumerate(self.tables):
            at = x[:, k].remainder(1.0) * len(table)
            node = at.detach().floor().long() % len(table)
            low, high = table.to(x)[node], table.to(x)[(node + 1) % len(table)]
            total = total + low + (high - low) * (at - node)
        return total


def waves(count: int, seed: int = 0, size: float = 0.5):
    """A rough cost, at least 0: `count` harmonics with random phases."""
    phase = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    k = torch.arange(1, count + 1, dtype=torch.float64)

    def f(y):
        angle = TURN * (k.to(y) * y.unsqueeze(-1) + phase.to(y))
        return 1.0 + size * angle.sin().sum(dim=-1) / count**0.5 + size * (count**0.5 - 1.0)

    return f


def dip(centre: float = 0.37, width: float = 0.05, depth: float = 1.0, level: float = 1.0):
    """A smooth well in a plain."""
    return lambda y: level - depth * (-0.5 * (short_way(y, centre) / width).square()).exp()


def spike(centre: float = 0.62, sigma: float = 0.0025, mass: float = 0.2, level: float = 1.0):
    return lambda y: level + mass * gaussian(y.unsqueeze(-1), [centre], sigma)


def step(low: float = 0.2, high: float = 1.0):
    return lambda y: torch.where((y > 0.25) & (y < 0.55), low, high).to(y)


def sink(at: float = 0.3, strength: float = 1.0):
    """A smooth drift that contracts onto ``at`` at the rate ``strength``."""
    return lambda y: -strength * (TURN * (y - at)).sin() / TURN


def jump(at: float = 0.3, speed: float = 0.4):
    return lambda y: torch.where(short_way(y, at) > 0.0, -speed, speed).to(y) * (math.pi * (y - at)).cos().square()


def still(y):
    return torch.zeros_like(y)


def half_moved(y):
    """Moves one half of the circle only, smoothly."""
    return (TURN * y).sin().clamp_min(0.0).square()


def flat(level: float = 0.7):
    return lambda y: torch.full_like(y, level)


# Every one builds a problem with `truth`, an enclosure of OPT, `idle_between`, one of what doing nothing costs, and
# `formula`, about V*.
FAMILY = {
    "hole 1-d": lambda: Hole(1, 0.0025),
    "hole 2-d": lambda: Hole(2, 0.0025),
    "hole 2-d wide": lambda: Hole(2, 0.05),
    "hole 2-d q=1.2": lambda: Hole(2, 0.004, q=1.2, discount=6.0),
    "hole 2-d rho=0.5": lambda: Hole(2, 0.003, discount=0.5),
    "hole 3-d q=1.5": lambda: Hole(3, 0.02, q=1.5, discount=6.0),
    "hole 5-d": lambda: Hole(5, 0.05),
    "hole rho=50": lambda: Hole(2, 0.002, discount=50.0),
    "hole rho=0.05": lambda: Hole(1, 0.002, discount=0.05),
    "well q=1.2": lambda: Lines(Line(dip(width=0.03)), q=1.2),
    "well rho=0.05": lambda: Lines(Line(dip()), Line(dip(0.8)), discount=0.05),
    "well rho=50": lambda: Lines(Line(dip()), Line(dip(0.8)), discount=50.0),
    "narrow start": lambda: Lines(Line(dip(), start=(0.52, 0.004))),
    "narrow start 2-d": lambda: Lines(Line(dip(), start=(0.52, 0.004)), Line(dip(0.1), start=(0.9, 0.01))),
    "narrow start 4-d": lambda: Lines(*(Line(dip(0.2 * k), start=(0.3 * k, 0.02)) for k in range(4))),
    "needle start 1-d": lambda: Lines(Line(dip(), start=(0.52, 1e-5))),
    "rough": lambda: Lines(Line(waves(24))),
    "rough 3-d": lambda: Lines(Line(waves(12)), Line(waves(20, 1)), Line(waves(30, 2))),
    "step": lambda: Lines(Line(step())),
    "step 2-d": lambda: Lines(Line(step(0.0)), Line(step(1.0, 0.3))),
    "spike": lambda: Lines(Line(spike())),
    "spike 2-d": lambda: Lines(Line(spike(sigma=0.0025)), Line(spike(0.1, 0.001))),
    "spike on waves with a drift": lambda: Lines(Line(spike(mass=0.5), sink(0.1, 0.5))),
    "spike that nothing moves": lambda: Lines(Line(spike(mass=0.5), lambda y: torch.full_like(y, 0.3), still)),
    "sink": lambda: Lines(Line(dip(0.5), sink(0.3, 6.0))),
    "sink that nothing moves": lambda: Lines(Line(dip(0.5), sink(0.3, 6.0), still)),
    "sink in a spike": lambda: Lines(Line(spike(0.3, 0.004, 0.5), sink(0.3, 6.0), still)),
    "sink in a spike, moved": lambda: Lines(Line(spike(0.3, 0.004, 0.05), sink(0.3, 6.0))),
    "sink in a needle": lambda: Lines(Line(dip(0.3, 0.002), sink(0.3, 3.0), still)),
    "jump": lambda: Lines(Line(dip(0.5), jump())),
    "jump that nothing moves": lambda: Lines(Line(dip(0.5), jump(), still)),
    "jump 2-d": lambda: Lines(Line(dip(0.5), jump()), Line(dip(0.1))),
    "half moved": lambda: Lines(Line(dip(0.8, 0.1), None, half_moved)),
    "half moved with a drift": lambda: Lines(Line(dip(0.8, 0.1), sink(0.1), half_moved)),
    "nothing moves": lambda: Lines(Line(waves(5), lambda y: 0.3 + 0.1 * (TURN * y).cos(), still)),
    "rank 1 of 3": lambda: Lines(Line(dip()), Line(waves(4), sink(), still), Line(dip(0.1), sink(0.6, 3.0), still)),
    "rank 2 of 5": lambda: Lines(
        Line(dip()),
        Line(waves(3), sink(), still),
        Line(step(), None, half_moved),
        Line(dip(0.1), sink(0.6, 3.0), still),
        Line(flat(0.0), None, still),
    ),
    "flat": lambda: Lines(Line(flat()), Line(flat(0.0))),
    "flat 5-d": lambda: Lines(*(Line(flat()) for _ in range(5))),
    "flat with a drift": lambda: Lines(Line(flat(), sink(0.3, 3.0)), Line(flat())),
    "dear": lambda: Lines(Line(dip(width=0.1, depth=1e3, level=1e3))),
    "cheap": lambda: Lines(Line(dip(width=0.1, depth=1e-4, level=1e-4))),
}
