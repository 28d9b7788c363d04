"""`OPT` from grids, in one to three dimensions: python scripts/reference.py problem=torus (--help for all fields)."""

from __future__ import annotations

from pathlib import Path

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.studies.reference.session import ReferenceJob


def refer(made: ReferenceJob, folder: Path) -> None:
    made.run()


@hydra.main(version_base="1.3", config_path="../configs", config_name="reference")
def main(config: DictConfig) -> None:
    job(ReferenceJob, refer, config)


if __name__ == "__main__":
    launch(main, "reference", ReferenceJob, refer)
