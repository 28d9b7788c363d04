"""Record samples of a problem: python scripts/record.py problem=manufactured samples=20000 out=data.npz"""

from __future__ import annotations

from pathlib import Path

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.runs.record import arguments, record


def write(asked: dict, folder: Path) -> None:
    record(**asked)


@hydra.main(version_base="1.3", config_path="../configs", config_name="record")
def main(config: DictConfig) -> None:
    job(arguments, write, config)


if __name__ == "__main__":
    launch(main, "record", arguments, write)
