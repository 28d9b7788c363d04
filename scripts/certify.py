"""Certify any controller: python scripts/certify.py problem=circle controller=mine.py:u (--help for all fields)."""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.launch import job, launch
from ocp_torch.runs.external import arguments, certify_in


@hydra.main(version_base="1.3", config_path="../configs", config_name="certify")
def main(config: DictConfig) -> None:
    job(arguments, certify_in, config)


if __name__ == "__main__":
    launch(main, "certify", arguments, certify_in)
