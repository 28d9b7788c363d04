"""Compare methods and models on one problem: python scripts/benchmark.py problem=circle seeds=[0,1,2]"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.studies.benchmark.contest import Contest


@hydra.main(version_base="1.3", config_path="../configs", config_name="benchmark")
def main(config: DictConfig) -> None:
    job(Contest, Contest.run, config)


if __name__ == "__main__":
    launch(main, "benchmark", Contest, Contest.run)
