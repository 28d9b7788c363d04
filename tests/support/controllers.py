"""Controllers of every method, from fields that were never trained."""

from __future__ import annotations

import torch

from ocp_torch import Controller, Problem
from ocp_torch.runs.build import build_trainer
from support.small import configured

SMALL = ("experiment=debug", "model.width=8", "trainer.device=cpu")

METHODS = {
    "dual": ("method=dual", "problem=torus"),
    "primal closed": ("method=primal", "problem=torus", "problem.shear=random"),
    "primal network": ("method=primal", "problem=manufactured", "problem.control_dim=1"),
    "pd": ("method=pd", "problem=manufactured", "problem.exponent=1.5"),
    "pd plain": ("method=pd", "method.augmentation=0", "problem=circle", "problem.discount=3"),
}


CERTIFICATE = {"schema": 1, "exact": 0.061, "lower": {"F_M": None}, "warnings": ["a\nb"]}


def controller_of(config: dict, problem: Problem | None = None) -> list[Controller]:
    """Every controller that untrained but rough fields of ``config`` give."""
    trainer = build_trainer(config)
    problem, fields = problem or trainer.problem, trainer.fields.requires_grad_(False)
    generator = torch.Generator().manual_seed(1)
    for weight in fields.parameters():
        weight += 0.2 * torch.randn(weight.shape, generator=generator).to(weight)
    kinds = {"value": fields.value, "density": fields.control_density, "trajectories": fields.trajectory_value}
    common = (problem, fields, trainer.constants, trainer.objective.occupation)
    rest = (trainer.config["model"], CERTIFICATE, trainer.config)
    return [Controller(*common, kind, *rest) for kind, field in kinds.items() if field]


def controllers(method: str, *overrides: str) -> list[Controller]:
    return controller_of(configured(*SMALL, *METHODS[method], *overrides))
