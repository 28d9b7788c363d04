r"""A problem in which everything is prescribed first, and the drift and the cost are derived from it.

Choose periodic `V0`, `B`, `sigma`, `q`, and densities `mu0`, `mu* > 0`. Then `u* = grad R*(-B^T grad V0 / rho)`; the flux
`F = rho grad(phi) + h`, with `Laplace(phi) = mu0 - mu*` and `div h = 0`, satisfies `mu0 = mu* + div(F) / rho`; it is
`g* mu* - div(D mu*)` of the closed loop `g*`, so the drift is `a = g* - B u*`, and the cost
`f = V0 - (grad V0 . g* + D : hess V0) / rho - |u*|^q / q + c` makes the Hamilton-Jacobi-Bellman equation hold with
`V* = V0 + c`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_flag, require_integer, require_number
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.supremum import batched, extremes, supremum
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.exact.trigonometric import (
    TrigonometricField,
    TrigonometricPolynomial,
    WavyMatrix,
    random_polynomial,
)
from ocp_torch.problems.problem import Problem, VectorFields
from ocp_torch.problems.samples import driven

# States searched for the extrema of u* and f: the truth claimed is as exact as these extrema.
SEARCH_POINTS = 2**14
ASCENTS = 64  # from the best of these states
ASCENT_STEPS = 100  # of each

# Methods that share one evaluation, unless a subclass overrides one of them.
TOGETHER = ("state_cost", "drift", "control_matrix", "drift_divergence", "control_divergence")


class Parts(NamedTuple):
    """Intermediate results that cost, drift and divergences at the same states share."""

    B: Tensor  # (N, d, m)
    V: Tensor  # (N,) V0
    slope: Tensor  # (N, d) grad V0
    density: Tensor  # (N,) mu*
    thinning: Tensor  # (N, d) grad mu*
    pull: Tensor  # (N, m) -B^T grad V0 / rho
    u: Tensor  # (N, m) u*
    loop: Tensor  # (N, d) the closed loop g* = (F + div(D mu*)) / mu*


class Manufactured(Problem):
    r"""`V*`, `u*`, `mu*`, `w*`, `OPT = c + int V0 dmu0` and `sup mu* = 1 + contrast` are all exact.

    ``control_dim <= dim`` (default ``dim``); ``drift_size`` is the amplitude of the divergence-free part of the flux (on
    the command line ``problem.drift``); ``control_size`` the largest `|u*|`; ``contrast`` in [0, 1) that of `mu*`, and
    ``initial_contrast`` that of `mu0`; with ``state_dependent_control`` each entry of `B` varies with one coordinate;
    ``noise`` is that of `Problem`, and with ``state_dependent_noise`` `sigma` is a full matrix that varies like `B`, of about
    that size; ``interaction`` is how many coordinates one trigonometric term couples; ``seed`` draws all coefficients. With a
    ``control_limit``, or one of a list, below ``control_size``, which is then the largest control an unlimited optimum would
    use, `u*` stays at the limit on a part of the torus, and everything is as exact as before. Raises `InputError` for
    wrong arguments.

    Attributes: trigonometric polynomials ``V0``, ``mu`` (`mu*`), ``mu0``, ``phi`` and ``stream`` (the components of `h`); the
    matrix ``B``; and the number ``c``.
    """

    def __init__(
        self,
        dim: int = 2,
        control_dim: int | None = None,
        exponent: float = 2.0,
        discount: float = 2.0,
        drift: float = 0.3,
        control_size: float = 1.0,
        contrast: float = 0.5,
        initial_contrast: float = 0.0,
        state_dependent_control: bool = False,
        interaction: int = 2,
        seed: int = 0,
        control_limit: Limit = None,
        noise: float | Sequence[float] = 0.0,
        state_dependent_noise: bool = False,
    ) -> None:
        super().__init__(dim, control_dim, discount, exponent, control_limit, noise)
        if self.control_dim > self.dim:
            raise InputError(f"problem.control_dim is {control_dim}, but must be at most problem.dim = {dim}.")
        self.drift_size = require_number("problem.drift", drift, at_least=0.0)
        self.control_size = require_number("problem.control_size", control_size, above=0.0)
        self.contrast = require_number("problem.contrast", contrast, at_least=0.0, at_most=0.99)
        self.initial_contrast = require_number("problem.initial_contrast", initial_contrast, at_least=0.0, at_most=1.0)
        self.state_dependent_control = require_flag("problem.state_dependent_control", state_dependent_control)
        self.state_dependent_noise = require_flag("problem.state_dependent_noise", state_dependent_noise)
        self.interaction = require_integer("problem.interaction", interaction, 1, maximum=max(2, self.dim))
        self.seed = require_integer("problem.seed", seed, 0)
        self._prescribe(torch.Generator().manual_seed(self.seed))
        self._derive()

    @property
    def driftless(self) -> bool:
        return False

    @property
    def limited(self) -> bool:
        """Whether `u*` is at the limit anywhere."""
        return bool((self.control_size > torch.as_tensor(self.control_cost.sides)).any())

    def _prescribe(self, generator: torch.Generator) -> None:
        """Draw `V0`, `mu*`, `mu0`, `h` and `B`."""
        d, terms = self.dim, max(3, 2 * self.dim)
        draw = lambda peak=None: random_polynomial(d, self.interaction, terms, generator, peak)
        peak = torch.rand(d, generator=generator, dtype=torch.float64)
        self.V0 = draw()
        self.mu = replace(draw(peak).scaled(self.contrast), constant=1.0)
        peak = torch.rand(d, generator=generator, dtype=torch.float64)
        self.mu0 = replace(draw(peak).scaled(self.initial_contrast), constant=1.0)
        self.phi = self.mu0.minus(self.mu).inverse_laplacian()
        self.stream = TrigonometricField([self._stream_component(i, generator) for i in range(d)])
        self.B = WavyMatrix(d, self.control_dim, self.state_dependent_control, generator)
        self.sigma = None
        if self.diffusion is not None and self.state_dependent_noise:
            self.sigma = WavyMatrix(d, d, True, generator)
            self.sigma.mean *= torch.tensor(self.diffusion, dtype=torch.float64).mul(2.0).sqrt().unsqueeze(-1)

    def _stream_component(self, i: int, generator: torch.Generator) -> TrigonometricPolynomial:
        """`h_i`, which does not depend on coordinate `i`: half constant, half wave; `|h| <= drift`."""
        size = self.drift_size / self.dim**0.5
        sign = 2.0 * float(torch.randint(2, (), generator=generator)) - 1.0
        if self.dim == 1:
            none = torch.zeros(0, dtype=torch.float64)
            return TrigonometricPolynomial(none.reshape(0, 1), none, none, sign * size)
        part = random_polynomial(self.dim - 1, self.interaction, self.dim, generator).scaled(0.5 * size)
        left, right = part.waves[:, :i], part.waves[:, i:]
        waves = torch.cat([left, torch.zeros_like(part.waves[:, :1]), right], dim=1)
        return replace(part, waves=waves, constant=0.5 * sign * size)

    def _derive(self) -> None:
        """Scale `V0` so that `sup |u*| = control_size`, then find the smallest `c` with `f >= 0`, and the bounds."""
        points = scrambled_sobol(SEARCH_POINTS, self.dim, 0, torch.float64)
        pull = lambda x: self._pull_back(self.B(x), self.V0.gradient(x))
        steepest = supremum(lambda x: pull(x).norm(dim=-1), points, ASCENTS, ASCENT_STEPS).value
        if steepest <= 0.0:
            raise InputError(
                f"problem.seed = {self.seed} gives a value function the control cannot change; take another."
            )
        self.V0 = self.V0.scaled(self.control_size ** (self.exponent - 1.0) / steepest)
        self.c = 0.0
        ends = extremes(self.state_cost, points, batched(self.state_cost, points), ASCENTS, ASCENT_STEPS)
        costs = batched(self.state_cost, ends)
        self.c = -float(costs.min())
        self.state_cost_bound = float(costs.max()) + self.c
        self.value_bound = self.c + float(self.V0.amplitudes.abs().sum())
        self.control_bound = min(self.control_size, self.control_cost.reach)
        self.occupation_bound = 1.0 + self.contrast
        # Both V0 and mu0 are trigonometric polynomials: their product integrates mode against mode.
        self.exact_optimum = self.c + self.V0.integral_with(self.mu0)

    def _pull_back(self, B: Tensor, slope: Tensor) -> Tensor:
        """`-B^T grad V0 / rho`, ``(N, m)``."""
        return -torch.einsum("ndm,nd->nm", B, slope) / self.discount

    def _at(self, x: Tensor) -> Parts:
        """The intermediate results at states ``x`` ``(N, d)``."""
        B, (V, slope), (density, thinning) = self.B(x), self.V0.with_gradient(x), self.mu.with_gradient(x)
        pull = self._pull_back(B, slope)
        flux, sigma = self.discount * self.phi.gradient(x) + self.stream(x), self.noise(x)
        if sigma is not None:
            div_D, _ = self.noise_divergences(x)
            driven = torch.einsum("ndk,nd->nk", sigma, thinning)
            flux = flux + div_D * density.unsqueeze(-1) + 0.5 * torch.einsum("ndk,nk->nd", sigma, driven)
        loop = flux / density.unsqueeze(-1)
        return Parts(B, V, slope, density, thinning, pull, self.control_cost.argmax(pull), loop)

    def _curvature(self, function: TrigonometricPolynomial, x: Tensor) -> Tensor:
        """`D : hess` of ``function``, ``(N,)``; 0 where there is no noise."""
        sigma = self.noise(x)
        if sigma is None:
            return torch.zeros_like(x[:, 0])
        return 0.5 * torch.einsum("nik,nij,njk->n", sigma, function.hessian(x), sigma)

    def noise(self, x: Tensor) -> Tensor | None:
        return super().noise(x) if self.sigma is None else self.sigma(x)

    def noise_divergences(self, x: Tensor) -> tuple[Tensor, Tensor]:
        if self.sigma is None:
            return torch.zeros_like(x), torch.zeros_like(x[:, 0])
        return self.sigma.square_divergences(x)

    def state_cost(self, x: Tensor) -> Tensor:
        return self._cost(x, self._at(x))

    def drift(self, x: Tensor) -> Tensor:
        return self._drift(self._at(x))

    def drift_divergence(self, x: Tensor) -> Tensor:
        return self._drift_divergence(x, self._at(x))

    def vector_fields(self, x: Tensor, divergences: bool = True) -> VectorFields:
        return self.cost_and_fields(x, divergences)[1]

    def cost_and_fields(self, x: Tensor, divergences: bool = True) -> tuple[Tensor, VectorFields]:
        if any(getattr(getattr(self, name), "__func__", None) is not getattr(Manufactured, name) for name in TOGETHER):
            return self.state_cost(x), super().vector_fields(x, divergences)  # a subclass overrides one of them
        parts = self._at(x)
        known = (self._drift_divergence(x, parts), self.control_divergence(x)) if divergences else (None, None)
        return self._cost(x, parts), (self._drift(parts), parts.B, *known)

    def _cost(self, x: Tensor, parts: Parts) -> Tensor:
        along = (parts.slope * parts.loop).sum(dim=-1) + self._curvature(self.V0, x)
        return parts.V - along / self.discount - self.control_cost.cost(parts.u) + self.c

    def _drift(self, parts: Parts) -> Tensor:
        return driven(parts.loop, parts.B, -parts.u)

    def _drift_divergence(self, x: Tensor, parts: Parts) -> Tensor:
        """`div a = div g* - div(B u*)`, with `div g* = (rho (mu0 - mu*) + div div(D mu*) - grad mu* . g*) / mu*`."""
        density, slope = parts.density, parts.thinning
        outflow = self.discount * (self.mu0(x) - density) - (slope * parts.loop).sum(dim=-1)
        if self.noisy:
            div_D, div_div_D = self.noise_divergences(x)
            outflow = outflow + self._curvature(self.mu, x) + 2.0 * (div_D * slope).sum(dim=-1) + density * div_div_D
        return outflow / density - self._pushed_divergence(x, parts)

    def _pushed_divergence(self, x: Tensor, parts: Parts) -> Tensor:
        """`div(B u*) = (div B) . u* + sum_k (d u*_k along column k of B)`, ``(N,)``, in closed form."""
        # Jacobian of p = -B^T grad V0 / rho, entry (k, j) along coordinate j, from that of grad V0 and that of B.
        jacobian = torch.einsum("nik,nij->nkj", parts.B, self.V0.hessian(x))
        moving = self.B.slopes(x) * parts.slope.unsqueeze(-1)
        jacobian = -(jacobian + torch.einsum("nik,ikj->nkj", moving, self.B.directions(x))) / self.discount
        moved = self.control_cost.argmax_along(parts.pull, jacobian)
        return (self.control_divergence(x) * parts.u).sum(dim=-1) + torch.einsum("njk,nkj->n", parts.B, moved)

    def control_matrix(self, x: Tensor) -> Tensor:
        return self.B(x)

    def control_divergence(self, x: Tensor) -> Tensor:
        return self.B.divergence(x)

    def initial_density(self, x: Tensor) -> Tensor:
        return self.mu0(x)

    def exact_value(self, x: Tensor) -> Tensor:
        return self.V0(x) + self.c

    def exact_control(self, x: Tensor) -> Tensor:
        return self.control_cost.argmax(self._pull_back(self.B(x), self.V0.gradient(x)))

    def exact_occupation(self, x: Tensor) -> Tensor:
        return self.mu(x)
