"""Trainers and runs of a second or less, made from command lines as scripts/train.py makes them."""

from __future__ import annotations

from ocp_torch.cli.compose import composed, register_resolvers
from ocp_torch.errors import InputError
from ocp_torch.runs.build import build_certificate_settings, build_trainer
from ocp_torch.runs.run import run_to_end
from ocp_torch.training.trainer import Trainer

register_resolvers()


def configured(*overrides: str) -> dict:
    """What `scripts/train.py` makes of ``overrides``."""
    return composed("train", list(overrides))


def outcome(*overrides: str) -> Trainer | str:
    """The trainer, or the sentence a user is shown; any other exception would be shown as a traceback."""
    try:
        trainer = build_trainer(configured(*overrides))
        build_certificate_settings(trainer.config)
        return trainer
    except InputError as error:
        return str(error)


SMALL = (
    "experiment=debug",
    "model.width=8",
    "trainer.steps=20",
    "trainer.batch=16",
    "trainer.evaluate_every=0",
    "trainer.device=cpu",
    "certificate.tolerance=0.01",
    "certificate.occupation_states=8",
)

METHODS = {
    "dual": ("method=dual",),
    "primal, mu closed": ("method=primal",),
    "primal, mu a network": ("method=primal", "method.occupation=network"),
    "pd": ("method=pd",),
    "pd, plain": ("method=pd", "method.augmentation=0"),
    "pd, with noise": ("method=pd", "problem.noise=0.01", "sampler.visited=0.25"),
}


def small(*overrides: str):
    return build_trainer(configured(*SMALL, *overrides))


def session(trainer, folder):
    return run_to_end(trainer, build_certificate_settings(trainer.config), folder)


def state_of(trainer) -> dict:
    """All of its state that must repeat: everything but the clock, and how often it is looked at."""
    return {k: v for k, v in trainer.state.state_dict().items() if k not in ("seconds", "elapsed", "config")}
