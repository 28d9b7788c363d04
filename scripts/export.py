"""A saved controller for where there is no PyTorch: python scripts/export.py run=<run> format=c out=controller.c"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.runs.export import exporting


def export(write: Callable, folder: Path) -> None:
    write()


@hydra.main(version_base="1.3", config_path="../configs", config_name="export")
def main(config: DictConfig) -> None:
    job(exporting, export, config)


if __name__ == "__main__":
    launch(main, "export", exporting, export)
