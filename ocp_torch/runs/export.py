"""A saved controller, exported by a command."""

import logging
from collections.abc import Callable

from ocp_torch.errors import InputError, require_choice
from ocp_torch.export import FORMATS
from ocp_torch.runs.evaluate import load_run

log = logging.getLogger(__name__)


def exporting(config: dict) -> Callable[[], None]:
    """A function that exports the saved controller of ``config``, which is checked here: `InputError` for a wrong field."""
    controller, out, format = load_run(config), config["out"], config["format"]
    if format is not None:
        require_choice("format", format, FORMATS)
    if out is None:
        if format is None:
            raise InputError(
                f"format is missing: choose one of {', '.join(FORMATS)}, or give out=FILE with its ending."
            )
        out = f"controller{FORMATS[format][0]}"

    def write() -> None:
        for file in controller.export(str(out), format, config["coordinates"]):
            log.info("wrote %s, %s bytes", file, f"{file.stat().st_size:,}")

    return write
