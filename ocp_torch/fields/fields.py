"""The networks that represent `V`, `w` and, where needed, `log mu`."""

import math
from collections.abc import Callable, Iterable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from ocp_torch.errors import InputError
from ocp_torch.fields.centred import Centred
from ocp_torch.fields.coupled_waves import coupled_waves, may_be_coupled
from ocp_torch.fields.embedding import FourierEmbedding
from ocp_torch.fields.logarithmic import Logarithmic
from ocp_torch.fields.rounded import Rounded
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.fields.waves import WAVE_STATES, prominent_waves
from ocp_torch.problems.equilibrium import equilibrium
from ocp_torch.problems.problem import Problem

VALUE, CONTROL_DENSITY, LOG_OCCUPATION = "value", "control_density", "log_occupation"
# A second `V`, fitted to values of trajectories or of a grid by the warm start alone: the best controller and the best bound
# come from different functions.
TRAJECTORY_VALUE = "trajectory_value"
# A third `V`: the first one, trained on for the lower bound alone.
SUBSOLUTION = "subsolution"
# Builds a network from (dim, outputs, shift, scale); outputs None means a scalar field.
NetworkFactory = Callable[..., nn.Module]


class Fields(nn.Module):
    """The fields a method trains, each under its name; a name that is not there reads as `None`."""

    def __init__(self, networks: dict[str, nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleDict(networks)

    @classmethod
    def build(
        cls, problem: Problem, names: Iterable[str], network: NetworkFactory, seed: int, waves: Tensor | None = None
    ) -> "Fields":
        """Fresh networks for ``names`` in the units of ``problem``, initialised from ``seed`` alone.

        An embedding with room for further waves gets ``waves`` ``(W, d)``, but for zeros, or else the problem's
        `prominent_waves`; features about a state of rest get its `equilibrium`.
        """
        cost, control = typical_sizes(problem)
        forms: dict[str, dict[str, Any]] = {
            VALUE: dict(outputs=None, shift=cost[0], scale=cost[1]),
            CONTROL_DENSITY: dict(outputs=problem.control_dim, shift=0.0, scale=control),
            LOG_OCCUPATION: dict(outputs=None, shift=0.0, scale=1.0),
        }
        forms[TRAJECTORY_VALUE] = forms[VALUE]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            fields = cls({name: made(name, network, dim=problem.dim, **forms[name]) for name in names})
        for embedding in (m for m in fields.modules() if isinstance(m, FourierEmbedding)):
            if embedding.mixed is not None and not embedding.mixed.is_meta:
                known = None if waves is None else waves[(waves != 0.0).any(dim=-1)]
                embedding.mix(_waves(problem, len(embedding.mixed)) if known is None else known)
        for centred in (m for m in fields.modules() if isinstance(m, Centred)):
            if not centred.at.is_meta and (rest := equilibrium(problem)) is not None:
                centred.centre(rest.at, rest.bend, fields.trajectory_value.unit)
        return fields

    @property
    def value(self) -> Any:
        """`V`: ``(N, d) -> (N,)``; each field is `None` where the method has none."""
        return self._get(VALUE)

    @property
    def control_density(self) -> Any:
        """`w`: ``(N, d) -> (N, m)``."""
        return self._get(CONTROL_DENSITY)

    @property
    def log_occupation(self) -> Any:
        """`log mu`: ``(N, d) -> (N,)``."""
        return self._get(LOG_OCCUPATION)

    @property
    def trajectory_value(self) -> Any:
        """The `V` of the warm start: ``(N, d) -> (N,)``."""
        return self._get(TRAJECTORY_VALUE)

    @property
    def subsolution(self) -> Any:
        """The `Subsolution` that the lower bound is made of, where that is not `V`."""
        return self._get(SUBSOLUTION)

    @property
    def rounded(self) -> "Fields":
        """The same fields for float64 states, computed in float32."""
        return Fields({name: Rounded(network) for name, network in self.networks.items()})

    def _get(self, name: str) -> nn.Module | None:
        return self.networks[name] if name in self.networks else None

    def parameters_of(self, names: Iterable[str]) -> list[nn.Parameter]:
        """The trainable parameters of the fields ``names``, in a fixed order."""
        return [p for name in names for p in self.networks[name].parameters() if p.requires_grad]


def made(name: str, network: NetworkFactory, **form: Any) -> nn.Module:
    """The network of the field ``name``, of the given ``form``."""
    special: dict[str, Callable[..., nn.Module]] = {TRAJECTORY_VALUE: Logarithmic.of, SUBSOLUTION: Subsolution.of}
    return special[name](network, **form) if name in special else network(**form)


ORDINARY = 1e4  # a state cost whose mean is within this factor of 1 is of an ordinary size
UNIT_STATES = 1024  # from which a problem's units are estimated
ROUNDING = 1e-12  # a standard deviation below this part of the mean is rounding
# The waves found for a problem, by their number: a search takes seconds in eight dimensions, and networks are built again.
_found: WeakKeyDictionary[Problem, dict[int, Tensor]] = WeakKeyDictionary()


def _waves(problem: Problem, count: int) -> Tensor:
    """`prominent_waves` of the problem's data, always from the same states; and `coupled_waves` of the state cost, where
    these may exist and evaluations cost little."""
    known = _found.setdefault(problem, {})
    if count not in known:
        samples, dim = problem.independent_samples(WAVE_STATES), problem.dim
        known[count] = prominent_waves(samples, count)
        if len(known[count]) < count and may_be_coupled(problem):
            listed = torch.cat([torch.eye(dim), 2.0 * torch.eye(dim), known[count]])
            more = coupled_waves(problem.state_cost, samples.x.float(), listed, count - len(known[count]))
            known[count] = torch.cat([known[count], more])
    return known[count]


def cost_unit(problem: Problem) -> float:
    """What losses are divided by before they are differentiated: 1 for costs of an ordinary size, else the power of two next
    to their mean, so that no optimiser mistakes a gradient of 1e-12 for 0."""
    (f,) = problem.probe(UNIT_STATES, 0, "f")
    size = float(f.abs().mean())
    ordinary = not math.isfinite(size) or size == 0.0 or 1.0 / ORDINARY <= size <= ORDINARY
    return 1.0 if ordinary else 2.0 ** round(math.log2(size))


def typical_sizes(problem: Problem) -> tuple[tuple[float, float], float]:
    """Mean and standard deviation of the state cost, and the control `(q std)^{1/q}` worth as much: a problem's units.

    Raises `InputError` when the state cost is not finite at some sampled state.
    """
    x, f = problem.probe(UNIT_STATES, 0, "x", "f")
    if f.shape != (len(x),):
        raise InputError(f"state_cost gave shape {tuple(f.shape)} for states {tuple(x.shape)}; it must give (N,).")
    if not torch.isfinite(f).all():
        at = x[~torch.isfinite(f)][0].tolist()
        raise InputError(f"state_cost is not finite at x = {at}; it must be finite on the whole torus.")
    spread = float(f.std())
    mean = float(f.mean())
    spread = spread if spread > ROUNDING * max(abs(mean), 1e-300) else max(abs(mean), 1.0)
    control = math.pow(problem.exponent * spread, 1.0 / problem.exponent)
    return (mean, spread), min(control, problem.control_cost.reach)
