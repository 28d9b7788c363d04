"""What training hands over to a certificate."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import nn

from ocp_torch.errors import InputError
from ocp_torch.fields.fields import Fields

M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class Trained:
    """What training hands over: the fields, how they give `mu` (see `trained_policies`), and the network they are made of."""

    fields: Fields
    occupation: str | None
    network: Callable[..., nn.Module]

    def in_float64(self) -> Fields:
        """The fields as every bound is computed with them."""
        return in_float64(self.fields)


def in_float64(fields: M) -> M:
    """A frozen float64 copy on the CPU: what every bound is computed with."""
    return copy.deepcopy(fields).to("cpu").double().requires_grad_(False).eval()


def require_finite(fields: Fields) -> None:
    """Raises `InputError` where weights are not: no number computed from them would mean anything."""
    for name, network in fields.networks.items():
        if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
            raise InputError(f"the network for {name} holds weights that are not finite; there is nothing to certify.")
