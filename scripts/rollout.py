"""A saved controller in a Gymnasium environment: python scripts/rollout.py run=<run> env=Pendulum-v1 video=out.gif"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.gym.rollout import prepare


def rollout(config: dict, folder) -> None:
    prepare(config).run()


@hydra.main(version_base="1.3", config_path="../configs", config_name="rollout")
def main(config: DictConfig) -> None:
    job(rollout, config)


if __name__ == "__main__":
    launch(main, "rollout", prepare)
