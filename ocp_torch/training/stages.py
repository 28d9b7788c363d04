"""What a user sees after the last step: what is being made of the certificate and the files, and how long that takes."""

from __future__ import annotations

import logging
import threading
from typing import Any

from tqdm import tqdm

log = logging.getLogger(__name__)
# A full certificate has cost 5 to 10 times a quick one, beside its own fit (measured on the circle, the pendulum and a
# manufactured problem in four dimensions).
QUICK_CERTIFICATES = 6.0
TICK = 1.0  # seconds between two movements of the clock
CLOCK = "{desc}: {elapsed}{postfix}"


def rough_seconds(quick: float | None, step: float, steps: int) -> float | None:
    """About how long a certificate takes where a quick one took ``quick`` seconds and a step ``step``, and whose fit has
    ``steps`` steps at least; `None` where there was no quick one."""
    return None if quick is None else QUICK_CERTIFICATES * quick + steps * step


def in_words(seconds: float) -> str:
    """A duration as one says it."""
    return f"{max(1, round(seconds))} s" if seconds < 90.0 else f"{round(seconds / 60.0)} min"


class Stages:
    """A clock with the name of the stage, in terminals; elsewhere, and in the log, a line per stage. Call it with a name."""

    def __init__(self, hidden: bool | None) -> None:
        self._hidden = hidden
        self._clock: Any = None  # the bar, once something has begun
        self._over = threading.Event()

    def begin(self, seconds: float | None) -> None:
        """The first stage is about to begin, and all of them take about ``seconds``."""
        if self._clock is None:
            self._clock = tqdm(bar_format=CLOCK, dynamic_ncols=True, disable=self._hidden)
            if not self._clock.disable:
                threading.Thread(target=self._tick, daemon=True).start()
        self._clock.set_postfix_str(f"about {in_words(seconds)} in all" if seconds else "", refresh=False)

    def __call__(self, stage: str) -> None:
        if self._clock is None:
            self.begin(None)
        self._clock.set_description_str(stage)
        log.log(logging.INFO if self._clock.disable else logging.DEBUG, "%s ...", stage)

    def close(self) -> None:
        self._over.set()
        if self._clock is not None:
            self._clock.close()

    def _tick(self) -> None:
        while not self._over.wait(TICK):
            self._clock.refresh()
