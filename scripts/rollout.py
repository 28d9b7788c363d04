"""A saved controller in a Gymnasium environment: python scripts/rollout.py run=<run> env=Pendulum-v1 video=out.gif"""

from __future__ import annotations

from pathlib import Path

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.gym.rollout import RolloutJob


def rollout(made: RolloutJob, folder: Path) -> None:
    made.run()


@hydra.main(version_base="1.3", config_path="../configs", config_name="rollout")
def main(config: DictConfig) -> None:
    job(RolloutJob, rollout, config)


if __name__ == "__main__":
    launch(main, "rollout", RolloutJob, rollout)
