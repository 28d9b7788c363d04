"""Random networks over random cells, and whether Taylor models hold what is met at places in them."""

import torch

from ocp_torch.certificate.proof.models import Box
from ocp_torch.certificate.proof.smooth import SmoothModel
from ocp_torch.certificate.proof.taylor import TaylorModel
from ocp_torch.fields import PeriodicMLP


def network(dim: int, seed: int, **options) -> PeriodicMLP:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        built = PeriodicMLP(
            dim, **{"modes": 2, "waves": 2, "width": 12, "depth": 2, "shift": 0.1, "scale": 0.7, **options}
        ).double()
        built.embedding.mix(torch.tensor([[1.0, -2.0, 0.0], [1.0, 1.0, 1.0]])[:, :dim])
        for module in built.modules():
            if isinstance(module, torch.nn.Linear):
                torch.nn.init.normal_(module.bias, std=0.5)
        torch.nn.init.normal_(built.head.weight, std=0.3)
    return built.requires_grad_(False)


def random_box(dim: int, level: int, degree: int, seed: int, count: int = 24) -> Box:
    """Cells of side `2^-level`, long in one coordinate for every other one."""
    generator = torch.Generator().manual_seed(seed)
    centre = (torch.randint(0, 2**level, (count, dim), generator=generator).double() + 0.5) / 2**level
    half = torch.full_like(centre, 0.5 / 2**level)
    half[::2, 0] *= 0.25
    return Box(centre, half, degree)


def corners_and_inside(box: Box, count: int = 40, seed: int = 0) -> torch.Tensor:
    """Places `t` in `[-1, 1]^d`, ``(count, N, d)``: all corners, the centre, and random ones."""
    dim = box.centre.shape[1]
    t = 2.0 * torch.rand(count, *box.centre.shape, generator=torch.Generator().manual_seed(seed)).double() - 1.0
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * dim).reshape(-1, 1, dim).double()
    t[: len(signs)] = signs
    t[len(signs)] = 0.0
    return t


def at(model: TaylorModel, t: torch.Tensor) -> torch.Tensor:
    """The polynomial at places `t` ``(count, N, d)``: ``(count, N, ...)``."""
    powers = torch.stack([(t ** t.new_tensor(a)).prod(dim=-1) for a in model.basis.exponents])
    shaped = powers.reshape(*powers.shape, *[1] * (model.radius.dim() - 1))
    return (shaped * model.coefficients.unsqueeze(1)).sum(dim=0)


def holds(model: TaylorModel, truth: torch.Tensor, t: torch.Tensor) -> bool:
    """``truth`` ``(count, N, ...)``, itself rounded, is within the radius of the model, and within its bounds."""
    room = 1e-12 * (1.0 + truth.abs())
    low, high = model.bounds()
    inside = ((at(model, t) - truth).abs() <= model.radius + room).all()
    return bool(inside and (truth >= low - room).all() and (truth <= high + room).all())


def flat(function, box: Box, t: torch.Tensor) -> torch.Tensor:
    x = box.centre + box.half * t
    found = function(x.flatten(0, 1))
    return found.reshape(*x.shape[:2], *found.shape[1:])


def grid(dim: int, side: int) -> torch.Tensor:
    return torch.cartesian_prod(*[(torch.arange(side).double() + 0.5) / side] * dim).reshape(-1, dim)


def perturbed_models(degree: int, size: float, offset: float, slope: float, bend: float, seed: int, curved: bool):
    """A model in two variables, and at places ``t`` a function it holds: `P + offset + slope s + bend s^2 / 2`, `s = sum t`;
    with its slopes and, for ``curved``, second derivatives, whose radii the model has then."""
    box = random_box(2, 3, degree, seed)
    basis, generator = box.basis, torch.Generator().manual_seed(seed)
    P = size * torch.randn(len(basis.exponents), len(box), 3, generator=generator).double()
    P[0] = torch.randn(len(box), 3, generator=generator).double()
    own = torch.full((len(box), 3), 1.0).double()
    radii = [abs(offset) + 2.0 * abs(slope) + 2.0 * abs(bend), *[abs(slope) + 2.0 * abs(bend)] * 2, *[abs(bend)] * 3]
    model = SmoothModel(P, torch.stack([r * own for r in radii[: 6 if curved else 3]]), basis)
    t = corners_and_inside(box)
    one, s = torch.ones_like(box.half), t.sum(dim=-1, keepdim=True)
    polynomial, slopes = model.models(one)
    value = at(polynomial, t) + offset + slope * s + 0.5 * bend * s * s
    second = at(model.hessian(one), t) + bend if curved else None
    return model, t, value, at(slopes, t) + slope + bend * s.unsqueeze(-1), second


def layer_holds(found: SmoothModel, value, slopes, second, t) -> bool:
    """Whether a layer's value, slopes and second derivatives at places ``t`` lie in its model."""
    one = torch.ones_like(t[0])
    models = [*found.models(one), *([] if second is None else [found.hessian(one)])]
    pairs = zip(models, (value, slopes, second), strict=False)
    return all(bool(((at(model, t) - truth).abs() <= model.radius + 1e-13).all()) for model, truth in pairs)
