"""What training hands over to a certificate, known everywhere or on recorded samples alone."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import torch
from torch import nn

from ocp_torch.certificate.context import Context
from ocp_torch.control.policies import Policy, trained_policies
from ocp_torch.errors import InputError
from ocp_torch.fields.fields import Fields
from ocp_torch.maths.jets import Field

M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class Trained:
    """What training hands over: the fields, how they give `mu` (see `trained_policies`), and the network they are made of."""

    fields: Fields
    occupation: str | None
    network: Callable[..., nn.Module]


def in_float64(fields: M) -> M:
    """A frozen float64 copy on the CPU: what every bound is computed with."""
    return copy.deepcopy(fields).to("cpu").double().requires_grad_(False).eval()


def require_finite(fields: Fields) -> None:
    """Raises `InputError` where weights are not: no number computed from them would mean anything."""
    for name, network in fields.networks.items():
        if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
            raise InputError(f"the network for {name} holds weights that are not finite; there is nothing to certify.")


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldsContext(Context):
    """The context of trained fields: what certificates of them share, wherever the problem is known."""

    trained: Trained

    @property
    def occupation(self) -> str | None:
        """How `mu` follows from the fields, see `trained_policies`."""
        return self.trained.occupation

    @cached_property
    def fields(self) -> Fields:
        """In float64."""
        return in_float64(self.trained.fields)

    @property
    def value(self) -> Field | None:
        return self.fields.value

    def policies_of(self, fields: Fields) -> dict[str, Policy]:
        """The controllers that the trained ``fields`` give, in their precision, by name."""
        return trained_policies(self.occupation, self.problem, fields, self.constants)
