"""Train a controller and its certificate: python scripts/train.py problem=circle method=pd (--help for all fields)."""

from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the slow imports ends quietly

import hydra  # noqa: E402
from omegaconf import DictConfig  # noqa: E402

from ocp_torch.cli.launch import job, launch  # noqa: E402
from ocp_torch.runs.run import train, training_run  # noqa: E402


@hydra.main(version_base="1.3", config_path="../configs", config_name="train")
def main(config: DictConfig) -> None:
    job(training_run, train, config)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    launch(main, "train", training_run, train)
