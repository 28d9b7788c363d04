"""Certify a finished run again: python scripts/evaluate.py run=outputs/circle_pd/2026-01-01_12-00-00-000000"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from ocp_torch.certificate.checks.possible import require_possible
from ocp_torch.cli.launch import job, launch
from ocp_torch.errors import require_integer
from ocp_torch.runs.evaluate import animated, certify_saved, load_run, settings_for
from ocp_torch.runs.pictures import require_gif


def check(config: dict):
    controller = load_run(config)
    if config["seed"] is not None:
        require_integer("seed", config["seed"], 0)
    if config["animation"] is not None:
        require_gif(controller.problem, config["animation"])
    settings = settings_for(controller, config)
    require_possible(controller.problem, settings, trains_value=controller.fields.value is not None)
    return controller, settings


def evaluate(config: dict, folder) -> None:
    controller, settings = check(config)
    certify_saved(controller, settings, config["seed"])
    if config["animation"] is not None:
        animated(controller, config["animation"], config["seed"])


@hydra.main(version_base="1.3", config_path="../configs", config_name="evaluate")
def main(config: DictConfig) -> None:
    job(evaluate, config)


if __name__ == "__main__":
    launch(main, "evaluate", check)
