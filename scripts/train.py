"""Train a controller and its certificate: python scripts/train.py problem=circle method=pd (--help for all fields)."""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from ocp_torch.config import build_certificate_settings, build_trainer
from ocp_torch.launch import finish, job, launch
from ocp_torch.training.session import run_session


def build(config: dict):
    trainer = build_trainer(config)
    return trainer, build_certificate_settings(trainer.config)


def train(config: dict, folder) -> None:
    trainer, certificate_settings = build(config)
    run_session(trainer, certificate_settings, folder)


@hydra.main(version_base="1.3", config_path="../configs", config_name="train")
def main(config: DictConfig) -> None:
    job(train, config)


if __name__ == "__main__":
    launch(main, "train", build)
    finish()
