r"""A problem in which everything is prescribed first, and the drift and the cost are derived from it.

Choose periodic `V0`, `B`, `q`, and densities `mu0`, `mu* > 0`. Then `u* = grad R*(-B^T grad V0 / rho)`; the flux
`F = rho grad(phi) + h`, with `Laplace(phi) = mu0 - mu*` and `div h = 0`, satisfies Liouville's equation
`mu0 = mu* + div(F) / rho`; the closed loop is `g* = F / mu*`, the drift `a = g* - B u*`, and the cost
`f = V0 - grad V0 . g* / rho - |u*|^q / q + c` makes the Hamilton-Jacobi-Bellman equation hold with `V* = V0 + c`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_flag, require_integer, require_number
from ocp_torch.maths.enclosure import Enclosure
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.supremum import supremum
from ocp_torch.maths.taylor import Box, TaylorModel
from ocp_torch.problems.control_cost import norm_power
from ocp_torch.problems.exact.trigonometric import TrigonometricPolynomial, random_polynomial
from ocp_torch.problems.problem import Problem

# States searched for the extrema of u* and f, before local ascent.
SEARCH_POINTS = 2**14


class Manufactured(Problem):
    r"""`V*`, `u*`, `mu*`, `w*`, `OPT = c + int V0 dmu0` and `sup mu* = 1 + contrast` are all exact.

    ``control_dim <= dim`` (default ``dim``); ``drift_size`` is the amplitude of the divergence-free part of the flux (on
    the command line ``problem.drift``); ``control_size`` the largest `|u*|`; ``contrast`` in [0, 1) that of `mu*`, and
    ``initial_contrast`` that of `mu0`; with ``state_dependent_control`` each entry of `B` varies with one coordinate;
    ``interaction`` is how many coordinates one trigonometric term couples; ``seed`` draws all coefficients. With a
    ``control_limit`` below ``control_size``, which is then the largest control an unlimited optimum would use, `u*` stays
    at the limit on a part of the torus, and everything is as exact as before.
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
        control_limit: float | None = None,
    ) -> None:
        super().__init__(
            dim=dim, control_dim=control_dim, discount=discount, exponent=exponent, control_limit=control_limit
        )
        if self.control_dim > self.dim:
            raise InputError(f"problem.control_dim is {control_dim}, but must be at most problem.dim = {dim}.")
        self.drift_size = require_number("problem.drift", drift, at_least=0.0)
        self.control_size = require_number("problem.control_size", control_size, above=0.0)
        self.contrast = require_number("problem.contrast", contrast, at_least=0.0, at_most=0.99)
        self.initial_contrast = require_number("problem.initial_contrast", initial_contrast, at_least=0.0, at_most=1.0)
        self.state_dependent_control = require_flag("problem.state_dependent_control", state_dependent_control)
        self.interaction = require_integer("problem.interaction", interaction, 1, maximum=max(2, self.dim))
        self.seed = require_integer("problem.seed", seed, 0)
        self._prescribe(torch.Generator().manual_seed(self.seed))
        self._derive()

    @property
    def parameters(self) -> dict:
        return {**super().parameters, "drift": self.drift_size}

    @property
    def driftless(self) -> bool:
        return False

    @property
    def limited(self) -> bool:
        """Whether `u*` is at the limit anywhere."""
        return self.control_limit is not None and self.control_limit < self.control_size

    def _prescribe(self, generator: torch.Generator) -> None:
        """Draw `V0`, `mu*`, `mu0`, `h` and `B`."""
        d, m, terms = self.dim, self.control_dim, max(3, 2 * self.dim)
        draw = lambda peak=None: random_polynomial(d, self.interaction, terms, generator, peak)
        peak = torch.rand(d, generator=generator, dtype=torch.float64)
        self._V0 = draw()
        self._mu = draw(peak).scaled(self.contrast)
        self._mu.constant = 1.0
        self._mu0 = draw(torch.rand(d, generator=generator, dtype=torch.float64)).scaled(self.initial_contrast)
        self._mu0.constant = 1.0
        self._phi = self._mu0.minus(self._mu).inverse_laplacian()
        self._stream = [self._stream_component(i, generator) for i in range(d)]
        mix = torch.randn(d, m, generator=generator, dtype=torch.float64)
        self._B0 = torch.eye(d, m, dtype=torch.float64) + 0.25 * mix / d**0.5
        self._B_phase = torch.rand(d, m, generator=generator, dtype=torch.float64)
        self._B_coordinate = torch.randint(d, (d, m), generator=generator)

    def _stream_component(self, i: int, generator: torch.Generator) -> TrigonometricPolynomial:
        """`h_i`, which does not depend on coordinate `i`: half constant, half wave; `|h| <= drift`."""
        size = self.drift_size / self.dim**0.5
        sign = 2.0 * float(torch.randint(2, (), generator=generator)) - 1.0
        if self.dim == 1:
            none = torch.zeros(0, dtype=torch.float64)
            return TrigonometricPolynomial(none.reshape(0, 1), none, none, sign * size)
        part = random_polynomial(self.dim - 1, self.interaction, self.dim, generator).scaled(0.5 * size)
        left, right = part.waves[:, :i], part.waves[:, i:]
        part.waves = torch.cat([left, torch.zeros(len(left), 1, dtype=torch.float64), right], dim=1)
        part.constant = 0.5 * sign * size
        return part

    def _derive(self) -> None:
        """Scale `V0` so that `sup |u*| = control_size`, then find the smallest `c` with `f >= 0`, and the bounds."""
        points = scrambled_sobol(SEARCH_POINTS, self.dim, 0, torch.float64)
        push = lambda x: self._pull_back(x).norm(dim=-1)
        steepest = supremum(push, points, ascents=64, steps=100).value
        if steepest <= 0.0:
            raise InputError(
                f"problem.seed = {self.seed} gives a value function the control cannot change; take another."
            )
        self._V0 = self._V0.scaled(self.control_size ** (self.exponent - 1.0) / steepest)
        self._c = 0.0
        self._c = supremum(lambda x: -self.state_cost(x), points, ascents=64, steps=100).value
        self.state_cost_bound = supremum(self.state_cost, points, ascents=64, steps=100).value
        self.value_bound = self._c + float(self._V0.amplitudes.abs().sum())
        self.control_bound = self.control_limit if self.limited else self.control_size
        self.occupation_bound = 1.0 + self.contrast
        # Both V0 and mu0 are trigonometric polynomials: their product integrates mode against mode.
        self.exact_optimum = self._c + _integral_of_product(self._V0, self._mu0)

    def _pull_back(self, x: Tensor) -> Tensor:
        """`-B^T grad V0 / rho`, ``(N, m)``."""
        return -torch.einsum("ndm,nd->nm", self.control_matrix(x), self._V0.gradient(x)) / self.discount

    def _closed_loop(self, x: Tensor) -> Tensor:
        """`g* = F / mu*`, ``(N, d)``."""
        flux = self.discount * self._phi.gradient(x) + torch.stack([h(x) for h in self._stream], dim=-1)
        return flux / self._mu(x).unsqueeze(-1)

    def state_cost(self, x: Tensor) -> Tensor:
        along = (self._V0.gradient(x) * self._closed_loop(x)).sum(dim=-1) / self.discount
        return self._V0(x) - along - self.control_cost.cost(self.exact_control(x)) + self._c

    def drift(self, x: Tensor) -> Tensor:
        pushed = torch.einsum("ndm,nm->nd", self.control_matrix(x), self.exact_control(x))
        return self._closed_loop(x) - pushed

    def drift_divergence(self, x: Tensor) -> Tensor:
        """`div a = div g* - div(B u*)`, with `div g* = (rho (mu0 - mu*) - grad mu* . g*) / mu*` by Liouville's equation."""
        density = self._mu(x)
        outflow = self.discount * (self._mu0(x) - density) - (self._mu.gradient(x) * self._closed_loop(x)).sum(dim=-1)
        return outflow / density - self._pushed_divergence(x)

    def _pushed_divergence(self, x: Tensor) -> Tensor:
        """`div(B u*) = (div B) . u* + sum_k (d u*_k along column k of B)`, ``(N,)``, in closed form."""
        B, dB = self.control_matrix(x), self._control_matrix_slopes(x)
        p, u = self._pull_back(x), self.exact_control(x)
        # Jacobian of p = -B^T grad V0 / rho: entry (k, i) along coordinate i; B_ik varies with one coordinate only.
        jacobian = torch.einsum("nik,nij->nkj", B, self._V0.hessian(x))
        moving = dB * self._V0.gradient(x).unsqueeze(-1)
        hot = torch.nn.functional.one_hot(self._B_coordinate.to(x.device), self.dim).to(x)
        jacobian = -(jacobian + torch.einsum("nik,ikj->nkj", moving, hot)) / self.discount
        # D grad R*(p) = |p|^{q'-2} (I + (q'-2) n n^T) with n = p / |p|; at the limit c it is (c / |p|) (I - n n^T).
        power = self.control_cost.conjugate_exponent - 2.0
        direction = torch.nn.functional.normalize(p, dim=-1, eps=1e-30)
        scale = norm_power(p, power) if power > 0.0 else torch.ones_like(p[:, 0])
        radial = torch.full_like(scale, power)
        if self.limited:
            size = p.norm(dim=-1)
            at_limit = size > self.control_limit ** (self.exponent - 1.0)
            scale = torch.where(at_limit, self.control_limit / size.clamp_min(1e-30), scale)
            radial = torch.where(at_limit, -1.0, radial)
        along = torch.einsum("nk,nkj->nj", direction, jacobian).unsqueeze(1)
        bent = jacobian + radial[:, None, None] * direction.unsqueeze(-1) * along
        return (self.control_divergence(x) * u).sum(dim=-1) + scale * torch.einsum("njk,nkj->n", B, bent)

    def control_matrix(self, x: Tensor) -> Tensor:
        B0 = self._like(x, "B0", self._B0)
        if not self.state_dependent_control:
            return B0.expand(len(x), -1, -1)
        return B0 * (1.0 + 0.3 * self._B_angle(x).cos())

    def control_divergence(self, x: Tensor) -> Tensor:
        own = self._B_coordinate.to(x.device) == torch.arange(self.dim, device=x.device).unsqueeze(-1)
        return (self._control_matrix_slopes(x) * own).sum(dim=1)

    def _B_angle(self, x: Tensor) -> Tensor:
        return 2.0 * torch.pi * (x[:, self._B_coordinate.to(x.device)] + self._like(x, "phase", self._B_phase))

    def _control_matrix_slopes(self, x: Tensor) -> Tensor:
        """The derivative of each entry of `B` along the one coordinate it varies with, ``(N, d, m)``."""
        if not self.state_dependent_control:
            return x.new_zeros(len(x), self.dim, self.control_dim)
        return -0.6 * torch.pi * self._like(x, "B0", self._B0) * self._B_angle(x).sin()

    def initial_density(self, x: Tensor) -> Tensor:
        return self._mu0(x)

    def enclosure(self, box: Box) -> Enclosure | None:
        """The formulas of `state_cost` and `drift` in Taylor models; the optimal control near its zeros by its size alone.

        `None` where `u*` is clipped: there are no models of its kinks yet.
        """
        if self.limited:
            return None
        rho, q, conjugate = self.discount, self.exponent, self.control_cost.conjugate_exponent
        V0, slope = self._V0.model(box), self._V0.gradient_model(box)
        mu, mu0 = self._mu.model(box), self._mu0.model(box)
        stream = TaylorModel.stack([h.model(box) for h in self._stream])
        closed_loop = (self._phi.gradient_model(box) * rho + stream) * mu.reciprocal()[..., None]
        B = self._control_matrix_model(box)
        pull = (B * slope[..., None]).sum(dim=-2) * (-1.0 / rho)
        squares = (pull * pull).sum()
        u = pull if q == 2.0 else pull * squares.power(0.5 * conjugate - 1.0)[..., None]
        cost = squares.power(0.5 * conjugate) * (1.0 / q)
        f = V0 - (slope * closed_loop).sum() * (1.0 / rho) - cost + self._c
        return Enclosure(f, closed_loop - (B * u[None]).sum(), B, mu0)

    def _control_matrix_model(self, box: Box) -> TaylorModel:
        B0 = self._B0.to(box.centre).expand(len(box), -1, -1)
        if not self.state_dependent_control:
            return box.constant(B0)
        waves = torch.nn.functional.one_hot(self._B_coordinate, self.dim).to(box.centre).flatten(0, 1)
        waved = box.cosine(waves, 2.0 * torch.pi * self._B_phase.to(box.centre).flatten())
        return (waved * 0.3 + 1.0).reshape(*self._B0.shape) * B0

    def exact_value(self, x: Tensor) -> Tensor:
        return self._V0(x) + self._c

    def exact_control(self, x: Tensor) -> Tensor:
        return self.control_cost.argmax(self._pull_back(x))

    def exact_occupation(self, x: Tensor) -> Tensor:
        return self._mu(x)


def _integral_of_product(p: TrigonometricPolynomial, q: TrigonometricPolynomial) -> float:
    """`int p q` over the torus: cosines of different wave vectors are orthogonal, equal or opposite ones are not."""
    total = p.constant * q.constant
    for k, b, theta in zip(p.waves, p.amplitudes, p.phases, strict=True):
        for l, c, eta in zip(q.waves, q.amplitudes, q.phases, strict=True):
            if torch.equal(k, l):
                total += 0.5 * float(b * c * torch.cos(theta - eta))
            elif torch.equal(k, -l):
                total += 0.5 * float(b * c * torch.cos(theta + eta))
    return total
