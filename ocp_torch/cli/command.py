"""A command, as `scripts/<name>.py` and the installed `ocp-<name>` call it."""

from collections.abc import Callable
from dataclasses import dataclass

import hydra
from omegaconf import DictConfig

from ocp_torch.cli.explain import CONFIGS
from ocp_torch.cli.job import job
from ocp_torch.cli.launch import launch


@dataclass(frozen=True)
class Command:
    """A call runs the command line: ``work(check(data), folder)``, with the configuration ``name`` (see `launch`)."""

    name: str
    check: Callable[[dict], object]
    work: Callable[..., object]

    def __call__(self) -> None:
        def entry(config: DictConfig) -> None:
            job(self.check, self.work, config)

        entry.__module__ = f"{__package__}.commands.{self.name}"  # Hydra names a job, and its log, after the last part
        entered = hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name=self.name)(entry)
        launch(entered, self.name, self.check, self.work)
