r"""A discounted control-affine problem on the unit torus, known through evaluations at batches of states.

minimise  rho E int_0^inf e^{-rho t} (f(x_t) + |u_t|^q / q) dt,   dx = (a(x) + B(x) u) dt + sigma(x) dW,   x_0 ~ mu0
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_integer, require_number
from ocp_torch.maths import jets
from ocp_torch.maths.mixtures import Mixture
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.constant_noise import column_matrix, constant_diffusion
from ocp_torch.problems.control_limit import Limit, control_cost
from ocp_torch.problems.device_constants import DeviceConstants
from ocp_torch.problems.gymnasium_adapter import GymnasiumAdapter
from ocp_torch.problems.lipschitz import Lipschitz
from ocp_torch.problems.physical.measures import Measures
from ocp_torch.problems.replaced import replaced
from ocp_torch.problems.reproducible import Reproducible
from ocp_torch.problems.samples import Samples, driven

# With more coordinates and controls `B` alone would take over 8 GB for a batch of a thousand states.
MOST_COORDINATES = 1024
# Discounts per unit of time outside this range are taken for a mistake in the unit.
LEAST_DISCOUNT = 1e-6
LARGEST_DISCOUNT = 1e6
# Head-room on a sampled supremum that is used as a bound, since a search meets less than the supremum.
MARGIN = 1.05
# States scanned for narrow features of a user's own functions, for each state at which a bound is evaluated.
SCAN_FACTOR = 32


def shipped(kind: type) -> bool:
    """Whether a class is one of the package's own, which its tests vouch for."""
    return kind.__module__.startswith("ocp_torch.")


# `a` (N, d), `B` (N, d, m), `div a` (N,) and `div B` (N, m).
VectorFields = tuple[Tensor, Tensor, Tensor | None, Tensor | None]


class Problem(Reproducible, DeviceConstants, GymnasiumAdapter):
    """Base class: override `state_cost`, and whatever else differs from `dx/dt = u` with a uniform start.

    All methods are batched, take states ``(N, d)``, work in the precision and on the device of their argument, and have
    period 1 in each coordinate. Arguments of `__init__`: ``dim`` is `d`, ``control_dim`` is `m` (default `d`),
    ``discount`` is `rho > 0` (per unit time), ``exponent`` is `q` in (1, 2], ``control_limit`` is `c > 0` where controls
    must satisfy `|u| <= c` (Euclidean), a list of `m` numbers where each `|u_i| <= c_i` (for `q = 2`), else `None`;
    ``noise`` is `nu >= 0`, or one for each coordinate, where Brownian motions spread the state (`D = nu`, torus units
    squared per unit time). Raises `InputError` outside these ranges.

    Attributes a subclass may set, each `None` where unknown: ``state_cost_bound >= sup f``; ``occupation_bound >= sup
    mu*`` (`math.inf` when known to be unbounded); ``control_bound >= sup |u*|``; ``value_bound >= sup V*``;
    ``exact_optimum``, the number `OPT`; ``lipschitz``, constants of the data (`Lipschitz`), from which a lower bound can be
    proved in one and two dimensions (a class may have sharper models: see `ocp_torch.certificate.proof.enclosures`).
    """

    # Whether the functions can be called at any state; a data set knows them at its own samples only (see `samples`).
    has_simulator: bool = True
    # Whether the control matrix can be called at any state, which the controller from V needs.
    knows_control_matrix: bool = True
    # Arguments that say where the data come from, not what they are: another run may give others.
    incidental: tuple[str, ...] = ()
    # Names and units of coordinates and controls, where they have some.
    measures: Measures | None = None
    # Facts that a subclass may declare, in its body, in its `__init__` or after it.
    state_cost_bound: float | None = None
    occupation_bound: float | None = None
    control_bound: float | None = None
    value_bound: float | None = None
    exact_optimum: float | None = None
    lipschitz: Lipschitz | None = None

    def __init__(
        self,
        dim: int,
        control_dim: int | None = None,
        discount: float = 2.0,
        exponent: float = 2.0,
        control_limit: Limit = None,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        self.dim = require_integer("problem.dim", dim, 1, maximum=MOST_COORDINATES)
        controls = self.dim if control_dim is None else control_dim
        self.control_dim = require_integer("problem.control_dim", controls, 1, maximum=MOST_COORDINATES)
        within = dict(at_least=LEAST_DISCOUNT, at_most=LARGEST_DISCOUNT)
        self.discount = require_number("problem.discount", discount, **within)
        self.exponent = require_number("problem.exponent", exponent, above=1.0, at_most=2.0)
        self.control_cost = control_cost(self.exponent, control_limit, self.control_dim)
        self.control_limit = self.control_cost.limit
        self.diffusion = constant_diffusion(noise, self.dim)
        self._sigma = column_matrix(self.diffusion)

    def state_cost(self, x: Tensor) -> Tensor:
        """Running state cost `f >= 0`, ``(N,)``. The one method every problem must override."""
        raise InputError(f"{type(self).__name__} must define state_cost(x), the running cost of shape (N,).")

    def drift(self, x: Tensor) -> Tensor:
        """Uncontrolled velocity `a`, ``(N, d)``, in torus units per unit time; zero unless overridden."""
        return torch.zeros_like(x)

    def control_matrix(self, x: Tensor) -> Tensor:
        """`B`, ``(N, d, m)``; by default control `k` moves coordinate `k`."""
        eye = torch.eye(self.dim, self.control_dim, dtype=x.dtype, device=x.device)
        return eye.expand(len(x), self.dim, self.control_dim)

    def noise(self, x: Tensor) -> Tensor | None:
        """`sigma`, ``(N, d, k)``, of `k` Brownian motions (Ito); `None` where there is no noise. By default that of the
        argument ``noise`` and of `add_noise`. An override may be degenerate, and vary with the state; where such noise was
        given too, it returns the columns of `super().noise(x)` beside its own."""
        return None if self._sigma is None else self._like(x, "sigma", self._sigma).expand(len(x), -1, -1)

    def add_noise(self, columns: Tensor) -> None:
        """Add ``columns`` ``(d, k)``, torus units per square root of time, to those of `sigma`; for `__init__` alone.

        Each column is a Brownian motion of its own; zero columns are left out. More than `d` columns in all are replaced by
        `d` with the same `sigma sigma^T`: states have the same law, and there are fewer directions to differentiate along."""
        columns = columns.double()[:, columns.any(dim=0)]
        if columns.shape[1]:
            sigma = columns if self._sigma is None else torch.cat([self._sigma, columns], dim=1)
            self._sigma = sigma if sigma.shape[1] <= self.dim else torch.linalg.qr(sigma.T, mode="r").R.T

    @property
    def noisy(self) -> bool:
        """Whether there is noise."""
        return self.noise(torch.full((1, self.dim), 0.5, dtype=torch.float64)) is not None

    @property
    def still(self) -> bool:
        """Whether nothing moves without control: there is neither drift nor noise."""
        return self.driftless and not self.noisy

    def noise_divergences(self, x: Tensor) -> tuple[Tensor, Tensor] | None:
        """`div D` ``(N, d)``, with components `sum_j d_j D_ij`, and its divergence ``(N,)``, where there is noise: by
        autograd through `noise`. An override may give known formulas, or `None` where they are unknown."""
        constant = torch.zeros_like(x), torch.zeros_like(x[:, 0])
        return jets.diffusion_divergences(self.noise, x) if replaced(self, "noise", Problem) else constant

    def initial_density(self, x: Tensor) -> Tensor:
        """Density `mu0` of the initial state, ``(N,)``, with mean 1 over the torus; uniform unless overridden."""
        return torch.ones_like(x[:, 0])

    @property
    def initial_mixture(self) -> Mixture | None:
        """A density to draw starts from, of which `mu0` is nowhere a large multiple; `None` where one has to be fitted."""
        return None

    @property
    def scan_factor(self) -> int:
        """States scanned for narrow features of the data, for each state at which a bound is evaluated. 0 for the package's
        own problems, which have no narrower features than those states show."""
        return 0 if shipped(type(self)) else SCAN_FACTOR

    @property
    def concurrent(self) -> bool:
        """Whether two threads may call the functions at once, as pure functions of the state in PyTorch: true of the
        package's own problems. A subclass that returns `True` gets its certificates sooner."""
        return shipped(type(self))

    @property
    def copyable(self) -> bool:
        """Whether a copy of the process may call the functions meanwhile: not if they use something outside of it, such as
        another process."""
        return True

    @property
    def driftless(self) -> bool:
        """Whether `a = 0`: true exactly when `drift` is not replaced, unless a subclass knows better."""
        return not replaced(self, "drift", Problem)

    def drift_divergence(self, x: Tensor) -> Tensor | None:
        """`div a`, ``(N,)``: by autograd through `drift`. An override may give a known formula, or `None` where unknown."""
        return torch.zeros_like(x[:, 0]) if self.driftless else jets.divergence(self.drift, x)

    def control_divergence(self, x: Tensor) -> Tensor | None:
        """The divergence of each column of `B`, ``(N, m)``; by forward-mode autograd unless `B` is constant."""
        if not replaced(self, "control_matrix", Problem):
            return x.new_zeros(len(x), self.control_dim)
        basis = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        along = lambda e: torch.func.jvp(self.control_matrix, (x,), (e.expand_as(x),))[1]
        tangents = torch.func.vmap(along)(basis)  # (d, N, d, m): derivative of B along coordinate i
        return torch.einsum("inim->nm", tangents)

    def vector_fields(self, x: Tensor, divergences: bool = True) -> VectorFields:
        """The results of `drift`, `control_matrix`, `drift_divergence` and `control_divergence`, the last two `None` where
        unknown or without ``divergences``. An override may compute all of them from one evaluation."""
        div_a, div_B = (self.drift_divergence(x), self.control_divergence(x)) if divergences else (None, None)
        return self.drift(x), self.control_matrix(x), div_a, div_B

    def cost_and_fields(self, x: Tensor, divergences: bool = True) -> tuple[Tensor, VectorFields]:
        """`f` and `vector_fields`. An override may compute all of them from one evaluation."""
        return self.state_cost(x), self.vector_fields(x, divergences)

    @property
    def unknown_divergences(self) -> str:
        """The names of those of `a`, `B` and, where there is noise, `D` whose divergences are unknown, as in "a and B"."""
        x = torch.full((1, self.dim), 0.5, dtype=torch.float64)
        found: dict[str, object] = {"a": self.drift_divergence(x), "B": self.control_divergence(x)}
        found |= {"D": self.noise_divergences(x)} if self.noisy else {}
        return " and ".join(name for name, value in found.items() if value is None)

    @property
    def gives_divergences(self) -> bool:
        """Whether the divergences of `a`, `B` and, where there is noise, `D` are known."""
        return not self.unknown_divergences

    # Exact truth, where known: `None` otherwise.
    def exact_value(self, x: Tensor) -> Tensor | None:
        """`V*(x)`, ``(N,)``."""
        return None

    def exact_control(self, x: Tensor) -> Tensor | None:
        """`u*(x)`, ``(N, m)``."""
        return None

    def exact_occupation(self, x: Tensor) -> Tensor | None:
        """`mu*(x)`, ``(N,)``."""
        return None

    def samples(self, places: Tensor, divergences: bool = True) -> Samples:
        """The data at the ``places`` a sampler drew: states ``(N, d)``, unless the problem has a sampler of its own kind."""
        return Samples.of(self, places, divergences=divergences)

    @torch.no_grad()
    def probe(self, count: int, branch: int, *columns: str) -> tuple[Tensor, ...]:
        """``columns`` of `Samples` (x, f, a, B, mu0 or weight) at up to ``count`` states spread over the torus, in float64,
        to estimate sizes and bounds from."""
        x = scrambled_sobol(count, self.dim, branch, torch.float64)
        of = {"f": self.state_cost, "a": self.drift, "B": self.control_matrix, "mu0": self.initial_density}
        of |= {"x": lambda x: x, "weight": lambda x: torch.ones_like(x[:, 0])}
        return tuple(of[name](x) for name in columns)

    def independent_samples(self, count: int) -> Samples:
        """Data at up to ``count`` independent states, always the same ones: evenly spread states show waves that are not
        there."""
        x = torch.rand(count, self.dim, dtype=torch.float64, generator=fixed_generator())
        return Samples.of(self, x, divergences=False)

    @property
    def validation_view(self) -> "Problem":
        """The problem for evaluations during training, by which choices are made: itself, or for a data set one with other
        samples than the certificate's."""
        return self

    def velocity(self, x: Tensor, u: Tensor) -> Tensor:
        """`a(x) + B(x) u`, ``(N, d)``."""
        return driven(*self.vector_fields(x, divergences=False)[:2], u)

    def motion(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """`velocity` and the rate of cost `f(x) + R(u)`, ``(N,)``."""
        f, (a, B, _, _) = self.cost_and_fields(x, divergences=False)
        return driven(a, B, u), f + self.control_cost.cost(u)
