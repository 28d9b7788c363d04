"""Model-predictive control with V at the end of a short horizon: python scripts/mpc.py run=<run> steps=10"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.studies.horizons import horizons


def mpc(compare: Callable, folder: Path) -> None:
    compare()


@hydra.main(version_base="1.3", config_path="../configs", config_name="mpc")
def main(config: DictConfig) -> None:
    job(horizons, mpc, config)


if __name__ == "__main__":
    launch(main, "mpc", horizons, mpc)
