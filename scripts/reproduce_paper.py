"""Every figure and number of the paper's numerical sections: python scripts/reproduce_paper.py"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.studies.paper.reproduce import check, reproduce


@hydra.main(version_base="1.3", config_path="../configs", config_name="reproduce_paper")
def main(config: DictConfig) -> None:
    job(check, reproduce, config)


if __name__ == "__main__":
    launch(main, "reproduce_paper", check, reproduce)
