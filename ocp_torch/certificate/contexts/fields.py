"""What training hands over to a certificate: nothing here knows how the fields were trained."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

from torch import nn

from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.settings import CERTIFIED
from ocp_torch.certificate.simulated.memory import Memory
from ocp_torch.control.policies import DENSITY, MINIMISED, VALUE, Policy, trained_policies
from ocp_torch.fields.fields import Fields
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.jets import Field

M = TypeVar("M", bound=nn.Module)


def in_float64(fields: M) -> M:
    """A frozen float64 copy on the CPU: what every bound is computed with."""
    return copy.deepcopy(fields).to("cpu").double().requires_grad_(False).eval()


@dataclass(frozen=True)
class Trained:
    """What training hands over: the fields, how they give `mu` (see `trained_policies`), the network they are made of, and
    which ``kind`` of controller was handed out, where that is settled already.

    ``memory`` keeps the simulations of controllers, for later certificates in which some are the same.
    """

    fields: Fields
    occupation: str | None
    network: Callable[..., nn.Module]
    kind: str | None = None
    memory: Memory = field(default_factory=Memory, compare=False, repr=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldsContext(Context):
    """The context of trained fields: what certificates of them share, wherever the problem is known."""

    trained: Trained

    always_listed = (VALUE, DENSITY)

    @property
    def occupation(self) -> str | None:
        """How `mu` follows from the fields, see `trained_policies`."""
        return self.trained.occupation

    @cached_property
    def fields(self) -> Fields:
        """The trained fields in float64."""
        return in_float64(self.trained.fields)

    @property
    def value(self) -> Field | None:
        return self.fields.value

    @property
    def saved_subsolution(self) -> Subsolution | None:
        return self.fields.subsolution

    def policies_of(self, fields: Fields) -> dict[str, Policy]:
        """The controllers that the trained ``fields`` give, in their precision, by name."""
        every = self.settings.prefer == CERTIFIED or self.trained.kind == MINIMISED
        return trained_policies(self.occupation, self.problem, fields, self.constants, every)

    @cached_property
    def policies(self) -> dict[str, Policy]:
        return self.policies_of(self.fields)
