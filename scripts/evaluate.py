"""Certify a finished run again: python scripts/evaluate.py run=outputs/circle_pd/2026-01-01_12-00-00-000000"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.runs.evaluate import recertification


def evaluate(recertify: Callable, folder: Path) -> None:
    recertify()


@hydra.main(version_base="1.3", config_path="../configs", config_name="evaluate")
def main(config: DictConfig) -> None:
    job(recertification, evaluate, config)


if __name__ == "__main__":
    launch(main, "evaluate", recertification, evaluate)
